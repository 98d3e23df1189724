"""A run on events through every stage: trained, bundle, targets, ladder; and what is refused."""

import json
import shutil

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.errors import UserError
from deploy.files import read_json
from pipeline.training import events
from pipeline.training.events import checkpoint
from tests.command import call, missing

TINY = (
    *("--input", "events", "--set", "data.samples_per_digit=40", "--set", "events.epochs=2"),
    *("--set", "events.architecture=10x10x2-4c4s3-16-10o"),
    *("--set", "input.step=100", "--set", "input.refractory=100"),
    *("--set", "split.validation_fraction=0.4"),  # enough to choose a confidence on
    *("--steps", "24", "--samples", "12"),
)


@pytest.fixture(scope="module")
def run_on_events(made_once):
    """A finished run on events, trained badly, but through every stage."""

    def make(folder):
        assert call("ladder", folder / "events", *TINY) == 0

    return made_once("on-events", make) / "events"


def test_the_ladder_begins_with_what_was_trained(run_on_events):
    ladder = read_json(run_on_events / "ladder.json", "")
    stages = [row["stage"] for row in ladder["rows"]]
    assert stages == ["counts", "trained", "nengo", "simreal", "emulator"]
    assert ladder["n_samples"] == 12


def test_the_samples_are_frames_of_the_recordings_own_events(run_on_events):
    bundle = read_bundle(run_on_events / "bundle")
    assert bundle.checks.inputs.shape == (12, 24, 10, 10, 2)
    assert set(np.unique(bundle.checks.inputs)) == {0, 1}
    assert bundle.spec.stimulus.step_seconds == pytest.approx(0.1)
    assert bundle.spec.presentation.readout_start == 0
    input_spikes = read_result(run_on_events / "checks" / "emulator.json")["spikes"]["input"]
    assert input_spikes == bundle.checks.inputs.sum()


def test_fast_gives_every_spike_of_the_emulator(run_on_events, tmp_path):
    out = tmp_path / "fast.json"
    assert call("check", "run", run_on_events / "bundle", "--target", "fast", "--out", out) == 0
    result = read_result(out)["samples"]
    expected = read_result(run_on_events / "checks" / "emulator.json")["samples"]
    for name in ("spike_hash", "prediction", "stopped_at"):
        assert [s[name] for s in result] == [s[name] for s in expected]


def test_the_result_says_when_each_sample_was_decided(run_on_events):
    result = read_result(run_on_events / "checks" / "emulator.json")
    bundle = read_bundle(run_on_events / "bundle")
    written = result["while_written"]
    early = written["by_itself"]
    assert early["confidence"] == bundle.spec.presentation.threshold
    assert 0 < early["share_of_writing_mean"] <= 1
    assert len(written["accuracy"]) == len(written["shares"]) == 10
    steps = bundle.spec.presentation.steps
    for sample in result["samples"]:
        assert 1 <= sample["stopped_at"] <= steps
    busy = bundle.checks.inputs.any((2, 3, 4))
    last = steps - np.argmax(busy[:, ::-1], 1)
    assert written["written_steps_mean"] == pytest.approx(last.mean())


def test_the_confidence_was_chosen_on_samples_that_were_not_trained_on(run_on_events):
    metrics = read_json(run_on_events / "snn" / "metrics.json", "")
    dataset = read_json(run_on_events / "dataset.json", "")
    assert metrics["decides_by_itself"]["samples"] == dataset["validation"] == 128


def test_nothing_is_done_twice_and_no_checkpoint_is_left(run_on_events):
    made = (run_on_events / "snn" / "weights.npz", *(run_on_events / "bundle").iterdir())
    before = [path.stat().st_mtime_ns for path in made]
    assert call("ladder", run_on_events) == 0
    assert [path.stat().st_mtime_ns for path in made] == before
    assert not (run_on_events / "snn" / "checkpoint.npz").exists()


