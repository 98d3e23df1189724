"""Options that verbs share."""

import io
import sys
from pathlib import Path

import pytest

from deploy.errors import UserError
from pipeline.commands import options
from pipeline.settings import Settings, read_settings, write_settings
from tests.command import call, missing


def test_options_and_what_is_set_besides(tmp_path):
    assignments = ["check.samples=50", "cnn.epochs=7"]
    given = options.RequestedSettings(seed=3, samples=50, assignments=assignments)
    with options.lock_and_resolve_settings(tmp_path / "run", given) as (folder, resolved):
        assert folder.path == tmp_path / "run"
        assert (resolved.seed, resolved.check.samples, resolved.cnn.epochs) == (3, 50, 7)


@pytest.mark.parametrize(
    ("option", "given", "assignment"),
    [
        ("--seed", {"seed": 1}, "seed=2"),
        ("--samples", {"samples": 50}, "check.samples=100"),
        ("--data", {"data": "simulated"}, "data.source=own.zip"),
    ],
)
def test_an_option_and_another_value_of_its_setting_are_refused(option, given, assignment):
    with pytest.raises(UserError, match=f"^{option}: .*{assignment}"):
        options.RequestedSettings(assignments=[assignment], **given).list_changes()


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        ("ladder runs/x --input frames", ["input.kind", "image, slices, events"]),
        ("ladder runs/x --samples many", ["--samples"]),
        ("ladder runs/x --jobs 0", ["--jobs", "1"]),
        ("ladder runs/x --set cnn.epoch=5", ["cnn.epochs"]),
        ("ladder runs/x --set check=5 --samples 3", ["--samples", "check"]),
        ("ladder runs/x --epochs 5", ["--epochs"]),
        ("ladder runs/x more", ["more"]),
        ("lader runs/x", ["ladder"]),
        ("check run runs/x --target chip", ["chip", "emulator"]),
        ("deploy export runs/x --format onnx --out x", ["--format", "nir"]),
        ("data import x --set data.downsample=0", ["downsample", "1"]),
        ("data simulate --out x.zip --samples-per-digit many", ["--samples-per-digit"]),
    ],
)
def test_a_slip_is_one_line(words, facts, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call(*words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert missing(line, *facts) == []
    assert list(tmp_path.iterdir()) == []


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_the_next_command_is_suggested_at_a_terminal_only(monkeypatch, capsys):
    options.suggest("report", "runs/a")
    assert capsys.readouterr() == ("", "")
    error = Terminal()
    monkeypatch.setattr(sys, "stderr", error)
    options.suggest("report", "runs/a")
    assert error.getvalue() == ""  # the answer goes to a file or a pipe
    monkeypatch.setattr(sys, "stdout", Terminal())
    options.suggest("ladder", Path("runs/my own"), "--data", "a b.zip")
    assert error.getvalue() == "next: stmnist ladder 'runs/my own' --data 'a b.zip'\n"


def test_a_training_that_is_refused_saves_no_settings(tmp_path, capsys):
    imported = Settings().with_values({"nir": {"file": "graph.nir", "sha256": "a"}})
    write_settings(tmp_path / "experiment.toml", imported)
    assert call("train", tmp_path, "--set", "seed=7") == 2
    assert "graph.nir" in capsys.readouterr().err
    assert read_settings(tmp_path / "experiment.toml") == imported
