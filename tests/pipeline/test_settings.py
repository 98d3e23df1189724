import json
import tomllib
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.errors import UserError
from deploy.network.presentation import Presentation
from pipeline.settings import (
    Settings,
    describe_settings,
    parse_assignments,
    read_settings,
    write_settings,
)
from pipeline.storage.run_folder import RunFolder
from tests.command import call, missing


def test_the_papers_numbers_are_the_defaults():
    settings = Settings()
    assert settings.cnn.architecture == "10x10-6c4-24c3-10o"
    assert settings.cnn.epochs == 0
    assert settings.split.test_fraction == 0.2
    assert settings.check.samples == 200
    assert settings.with_values({"check": {"samples": 0}}).check.count_samples(1391) == 1391


def test_the_presentation_has_the_bundles_entries():
    ours = {entry.name for entry in fields(Settings().presentation)}
    of_bundle = {entry.name for entry in fields(Presentation)}
    assert ours - {"early_loss"} | {"threshold"} == of_bundle


@given(
    seed=st.integers(0, 2**31 - 1),
    source=st.text(st.characters(exclude_categories=["Cs"]), min_size=1),
    rates=st.lists(st.floats(1, 900), min_size=1, max_size=2),
    skip=st.booleans(),
)
def test_round_trip(tmp_path_factory, seed, source, rates, skip):
    changes = {"seed": seed, "data": {"source": source, "skip_bad": skip}}
    settings = Settings().with_values({**changes, "snn": {"max_rates": rates}}, "here")
    path = tmp_path_factory.mktemp("settings") / "experiment.toml"
    write_settings(path, settings)
    assert read_settings(path) == settings
    entries = {entry.name for entry in fields(Settings) if entry.init}
    assert set(tomllib.loads(path.read_text())) == entries | {"given"}


BAD = [
    ({"epochs": 3},),
    ({"cnn": {"epoch": 3}}, "'cnn.epochs'"),
    ({"cnn": 3}, "table"),
    ({"cnn": {"epochs": "3"}}, "'3'"),
    ({"cnn": {"epochs": 3.5}}, "3.5"),
    ({"cnn": {"epochs": True}}, "True"),
    ({"data": {"source": 3}},),
    ({"data": {"source": "\udcff.zip"}},),
    ({"data": {"skip_bad": 1}}, "true", "false"),
    ({"snn": {"max_rates": 100}}, "list"),
    ({"snn": {"max_rates": ["a"]}}, "number"),
    ({"cnn": {"learning_rate": float("nan")}},),
    ({"snn": {"tau_rc": float("inf")}},),
    ({"snn": {"tau_rc": 1e300}},),
    ({"seed": {"x": 1}},),
    ({"seed": -1}, 0),
    ({"seed": 2**31}, 0),
    ({"input": {"kind": "frames"}}, "image", "events"),
    ({"image": {"aggregation": "total"}}, "count", "columns"),
    ({"image": {"normalisation": "mean"}}, "max", "sum"),
    ({"split": {"test_fraction": 1.0}}, 0, 1),
    ({"split": {"test_fraction": 0}}, 0, 1),
    ({"split": {"validation_fraction": 1}}, 0, 1),
    ({"snn": {"noise": -1}}, 0),
    ({"cnn": {"batch_size": 0}}, 1),
    ({"cnn": {"learning_rate": 0}}, 0),
    ({"snn": {"recipe": "magic"}}, "loihi", "paper"),
    ({"snn": {"max_rates": [1, 2, 3]}}, "1 to 2"),
    ({"snn": {"max_rates": []}}, "1 to 2"),
    ({"snn": {"max_rates": [0]}}, "1 to 2"),
    ({"snn": {"max_rates": [1000]}}, "snn.tau_ref", 1000),
    ({"snn": {"tau_ref": 0}}, "1e-09"),
    ({"deployment": {"readout": "gpu"}}, "chip", "host"),
    ({"deployment": {"input_rate": 1001}}, 1000),
    ({"deployment": {"input_phase": 1}}, 0),
    ({"deployment": {"synapse": -1}}, 1000),
    ({"presentation": {"steps": -1}}, 10000),
    ({"presentation": {"gap": -1}}, 10000),
    ({"presentation": {"gap": 10**22}},),
    ({"presentation": {"steps": 15}}, "presentation.readout_start", 15),
    ({"presentation": {"stream_length": 0}}, 1000000),
    ({"check": {"samples": -1}}, 0),
    ({"check": {"samples": 10**12}}, 1000000),
    ({"cnn": {"architecture": "10x10-6p2-10o"}}, "6p2"),
    ({"cnn": {"architecture": "10x10-10o"}},),
]


def dotted(changes):
    """The name of a changed setting."""
    ((name, value),) = changes.items()
    return f"{name}.{dotted(value)}" if isinstance(value, dict) and name != "seed" else name


@pytest.mark.parametrize("case", BAD, ids=lambda case: f"{dotted(case[0])}-{case[1:]}")
def test_a_wrong_setting_is_named(case):
    changes, *facts = case
    with pytest.raises(UserError) as caught:
        Settings().with_values(changes, "my.toml")
    line = str(caught.value)
    assert line.startswith("my.toml: ")
    assert len(line.splitlines()) == 1
    assert missing(line, dotted(changes), *facts) == []


@pytest.mark.parametrize("names", [("nir", "file", "sha256"), ("cnn", "model", "model_sha256")])
def test_an_imported_network_stays_in_its_run(names):
    section, file, content = names
    imported = Settings().with_values({section: {file: "own.file", content: 64 * "0"}}, "here")
    with pytest.raises(UserError, match=f"{section}.{file}.* new RUN"):
        imported.with_values({section: {file: ""}}, "there")


