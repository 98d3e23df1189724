"""The ladder on the whole test split, and the networks before the bundle on any samples."""

import json
import shutil

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.files import read_json
from pipeline.data.dataset import Dataset
from pipeline.roads.road import responses_of
from pipeline.settings import Presentation, read_settings
from tests.command import call, missing

STAGES = ["counts", "cnn", "cnn-matched", "rate-lif", "spiking-lif", "fast"]


@pytest.fixture(scope="module")
def whole_run(tiny_run, tmp_path_factory):
    """A copy of the small run with its ladder on all 120 test samples."""
    run = tmp_path_factory.mktemp("whole") / "run"
    shutil.copytree(tiny_run, run)
    assert call("ladder", run, "--whole", "--limit", -100) == 0
    return run


def test_every_stage_answers_the_whole_test_split(whole_run):
    bundle = read_bundle(whole_run / "bundle")
    dataset = Dataset.of(read_settings(whole_run / "experiment.toml"))
    ids = sorted(dataset.recordings.ids[i] for i in dataset.split.test)
    assert len(ids) == 120
    folder = whole_run / "checks" / "whole"
    assert sorted(p.stem for p in folder.iterdir()) == sorted(STAGES)
    orders = []
    for stage in STAGES:
        result = read_result(folder / f"{stage}.json")
        assert (result["target"], result["bundle"]) == (stage, bundle.id)
        assert result["simulated"] is True
        orders.append([sample["id"] for sample in result["samples"]])
        assert sorted(orders[-1]) == ids
    assert orders.count(orders[0]) == len(STAGES)
    assert orders[0] != ids  # digits come mixed, as in the check


def test_accuracies_are_those_of_training(whole_run):
    """Two ways to the same figure: the training's own metrics, and the ladder."""
    for stage, folder in (("cnn", "cnn"), ("rate-lif", "snn")):
        metrics = read_json(whole_run / folder / "metrics.json", "")
        result = read_result(whole_run / "checks" / "whole" / f"{stage}.json")
        assert result["accuracy"] == pytest.approx(metrics["accuracy"]["test"])
        assert result["accuracy_ci95"] == pytest.approx(metrics["test_accuracy_ci95"])


def test_its_ladder(whole_run, capsys):
    ladder = read_json(whole_run / "ladder-whole.json", "")
    assert [row["stage"] for row in ladder["rows"]] == STAGES
    assert (ladder["n_samples"], ladder["simulated"]) == (120, True)
    assert ladder["left_out"] == ["nengo", "simreal"]
    for row in ladder["rows"]:
        confusion = np.array(row["confusion"])
        assert confusion.sum() == 120
        assert np.trace(confusion) / 120 == pytest.approx(row["accuracy"])
    before = {p: p.stat().st_mtime_ns for p in (whole_run / "checks" / "whole").iterdir()}
    assert call("ladder", whole_run, "--whole", "--limit", -100) == 0
    out, err = capsys.readouterr()
    assert missing(err, *(f"{name}: " for name in ("cnn", "rate-lif", "bundle", *STAGES))) == []
    assert {p: p.stat().st_mtime_ns for p in (whole_run / "checks" / "whole").iterdir()} == before
    assert missing(out, "120 simulated samples", "nengo, simreal", "--slow", "conv") == []
    assert call("ladder", whole_run, "--whole", "--json") == 0
    assert json.loads(capsys.readouterr().out) == ladder


def test_the_ladder_of_the_check_stays_as_it_was(whole_run, tiny_run):
    assert read_json(whole_run / "ladder.json", "") == read_json(tiny_run / "ladder.json", "")


def test_the_emulators_answers_are_the_fast_targets(whole_run, tmp_path):
    """The samples of the check, on both."""
    bundle = whole_run / "bundle"
    out = tmp_path / "fast.json"
    assert call("check", "run", bundle, "--target", "fast", "--out", out) == 0
    fast, emulator = read_result(out), read_result(whole_run / "checks" / "emulator.json")
    assert fast["spikes"] == emulator["spikes"]
    for a, b in zip(fast["samples"], emulator["samples"], strict=True):
        # The host adds the same spikes in another order: the last bits of a score differ.
        np.testing.assert_allclose(a["scores"], b["scores"], rtol=0, atol=1e-9)
        assert [a[k] for k in ("id", "prediction", "stable_after")] == [
            b[k] for k in ("id", "prediction", "stable_after")
        ]


def test_another_bundle_makes_the_answers_out_of_date(whole_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    weights = (run / "cnn" / "weights.npz").stat().st_mtime_ns
    assert call("ladder", run, "--whole", "--steps", 30) == 0
    assert (run / "cnn" / "weights.npz").stat().st_mtime_ns == weights
    before = read_result(whole_run / "checks" / "whole" / "fast.json")
    after = read_result(run / "checks" / "whole" / "fast.json")
    assert (before["steps_per_sample"], after["steps_per_sample"]) == (40, 30)
    assert before["bundle"] != after["bundle"]


def test_scores_are_means_from_the_readouts_start():
    logits = np.array([[[9.0, 0.0], [0.0, 1.0], [4.0, 0.0], [0.0, 9.0]]])
    responses = responses_of(logits, Presentation(steps=4, readout_start=1))
    assert responses.decisions.tolist() == [[-1, 1, 0, 1]]
    np.testing.assert_allclose(responses.scores, [[4 / 3, 10 / 3]])
    assert responses.stable_after.tolist() == [4]
    still = responses_of(logits[:, :1], Presentation(steps=4, readout_start=1))
    assert (still.predictions.tolist(), still.stable_after.tolist()) == ([0], [1])
