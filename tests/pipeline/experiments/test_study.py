"""The benchmarks over splits: measured once, kept, gone on with; a failure is said."""

import json

import pytest

from pipeline.experiments import choices as conversion_choices
from pipeline.experiments import losses
from tests.command import call

TINY = [
    "--jobs",
    "1",
    "--set",
    "seed=7",
    "--set",
    "data.samples_per_digit=6",
    "--set",
    "cnn.epochs=1",
]
TINY += ["--set", "snn.epochs=1", "--json"]
BENCHMARKS = {"conversion": (conversion_choices, "--splits"), "losses": (losses, "--seeds")}


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHMARKS)
def test_command_measures_once_and_goes_on(name, tmp_path, monkeypatch, capsys):
    module, number = BENCHMARKS[name]
    two = [c for c in conversion_choices.CHOICES if c.title == "50 steps"]
    monkeypatch.setattr(conversion_choices, "CHOICES", tuple(two))
    out = tmp_path / name
    command = ["benchmark", name, "--out", out, number, "2", *TINY]
    assert call(*command) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["simulated"]
    assert first["seeds"] == [7, 8]
    assert first["n_test"] == 12
    assert json.loads((out / f"{name}.json").read_text()) == first

    def measure(job):
        asked.append(job.seed)
        raise OSError("lost")

    asked = []
    monkeypatch.setattr(module, "measure", measure)
    assert call(*command) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert asked == []
    (out / "split-08.json").unlink()
    assert call(*command) == 1
    assert asked == [8]
    captured = capsys.readouterr()
    assert json.loads(captured.out)["seeds"] == [7]
    assert "lost" in captured.err
    assert "splits [8] failed" in captured.err


def test_an_output_read_too_late_is_said_before_anything_is_trained(tmp_path, capsys):
    command = ["benchmark", "losses", "--out", tmp_path / "losses", "--seeds", "1", *TINY]
    assert call(*command, "--set", "presentation.readout_start=60") == 2
    error = capsys.readouterr().err
    assert "presentation.readout_start" in error
    assert len(error.strip().splitlines()) == 1
