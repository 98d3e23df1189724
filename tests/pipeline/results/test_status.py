"""The state of a run's artifacts after its settings, its recordings or its files have changed."""

import json
import re
import shutil

from deploy.files import read_json
from pipeline.results.status import describe_outdated
from pipeline.storage.run_folder import RunFolder
from tests.command import call

ON_IMAGES = [
    *("dataset", "counts", "cnn", "cnn-matched", "rate-lif", "bundle"),
    *(
        f"checks/{s}"
        for s in (
            "counts",
            "cnn",
            "cnn-matched",
            "rate-lif",
            "spiking-lif",
            "nengo",
            "simreal",
            "emulator",
        )
    ),
    "ladder",
]
CHANGED = r"cnn\.epochs\b.* 3 .* 1\b"


def states(run, capsys):
    """What ``stmnist status --json`` says, by artifact."""
    capsys.readouterr()
    assert call("status", run, "--json") == 0
    found = json.loads(capsys.readouterr().out)["artifacts"]
    return {artifact["name"]: artifact for artifact in found}


def test_a_finished_run_is_current(run, capsys):
    found = states(run, capsys)
    assert list(found) == ON_IMAGES
    assert {artifact["state"] for artifact in found.values()} == {"current"}
    accuracy = read_json(run / "cnn/metrics.json", "")["accuracy"]["test"]
    assert found["cnn"]["accuracy"] == accuracy
    assert found["cnn"]["seconds"] > 0
    assert call("status", run) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_a_trained_cnn_makes_what_was_made_from_another_outdated(run, capsys):
    assert call("train", run, "--set", "cnn.epochs=1") == 0
    assert re.search(CHANGED, capsys.readouterr().err)
    found = states(run, capsys)
    assert (found["dataset"]["state"], found["cnn"]["state"]) == ("current", "current")
    for name in ON_IMAGES[3:]:
        assert found[name]["state"] == "outdated", name
        assert found[name]["because"] == ["cnn.epochs changed from 3 to 1"], name
    capsys.readouterr()
    # Whatever shows the outdated results says so, with the reason.
    other = shutil.copytree(run, run.parent / "other")
    assert call("compare", run, other) == 0
    assert re.search(CHANGED, " ".join(capsys.readouterr().out.split()))
    assert call("compare", run, other, "--json") == 0
    first = json.loads(capsys.readouterr().out)["runs"][0]
    assert set(first["outdated"]) == set(ON_IMAGES[3:])
    assert call("check", "run", run / "bundle", "--target", "fast") == 0
    assert re.search(CHANGED, capsys.readouterr().err)
    for deploy in (
        ("plan", run),
        ("energy", run),
        ("export", run, "--format", "nir", "--out", run.parent / "network.nir"),
    ):
        assert call("deploy", *deploy) == 0
        assert re.search(CHANGED, capsys.readouterr().err), deploy
    assert "outdated" in describe_outdated(run / "checks" / "emulator.json")
    assert call("report", run) == 0
    assert re.search(CHANGED, (run / "report.html").read_text())


def test_an_answer_to_an_earlier_bundle_is_outdated(run, capsys):
    path = run / "checks" / "nengo.json"
    result = read_json(path, "")
    path.write_text(json.dumps({**result, "bundle": "0" * 64}))
    found = states(run, capsys)
    assert found["checks/nengo"]["state"] == found["ladder"]["state"] == "outdated"
    assert found["checks/emulator"]["state"] == "current"


def test_a_bundle_adapted_from_an_earlier_network_is_outdated(run, capsys):
    adapted = shutil.copytree(run / "bundle", run / "adapted" / "7")
    assert states(run, capsys)["adapted/7"]["state"] == "current"
    assert describe_outdated(adapted) is None
    settings = run / "experiment.toml"
    settings.write_text(settings.read_text().replace("epochs = 3\n", "epochs = 2\n", 1))
    assert states(run, capsys)["adapted/7"]["state"] == "outdated"
    assert f"stmnist adapt {run}" in describe_outdated(adapted)
    assert "stmnist adapt" not in describe_outdated(run / "bundle")


def test_missing_artifacts_are_missing(run, capsys):
    (run / "snn" / "weights.npz").unlink()
    (run / "checks" / "nengo.json").unlink()
    (run / "ladder.json").unlink()
    found = states(run, capsys)
    absent = {name for name, artifact in found.items() if artifact["state"] == "missing"}
    assert absent == {"rate-lif", "checks/nengo", "ladder"}


def test_a_bundle_without_one_of_its_files_is_missing_and_made_again(run, capsys):
    (run / "bundle" / "weights.npz").unlink()
    assert states(run, capsys)["bundle"]["state"] == "missing"
    assert call("convert", run) == 0
    assert states(run, capsys)["bundle"]["state"] == "current"


def test_a_folder_without_a_run_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("")
    assert call("status", tmp_path) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"thesis.tex"}


def test_moved_recordings_are_still_the_same(tmp_path, capsys):
    """Where the zip lies is no part of what a network was made from."""
    assert call("data", "simulate", "--out", tmp_path / "a.zip", "--samples-per-digit", 4) == 0
    (tmp_path / "there").mkdir()
    run = tmp_path / "run"
    tiny = ("--set", "cnn.epochs=1", "--jobs", 1)
    assert call("train", run, "--data", tmp_path / "a.zip", *tiny) == 0
    before = (run / "cnn" / "weights.npz").stat().st_mtime_ns
    moved = (tmp_path / "a.zip").rename(tmp_path / "there" / "a.zip")
    assert states(run, capsys)["cnn"]["state"] == "current"  # while nothing lies at the old place
    assert call("status", run) == 0
    assert "a.zip" in capsys.readouterr().err  # the recordings could not be compared
    assert call("train", run, "--data", moved) == 0
    assert (run / "cnn" / "weights.npz").stat().st_mtime_ns == before
    assert read_json(RunFolder(run).dataset, "")["made_from"]["contents"].keys() >= {"recordings"}
