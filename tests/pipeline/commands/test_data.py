"""The verbs of the simulated skin."""

import json

import numpy as np
import pytest

from pipeline.recordings.files.reading import read_source
from tests.command import call
from tests.pipeline.handmade import archive as archive_of
from tests.pipeline.handmade import good_members


@pytest.fixture
def archive(tmp_path, capsys):
    path = tmp_path / "few.zip"
    assert call("data", "simulate", "--out", path, "--samples-per-digit", 3, "--jobs", 1) == 0
    capsys.readouterr()
    return path


def test_options_and_settings_of_the_simulation_are_the_same(tmp_path):
    one, other = tmp_path / "one.zip", tmp_path / "other.zip"
    options = ("--samples-per-digit", 2, "--seed", 5)
    settings = ("--set", "data.samples_per_digit=2", "--set", "data.simulation_seed=5")
    for path, words in ((one, options), (other, settings)):
        assert call("data", "simulate", "--out", path, *words, "--jobs", 1) == 0
    assert one.read_bytes() == other.read_bytes()


def test_a_simulated_zip_is_read_back(archive):
    recordings = read_source(archive, jobs=1)
    assert recordings.source.simulated
    assert len(recordings) == 30


def read_statistics(archive, capsys):
    assert call("data", "stats", "--data", archive, "--json", "--jobs", 1) == 0
    return json.loads(capsys.readouterr().out)


def test_statistics_count_samples_and_taxels(archive, capsys):
    stats = read_statistics(archive, capsys)
    assert stats["simulated"] is True
    assert stats["samples"] == 30
    assert list(stats["classes"]) == [str(digit) for digit in range(10)]
    assert len(stats["taxels"]["each"]) == 100
    assert stats["polarity_order"]["rise_first"] > 0.9


def test_statistics_of_a_class_are_those_of_its_events(archive, capsys):
    row = read_statistics(archive, capsys)["classes"]["4"]
    assert row["samples"] == 3
    recordings = read_source(archive, jobs=1)
    events = recordings.events
    on = [
        events.columns[part][events.polarity[part] > 0].sum()
        for index in np.flatnonzero(recordings.labels == 4)
        for part in [slice(recordings.offsets[index], recordings.offsets[index + 1])]
    ]
    assert row["on"] == pytest.approx([np.mean(on), np.std(on, ddof=1)])
    assert {"off", "row_mean", "column_mean", "row_range", "column_range"} < set(row)


def test_files_that_cannot_be_read_are_left_out_of_statistics_and_figures(tmp_path, capsys):
    path = tmp_path / "st.zip"
    archive_of(path, {**good_members(), "3/bad.mat": b"no recording"})
    for words in (("stats", "--json"), ("plot", "sheet", "--out", tmp_path / "sheet.png")):
        assert call("data", *words, "--data", path, "--jobs", 1) == 2
        assert call("data", *words, "--data", path, "--jobs", 1, "--set", "data.skip_bad=true") == 0
        assert "3/bad.mat" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["recording", "sheet"])
def test_plot(what, archive, tmp_path):
    out = tmp_path / f"{what}.png"
    arguments = ["--data", archive, "--jobs", 1]
    assert call("data", "plot", what, "--out", out, *arguments) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    one = call("data", "plot", what, "--out", out, *arguments, "--sample", "2/0001")
    assert one == (2 if what == "sheet" else 0)  # a sheet draws its own
