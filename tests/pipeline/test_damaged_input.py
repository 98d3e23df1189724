"""Damaged and hostile input: one small case each."""

import json
import os
import re

import pytest

from deploy.files import read_json, write_json
from pipeline.settings import read_settings
from pipeline.storage.run_folder import RunFolder
from tests.command import call
from tests.pipeline.handmade import archive, good_members


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--set", f"seed={'9' * 5000}"], "'seed'"),
        (["--set", f"cnn.epochs={'[' * 5000}"], "'cnn.epochs'"),
        (["--set", "cnn.architecture=10x10-3000c4-3000c3-10o"], "20000000 weights"),
        (["--steps", "10"], "--set presentation.readout_start=2"),
    ],
)
def test_settings_past_all_use(refused, tmp_path, arguments, said):
    assert said in refused("ladder", tmp_path / "run", *arguments)
    assert not (tmp_path / "run" / "experiment.toml").exists()


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, "x = 1\n" * 500_000])
def test_settings_that_are_nested_or_long_past_all_use(refused, tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    line = refused("train", tmp_path / "run", "--settings", tmp_path / "mine.toml")
    assert str(tmp_path / "mine.toml") in line


def change_result(name, value):
    def change(path):
        result = read_json(path, "")
        place = result
        for key in name[:-1]:
            place = place[key]
        if value is None:
            del place[name[-1]]
        else:
            place[name[-1]] = value
        path.write_text(json.dumps(result))

    return change


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("snn/history.csv", lambda path: path.write_bytes(b"epoch,loss\n1,\xf9\n")),
        ("snn/history.csv", lambda path: path.write_text("epoch,loss\n1,\n")),
        ("snn/history.csv", lambda path: path.write_text("epoch,loss\n1,nan\n")),
        ("snn/history.csv", lambda path: path.write_text("")),
        ("snn/history.csv", lambda path: path.write_text("epoch,loss,accurac\n1,0.1,0.5\n")),
        ("cnn/metrics.json", lambda path: write_json(path, {"n_test": 3, "accuracy": 0.5})),
        ("checks/emulator.json", change_result(["samples", 0, "scores"], None)),
        ("checks/emulator.json", change_result(["samples", 0, "scores"], ["1"] * 10)),
        ("checks/emulator.json", change_result(["samples", 0, "scores"], [0.5] * 11)),
        ("checks/emulator.json", change_result(["samples", 0, "label"], 1.5)),
        ("checks/emulator.json", change_result(["samples", 0, "stopped_at"], "soon")),
        ("checks/emulator.json", change_result(["while_written"], {"shares": [1], "accuracy": []})),
        ("checks/emulator.json", change_result(["samples", 0, "id"], "\ud800")),
        ("checks/emulator.json", change_result(["synaptic_operations", "conv2"], "many")),
        ("checks/emulator.json", change_result(["spikes"], {"conv7": 3})),
        ("checks/emulator.json", change_result(["anytime_accuracy"], None)),
        ("checks/emulator.json", change_result(["wall_seconds"], float("inf"))),
    ],
)
def test_a_report_of_a_run_with_a_broken_file(refused, run, file, change):
    change(run / file)
    assert str(run / file) in refused("report", run)


@pytest.mark.parametrize(
    ("file", "name", "value"),
    [
        ("snn/metrics.json", ["accuracy"], 0.5),
        ("snn/metrics.json", ["accuracy", "test"], "high"),
        ("snn/metrics.json", ["accuracy", "test"], 10**400),
        ("cnn/metrics.json", ["seconds"], [1]),
        ("cnn/metrics.json", ["seconds"], True),
        ("ladder.json", ["rows"], 5),
        ("ladder.json", ["rows", 0], "cnn"),
        ("ladder.json", ["rows"], None),
        ("dataset.json", ["made_from"], float("nan")),
    ],
)
def test_the_status_of_a_run_with_a_damaged_record(refused, run, file, name, value):
    change_result(name, value)(run / file)
    assert str(run / file) in refused("status", run)


def test_a_name_that_a_terminal_would_obey(refused, tmp_path):
    archive(tmp_path / "st.zip", {**good_members(), "3/\x1b[2J.mat": b"x"})
    line = refused("data", "import", tmp_path / "st.zip", "--jobs", 1)
    assert "\x1b" not in line
    assert r"\x1b[2J.mat" in line


def test_a_message_is_one_line_of_a_bearable_length():
    from deploy.errors import MAX_LINE_LENGTH, format_as_line

    assert format_as_line("a\n b\x1b[2J\ud800") == "a b\\x1b[2J\\ud800"
    long = format_as_line("begins " + "x" * 10_000 + " ends")
    assert len(long) <= MAX_LINE_LENGTH + 5
    assert long.startswith("begins ")
    assert long.endswith(" ends")


def test_training_needs_no_samples_for_a_check_and_keeps_its_data(tmp_path, capsys):
    """It failed on the check's samples, forgot --data, and the ladder then took simulated ones."""
    archive(tmp_path / "small.zip", good_members(3))
    run = RunFolder(tmp_path / "run")
    options = ["--set", "cnn.epochs=1", "--jobs", 1]
    assert call("train", run.path, "--data", tmp_path / "small.zip", *options) == 0
    assert read_settings(run.experiment).data.source == str(tmp_path / "small.zip")
    capsys.readouterr()
    assert call("ladder", run.path, "--samples", 150, "--jobs", 1) == 2
    assert re.search(r"\b150\b.* 10\b", capsys.readouterr().err)


def test_simulated_recordings_are_not_taken_without_a_word(tmp_path, capsys):
    options = ["--set", "data.samples_per_digit=60", "--set", "cnn.epochs=1"]
    assert call("train", tmp_path / "run", *options) == 0
    assert re.search("run: .*simulated.*--data", capsys.readouterr().err)
    assert call("train", tmp_path / "run") == 0
    assert "--data" not in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["train", "convert", "ladder", "sweep"])
def test_a_file_that_is_not_there_does_not_become_a_run(refused, tmp_path, verb):
    line = refused(verb, tmp_path / "my_model.keras")
    assert "my_model.keras" in line
    assert not list(tmp_path.iterdir())


def test_a_file_larger_than_any_of_its_kind(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.recordings.formats.mat.MAX_FILE_BYTES", 10_000)
    monkeypatch.setattr("deploy.limits.TEXT_BYTES", 10_000)
    path = tmp_path / "large.mat"
    path.touch()
    os.truncate(path, 1 << 40)
    for command in (
        ("data", "inspect", path),
        ("check", "compare", path, path),
        ("train", tmp_path / "run", "--settings", path),
    ):
        assert re.search(r"large\.mat: .*larger", refused(*command))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
@pytest.mark.parametrize(
    "arguments",
    [
        ["data", "inspect", "{pipe}.mat"],
        ["data", "import", "{pipe}"],
        ["check", "compare", "{pipe}", "{pipe}"],
        ["train", "{run}", "--settings", "{pipe}"],
        ["convert", "{run}", "--model", "{pipe}.keras"],
        ["check", "run", "{bundle}", "--target", "fast"],
    ],
)
def test_a_pipe_or_a_device_is_not_read(refused, tmp_path, arguments, make):
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    for path in (
        tmp_path / "a",
        tmp_path / "a.mat",
        tmp_path / "a.keras",
        bundle / "MANIFEST.json",
    ):
        make(path)
    names = {"pipe": tmp_path / "a", "run": tmp_path / "run", "bundle": bundle}
    line = refused(*(argument.format(**names) for argument in arguments))
    assert "a pipe" in line