def test_a_whole_number_will_do_for_a_fraction():
    assert Settings().with_values({"snn": {"max_rates": [100]}}, "").snn.max_rates == (100.0,)


def test_values_of_numpy_and_paths_become_plain(tmp_path):
    changes = {
        "data": {"samples_per_digit": np.int64(3), "source": tmp_path / "a.zip"},
        "events": {"dropout": np.float32(0.5)},
    }
    settings = Settings().with_values(changes, "here")
    write_settings(tmp_path / "own.toml", settings)
    assert read_settings(tmp_path / "own.toml").data == settings.data
    assert settings.events.dropout == 0.5


def test_recordings_are_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Settings().with_values({"data": {"source": "own"}}).data.source == str(tmp_path / "own")
    assert Settings().with_values({"seed": 1}).data.source == "simulated"


def test_assignments_of_the_command_line():
    values = parse_assignments(
        [
            "seed=3",
            "cnn.epochs = 5",
            "data.source=a b.zip",
            "snn.max_rates=[1, 2.5]",
            "data.skip_bad=true",
            "data.source=x=y",
        ]
    )
    assert values == {
        "seed": 3,
        "cnn": {"epochs": 5},
        "data": {"source": "x=y", "skip_bad": True},
        "snn": {"max_rates": [1, 2.5]},
    }
    assert parse_assignments(["snn.max_rates=100"]) == {"snn": {"max_rates": [100]}}
    assert parse_assignments(["data.source=2024"]) == {"data": {"source": "2024"}}


def test_one_word_of_the_command_line_may_have_several_settings():
    word = "seed=3  snn.max_rates=[150, 100] data.source=my own events check.samples=7"
    assert parse_assignments([word]) == {
        "seed": 3,
        "snn": {"max_rates": [150, 100]},
        "data": {"source": "my own events"},
        "check": {"samples": 7},
    }


@pytest.mark.parametrize(
    "assignments",
    [
        ["epochs"],
        ["=3"],
        [""],
        ["cnn=5", "cnn.epochs=3"],
        ["cnn.epochs=3", "cnn=5"],
        ["seed=1", "seed.x=2"],
        ["seed.x=2", "seed=1"],
    ],
)
def test_assignments_that_make_no_sense(assignments):
    with pytest.raises(UserError, match="--set"):
        parse_assignments(assignments)


def test_settings_come_from_folder_file_and_command_line_in_this_order(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.save_settings(run.resolve_settings(None, {"seed": 3, "cnn": {"epochs": 7}}))
    assert run.resolve_settings(None, {}).seed == 3
    write_settings(tmp_path / "base.toml", Settings().with_values({"cnn": {"epochs": 9}}, ""))
    resolved = run.resolve_settings(tmp_path / "base.toml", {"seed": 4})
    assert (resolved.seed, resolved.cnn.epochs) == (4, 9)
    assert run.resolve_settings(None, {}).cnn.epochs == 7  # until they are saved


def test_every_setting_is_listed_with_its_meaning():
    described = describe_settings(Settings())
    assert [row["name"] for row in described] == list(Settings().flatten())
    assert {row["name"].split(".")[0] for row in described} == {
        e.name for e in fields(Settings) if e.init
    }
    for row in described:
        assert row["value"] == row["default"]
        assert row["meaning"].endswith("."), row["name"]
        assert "\n" not in row["meaning"]


def test_the_listing_marks_what_a_run_has_otherwise(tmp_path, capsys):
    write_settings(tmp_path / "experiment.toml", Settings().with_values({"seed": 3}, ""))
    assert call("settings", tmp_path) == 0
    heading, first, meaning, *rest = capsys.readouterr().out.splitlines()
    assert heading.startswith("# ")
    assert first == "* seed = 3  (default 0)"
    assert max(map(len, rest)) <= 80
    assert meaning.startswith("      ")
    assert not [line for line in rest if line.startswith("*")]
    assert call("settings", tmp_path, "--json") == 0
    seed, source, *_ = json.loads(capsys.readouterr().out)
    assert (seed["name"], seed["value"], seed["default"]) == ("seed", 3, 0)
    assert source["value"] == "simulated"
    assert call("settings", tmp_path / "none") == 2
    assert "experiment.toml: " in capsys.readouterr().err


def test_two_processes_cannot_work_in_one_run(tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.lock(), pytest.raises(UserError, match=f"{run.path}: .*RUN"), run.lock():
        pass
    with run.lock():
        pass


def test_steps_that_are_left_open():
    """A hundred for images; with events what the two seconds of a recording take."""
    settings = Settings()
    assert (settings.steps, settings.input.refractory_steps) == (100, 1)
    for step, refractory, expected in (
        (10, 10, (200, 1)),
        (20, 10, (100, 0)),
        (0.1, 0.3, (10000, 3)),
    ):
        changes = {"input": {"kind": "events", "step": step, "refractory": refractory}}
        on_events = settings.with_values(changes)
        assert (on_events.make_presentation().steps, on_events.input.refractory_steps) == expected
        assert on_events.with_values({"presentation": {"steps": 7}}).make_presentation().steps == 7


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("epochs", ["'cnn.epochs'", "'snn.epochs'", "'events.epochs'"]),
        ("events.epoch", ["'events.epochs'"]),
        ("xyz", ["stmnist settings"]),
    ],
)
def test_an_unknown_name_is_answered_with_known_ones(name, known):
    section, _, entry = name.rpartition(".")
    values = {section: {entry: 3}} if section else {entry: 3}
    with pytest.raises(UserError) as caught:
        Settings().with_values(values, "--set")
    assert all(each in str(caught.value) for each in known)