def test_the_network_fits_on_the_chip(run_on_events, capsys):
    assert call("deploy", "plan", run_on_events / "bundle", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["problems"] == []


def test_energies_are_called_estimates(run_on_events, capsys):
    assert call("deploy", "energy", run_on_events / "bundle") == 0
    assert "ESTIMATE" in capsys.readouterr().out


def test_the_report_is_that_of_a_network_on_events(run_on_events, tmp_path):
    page = tmp_path / "report.html"
    assert call("report", run_on_events, "--out", page) == 0
    text = page.read_text(encoding="utf-8")
    assert "Rate LIF" not in text
    assert " of 1 ms" not in text
    early = read_result(run_on_events / "checks" / "emulator.json")["while_written"]["by_itself"]
    decides = f"after {early['share_of_writing_mean']:.1%} of the recording"
    assert early["confidence"] == 1 or decides.replace("%", " %") in text


def test_another_kind_of_input_makes_another_network(run_on_events, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(run_on_events, folder)
    assert call("train", folder, "--input", "image", "--set", "cnn.epochs=1") == 0
    said = capsys.readouterr().err
    assert (folder / "cnn" / "weights.npz").exists()
    assert "'events' is replaced by 'image'" in said
    states = {each["name"]: each["state"] for each in _artifacts(folder, capsys)}
    assert (states["cnn"], states["rate-lif"], states["bundle"]) == (
        "current",
        "missing",  # the other network of the run is one on events
        "outdated",
    )
    assert call("train", folder) == 0
    assert "is replaced by" not in capsys.readouterr().err


def _artifacts(folder, capsys):
    capsys.readouterr()
    assert call("status", folder, "--json") == 0
    return json.loads(capsys.readouterr().out)["artifacts"]


def test_a_training_that_was_interrupted_is_in_the_status(tmp_path, capsys, monkeypatch):
    store = checkpoint._store

    def store_and_stop(*given):
        store(*given)
        raise UserError("stopped")

    monkeypatch.setattr(checkpoint, "_store", store_and_stop)
    folder = tmp_path / "run"
    assert call("train", folder, *TINY[:-4], "--set", "data.samples_per_digit=10") == 2
    by_name = {each["name"]: each for each in _artifacts(folder, capsys)}
    assert by_name["events"]["state"] == "missing"
    assert by_name["events"]["epochs"] == 1
    assert call("status", folder) == 0
    assert "1 epoch" in capsys.readouterr().out
    assert call("status", folder, "--json") == 0
    settings = folder / "experiment.toml"
    settings.write_text(settings.read_text().replace("epochs = 2", "epochs = 3"))
    other = {each["name"]: each for each in _artifacts(folder, capsys)}
    assert "epochs" not in other["events"]  # the checkpoint is that of other settings


def test_what_is_not_shown_is_said(tmp_path, capsys, monkeypatch):
    def told(*given, **more):
        raise UserError("enough has been said")

    monkeypatch.setattr(events, "train_events", told)
    options = ("--set", "data.samples_per_digit=10", "--set", "events.epochs=1")
    options += ("--set", "events.architecture=10x10x2-4c4s3-10o")
    options += ("--set", "presentation.steps=5", "--set", "input.step=50")
    assert call("train", tmp_path / "run", "--input", "events", *options) == 2
    said = capsys.readouterr().err
    assert missing(said, "enough has been said", " 50 ms", "input.step", "5 steps of 50 ms") == []
    assert "rests" not in said  # steps are longer than a taxel rests


def test_a_check_with_faulty_taxels_has_a_file_of_its_own(run_on_events, capsys):
    fault = ("--fault", "hot=2", "--fault", "dead=5")
    assert call("check", "run", run_on_events, "--target", "fast", *fault) == 0
    faulty = read_json(run_on_events / "checks" / "fast-hot2-dead5.json", "")
    assert (faulty["fault"]["hot"], faulty["fault"]["dead"]) == (2, 5)
    usual = read_result(run_on_events / "checks" / "emulator.json")
    assert [s["id"] for s in faulty["samples"]] == [s["id"] for s in usual["samples"]]
    assert faulty["spikes"]["input"] != usual["spikes"]["input"]
    for wrong in ("hot", "cold=1", "hot=1,hot=2", "dead=101"):
        assert call("check", "run", run_on_events, "--target", "fast", "--fault", wrong) == 2
        assert "--fault" in capsys.readouterr().err
