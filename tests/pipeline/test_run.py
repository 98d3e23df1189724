"""A run is begun only where nothing else is, and a command that fails leaves nothing."""

import pytest

from deploy.errors import UserError
from pipeline.settings import Choice, Provenance, Settings, apply_choices, read_settings
from pipeline.storage.run_folder import RunFolder, find_checks_folder
from pipeline.workflow import open_locked_run
from tests.command import call


def test_a_bundle_is_no_run(tmp_path, capsys):
    bundle = tmp_path / "own" / "bundle"
    bundle.mkdir(parents=True)
    (bundle / "MANIFEST.json").write_text("{}")
    (tmp_path / "own" / "experiment.toml").write_text("")
    assert call("ladder", bundle) == 2
    assert str(tmp_path / "own") in capsys.readouterr().err
    assert [entry.name for entry in bundle.iterdir()] == ["MANIFEST.json"]


@pytest.mark.parametrize("command", [
    ("sweep", "RUN"),
])  # fmt: skip
def test_a_run_does_not_become_the_folder_of_a_benchmark(tmp_path, capsys, command):
    """Its settings would be replaced by those of the benchmark, and its results be outdated."""
    for name in ("experiment.toml", "dataset.json"):
        (tmp_path / name).write_text("")
    assert call(*(tmp_path if word == "RUN" else word for word in command)) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert (tmp_path / "experiment.toml").read_text() == ""


def test_a_folder_of_other_things_is_no_run(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("")
    assert call("ladder", tmp_path) == 2
    assert "thesis.tex" in capsys.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("arguments", [
    ("--data", "nowhere.zip"), ("--set", "cnn.epoch=5"), ("--settings", "nothing.toml"),
])  # fmt: skip
def test_a_failed_command_leaves_no_folder(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    assert call("ladder", tmp_path / "runs" / "new", *arguments) == 2
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty").mkdir()
    assert call("ladder", tmp_path / "empty", *arguments) == 2
    assert list((tmp_path / "empty").iterdir()) == []


def test_results_of_bundles_side_by_side_do_not_replace_each_other(tmp_path):
    (tmp_path / "experiment.toml").touch()
    names = ("bundle", "adapted/7", "copied/bundle")
    folders = [find_checks_folder(tmp_path / name) for name in names]
    assert folders == [
        tmp_path / name for name in ("checks", "adapted/7/checks", "copied/bundle/checks")
    ]


def test_what_was_chosen_is_no_setting_of_the_user(tmp_path):
    run, own = RunFolder(tmp_path), Settings().with_values({"seed": 3})
    values = {"input.step": 20.0, "input.refractory": 20.0, "presentation.steps": 171}
    values["events.tau_u_ms"] = (9.0,)  # a list in the file
    chosen = apply_choices(own, [Choice(name, value) for name, value in values.items()])
    run.save_settings(chosen)
    read = read_settings(run.experiment)
    assert read == chosen
    assert {name: read.find_provenance(name) for name in read.flatten()} == {
        name: chosen.find_provenance(name) for name in chosen.flatten()
    }
    assert set(read.list_names(Provenance.CHOSEN)) == set(values)
    assert read.list_names(Provenance.USER) == ("seed",)
    assert run.resolve_settings(None, {}) == own
    changed = run.resolve_settings(None, {"input": {"step": 5.0}})
    assert changed == own.with_values({"input": {"step": 5.0}})
    text = run.experiment.read_text()
    assert text.count("171") == 2  # the value, and that it was chosen
    run.experiment.write_text(text.replace("\nsteps = 171", "\nsteps = 90"))  # the user edits it
    assert run.resolve_settings(None, {}) == own.with_values({"presentation": {"steps": 90}})
    run.experiment.write_text(text.replace("\nrefractory = 20.0", "\nrefractory = 10.0"))
    edited = run.resolve_settings(None, {})  # to the default, which is the user's too
    assert edited.input.refractory == 10
    assert not edited.is_open("input.refractory")
    assert edited.is_open("input.step")
    for wrong in ('["seed"]', '{"no.such" = 1}'):
        run.experiment.write_text(f"chosen = {wrong}\n")
        with pytest.raises(UserError, match="chosen"):
            run.resolve_settings(None, {})
    run.experiment.write_text('chosen = {"cnn.epochs" = 7}\ncnn = 3\n')
    with pytest.raises(UserError, match="cnn"):
        run.resolve_settings(None, {})


def test_from_python_too_a_run_begins_only_in_a_folder_of_its_own(tmp_path):
    """A run that cannot be opened leaves no file, and the lock is held until the block ends."""
    missing = Settings().with_values({"data": {"source": str(tmp_path / "none.zip")}})
    with (
        pytest.raises(UserError, match=r"none\.zip"),
        open_locked_run(tmp_path / "new/run", missing),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(UserError, match=r"thesis\.tex"), open_locked_run(tmp_path, Settings()):
        pass
    small = Settings().with_values({"data": {"samples_per_digit": 5}, "check": {"samples": 5}})
    with open_locked_run(tmp_path / "run", small, say=[].append):
        pass
    with open_locked_run(tmp_path / "run", {"seed": 3}, say=[].append) as opened:
        assert (opened.settings.seed, opened.settings.data.samples_per_digit) == (3, 5)
        assert opened.settings.is_open("events.dropout")
        assert opened.settings == read_settings(tmp_path / "run/experiment.toml")
        with (
            pytest.raises(UserError, match="another process"),
            open_locked_run(opened.store.path, small),
        ):
            pass
