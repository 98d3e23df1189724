"""The benchmarks over splits: measured once, kept, gone on with; a failure is said."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.errors import CheckFailed, UserError
from deploy.files import read_json
from pipeline import jobs
from pipeline.artifacts import Artifact, Library, Origin
from pipeline.experiments import choices as conversion_choices
from pipeline.experiments import losses, sweep, table2
from pipeline.experiments import study as experiments_study
from pipeline.experiments.study import Task, Workers, _work, study
from pipeline.run import refuse_results
from pipeline.settings import Settings
from tests.command import call, missing
from tests.own_sensor import write_folder


def half(number, folder, content="0"):
    """A task: half a number, kept in a file."""
    origin = Origin(contents={"version": content})
    artifact = Artifact(str(number), folder / f"{number}.json", origin)
    settings = Settings().only(["seed"])
    return Task(artifact, settings, "", Library(folder), subject=str(number))


def halve(task):
    number = int(task.subject)
    if number % 2:
        raise ArithmeticError(f"{number} is odd")
    return {"half": number // 2}


def test_a_study_keeps_its_results_and_continues(tmp_path):
    tasks, said = [half(number, tmp_path) for number in (4, 3, 8)], []
    found = study("halves", halve, [tasks[:2], tasks[2:]], Workers(1), said.append)
    assert (found["4"]["half"], found["8"]["half"]) == (2, 4)
    assert found["3"].error == "ArithmeticError: 3 is odd"
    assert len(said) == 1
    assert "3 is odd" in said[0]
    kept = read_json(tasks[0].artifact.record, "")
    assert kept == {"made_from": tasks[0].origin.to_json(), "half": 2}
    assert not tasks[1].artifact.record.exists()

    asked = []

    def truncate(task):
        asked.append(task)
        return {"half": int(task.subject) // 2}

    found = study("halves", truncate, [tasks], Workers(1), said.append)
    assert asked == [tasks[1]]
    assert [found[str(number)]["half"] for number in (4, 3, 8)] == [2, 1, 4]
    asked.clear()
    said.clear()
    outdated = [half(4, tmp_path, "1")]
    study("halves", truncate, [outdated], Workers(1), said.append)
    assert asked == outdated
    assert re.search("version .*0 .*1", said[0])


def test_a_mistake_of_the_users_is_said_as_it_is(tmp_path):
    tasks, said = [half(number, tmp_path) for number in (2, 4, 6)], []

    def refuse(task):
        raise UserError("snn.tau_rc: 0; " + "give a longer one " * 20)

    found = study("halves", refuse, [tasks], Workers(1), said.append)
    assert said == [found["2"].details] == [found["6"].details]
    assert said[0].endswith("give a longer one ")
    assert "Traceback" not in said[0]


def test_a_study_on_a_cluster(tmp_path):
    distributed = pytest.importorskip("distributed")
    tasks, said = [half(number, tmp_path) for number in (4, 3)], []
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        workers = Workers(scheduler=cluster.scheduler_address)
        found = study("halves", halve, [[task] for task in tasks], workers, said.append)
    assert read_json(tasks[0].artifact.record, "")["half"] == 2
    assert found["3"].error == "ArithmeticError: 3 is odd"


def test_a_worker_of_another_version_is_found_out(tmp_path):
    with pytest.raises(UserError, match=r"not 0\.0\.0"):
        _work(halve, "0.0.0", [half(4, tmp_path)])


@pytest.mark.parametrize(
    "command",
    [
        ("sweep", "runs/x"),
        ("benchmark", "losses"),
        ("benchmark", "conversion"),
        ("benchmark", "events"),
        ("benchmark", "table2", "--set", "check.samples=5"),
    ],
)
def test_every_experiment_takes_a_scheduler(command, tmp_path, monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jobs, "PATIENCE", 0.1)
    assert call(*command, "--scheduler", "tcp://127.0.0.1:1", *TINY) == 2
    assert "tcp://127.0.0.1:1" in capsys.readouterr().err


TINY = [
    *("--jobs", "1", "--set", "seed=7", "--set", "data.samples_per_digit=6"),
    *("--set", "cnn.epochs=1", "--set", "snn.epochs=1", "--json"),
]
MEASURED = {
    "conversion": (conversion_choices, "--splits"),
    "losses": (losses, "--seeds"),
}
"""Experiments over random splits: module, option of their number."""


@pytest.fixture
def one_choice(monkeypatch):
    """Of all that the conversion is measured under."""
    chosen = [choice for choice in conversion_choices.CHOICES if choice.title == "50 steps"]
    monkeypatch.setattr(conversion_choices, "CHOICES", tuple(chosen))


@pytest.mark.slow
@pytest.mark.parametrize("name", MEASURED)
def test_a_split_is_measured(name, one_choice, tmp_path, capsys):
    _, number = MEASURED[name]
    out = tmp_path / name
    assert call("benchmark", name, "--out", out, number, "1", *TINY) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["simulated"]
    assert summary["seeds"] == [7]
    assert summary["n_test"] == 12
    assert json.loads((out / f"{name}.json").read_text()) == summary


@pytest.mark.slow
def test_losses_of_a_network_on_events(tmp_path, capsys):
    out, tiny = tmp_path / "losses", ("--set", "events.epochs=1", "--set", "input.step=500")
    command = ("benchmark", "losses", "--input", "events", "--out", out, "--seeds", "1")
    assert call(*command, *TINY, *tiny) == 0
    summary = json.loads(capsys.readouterr().out)
    assert list(summary["accuracy"]) == ["cnn", "cnn-annealed", "trained", "chip"]
    assert list(summary["disagreements"]) == list(summary["operations"]) == ["chip"]
    assert not list(out.glob("*.npz"))


FIGURES = {"cnn": 0.5, "cnn-annealed": 0.6, "chip-100": 0.4}
MADE_UP = {
    "conversion": {"rate": {"150.0": 0.5}, "choices": [0.4, 0.3]},
    "losses": {
        "accuracy": FIGURES,
        **{name: {"chip-100": 1.0} for name in ("disagreements", "operations")},
        "decided_at_median": {"chip-100": 30.0},
    },
}


@pytest.mark.parametrize("name", MEASURED)
def test_splits_are_measured_once_and_failed_ones_tried_again(
    name, one_choice, tmp_path, monkeypatch, capsys
):
    module, number = MEASURED[name]
    out, asked, lost = tmp_path / name, [], set()

    def measure(job):
        asked.append(job.seed)
        if job.seed in lost:
            raise OSError("lost")
        return {"seed": job.seed, "n_train": 48, "n_test": 12, **MADE_UP[name]}

    monkeypatch.setattr(module, "EXPERIMENT", replace(module.EXPERIMENT, measure=measure))
    command = ["benchmark", name, "--out", out, number, "2", *TINY]
    assert call(*command) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["seeds"] == asked == [7, 8]
    with pytest.raises(UserError, match="not of a run"):
        refuse_results(out)
    assert call(*command) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert asked == [7, 8]
    (out / "split-08.json").unlink()
    lost.add(8)
    assert call(*command) == 1
    assert asked == [7, 8, 8]
    captured = capsys.readouterr()
    assert json.loads(captured.out)["seeds"] == [7]
    assert "lost" in captured.err
    assert "split 8 " in captured.err
    assert call(*command, "--set", "slayer.epochs=2") == 1  # which nothing here depends on
    assert asked == [7, 8, 8, 8]
    capsys.readouterr()
    assert call(*command, "--set", "cnn.epochs=2") == 1
    assert asked == [7, 8, 8, 8, 7, 8]
    assert re.search("cnn.epochs .*1 .*2", capsys.readouterr().err)


def test_a_new_folder_of_results_names_their_recordings(tmp_path, monkeypatch, capsys):
    """All kinds of experiment, once for each folder, before anything is measured."""
    for module in (experiments_study, table2, sweep):
        monkeypatch.setattr(module, "study", lost)
    own = str(write_folder(tmp_path / "own", per_class=4))
    few = ("--jobs", "1", "--set", "data.samples_per_digit=6", "--set", "check.samples=2")
    for name, *command in (
        ("losses", "benchmark", "losses", "--seeds", "1", "--out"),
        ("table2", "benchmark", "table2", "--splits", "1", "--models", "cnn", "--out"),
        ("sweep", "sweep"),
    ):
        for source, data, told in ((own, ("--data", own), own), ("simulated", (), "--data")):
            out = tmp_path / f"{name} of {Path(source).name}"
            for times in (1, 0):
                assert call(*command, out, *data, *few) == 1
                said = [line for line in capsys.readouterr().err.splitlines() if str(out) in line]
                assert len(said) == times
                assert all(missing(line, source, told) == [] for line in said)


def lost(*arguments):
    raise CheckFailed("nothing is measured here")


def test_an_output_read_too_late_is_said_before_anything_is_trained(tmp_path, capsys):
    command = ["benchmark", "losses", "--out", tmp_path / "losses", "--seeds", "1", *TINY]
    assert call(*command, "--set", "presentation.readout_start=60") == 2
    error = capsys.readouterr().err
    assert "presentation.readout_start" in error
    assert len(error.strip().splitlines()) == 1
