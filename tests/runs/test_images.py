"""The main job at a small size, made once with the command."""

import json
import shutil

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.files import read_arrays, read_json
from tests.command import call, missing

STAGES = ["counts", "cnn", "cnn-matched", "rate-lif", "spiking-lif", "nengo", "simreal", "emulator"]


def test_the_runs_folder_holds_what_the_contract_names(tiny_run):
    names = {p.relative_to(tiny_run).as_posix() for p in tiny_run.rglob("*") if p.is_file()}
    folder = {"weights.npz", "history.csv", "metrics.json"}
    assert names - {".lock"} == {
        *("experiment.toml", "dataset.json", "ladder.json"),
        *(f"{network}/{name}" for network in ("cnn", "cnn-matched", "snn") for name in folder),
        *(f"bundle/{name}" for name in ("network.json", "weights.npz", "checks.npz")),
        *("bundle/MANIFEST.json", "bundle/deploy.pyz", "counts/scores.npz", "counts/metrics.json"),
        *(f"checks/{stage}.json" for stage in STAGES),
    }


def test_the_data_are_called_simulated_everywhere(tiny_run):
    dataset = read_json(tiny_run / "dataset.json", "")
    assert dataset["simulated"] is True
    assert (dataset["samples"], {*dataset["samples_per_class"].values()}) == (600, {60})
    assert len(dataset["sha256"]) == 64
    assert read_bundle(tiny_run / "bundle").spec.provenance.simulated is True
    for stage in STAGES:
        assert read_result(tiny_run / "checks" / f"{stage}.json")["simulated"] is True
    assert read_json(tiny_run / "ladder.json", "")["simulated"] is True


def test_every_stage_answers_the_bundles_samples(tiny_run):
    bundle = read_bundle(tiny_run / "bundle")
    assert len(bundle.checks) == 20
    for stage in STAGES:
        result = read_result(tiny_run / "checks" / f"{stage}.json")
        assert result["target"] == stage
        assert result["bundle"] == bundle.id
        assert [s["id"] for s in result["samples"]] == list(bundle.checks.ids)
        assert result["steps_per_sample"] == 40


def test_the_spiking_network_is_alive_and_has_learnt(tiny_run):
    for target in ("nengo", "simreal", "emulator"):
        result = read_result(tiny_run / "checks" / f"{target}.json")
        assert min(result["spikes"].values()) > 20 * 10  # ten a sample at the very least
        assert result["accuracy"] > 0.2  # chance is 0.1
    for network in ("cnn", "snn"):
        assert read_json(tiny_run / network / "metrics.json", "")["accuracy"]["test"] > 0.2


def test_the_targets_are_near_each_other(tiny_run):
    scores = {
        target: np.array([s["scores"] for s in read_result(tiny_run / "checks" / name)["samples"]])
        for target, name in ((t, f"{t}.json") for t in ("nengo", "simreal", "emulator"))
    }
    spread = scores["nengo"].std()
    assert np.abs(scores["nengo"] - scores["simreal"]).mean() < 0.35 * spread
    assert np.abs(scores["simreal"] - scores["emulator"]).mean() < 0.35 * spread


def test_the_ladder_is_printed(tiny_run, capsys):
    assert call("ladder", tiny_run) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert missing(lines[0], "20", "simulated") == []
    assert [line.split()[0] for line in lines[2 : 2 + len(STAGES)]] == STAGES


def test_a_ladder_does_nothing_twice(tiny_run):
    folders = [tiny_run / name for name in ("cnn", "snn", "bundle", "checks")]
    before = {p: p.stat().st_mtime_ns for folder in folders for p in folder.iterdir()}
    assert call("ladder", tiny_run) == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_the_ladder_is_saved_as_it_is_printed(tiny_run, capsys):
    assert call("ladder", tiny_run, "--json") == 0
    assert json.loads(capsys.readouterr().out) == read_json(tiny_run / "ladder.json", "")


def test_the_same_seed_trains_the_same_weights(tiny_run, tmp_path):
    (tmp_path / "again").mkdir()
    shutil.copy(tiny_run / "experiment.toml", tmp_path / "again")
    assert call("train", tmp_path / "again") == 0
    first, again = (
        read_arrays(run / "cnn" / "weights.npz", "") for run in (tiny_run, tmp_path / "again")
    )
    assert first.keys() == again.keys()
    for name, array in first.items():
        np.testing.assert_array_equal(again[name], array)


def test_only_what_a_change_concerns_is_redone(tiny_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    weights = [run / network / "weights.npz" for network in ("cnn", "snn")]
    before = [path.stat().st_mtime_ns for path in weights]
    assert call("convert", run, "--steps", "38") == 0
    assert [path.stat().st_mtime_ns for path in weights] == before
    assert read_bundle(run / "bundle").id != read_bundle(tiny_run / "bundle").id
    assert not [path for path in run.rglob(".bundle*")]


def test_real_data_are_not_called_simulated(tmp_path, capsys):
    from tests.pipeline.handmade import archive, good_members

    archive(tmp_path / "st.zip", good_members(3))
    assert call("data", "import", tmp_path / "st.zip", "--json", "--jobs", 1) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["simulated"] is False
    assert (facts["samples"], {*facts["samples_per_class"].values()}) == (30, {3})


def test_inspecting_the_real_recording(real_recording, capsys):
    assert call("data", "inspect", real_recording, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["columns"], facts["events"], facts["on"], facts["off"]) == (2346, 665, 306, 359)
    assert facts["t_first_s"] == pytest.approx(0.1966, abs=1e-4)
    assert facts["t_last_s"] == pytest.approx(0.8957, abs=1e-4)
    assert 0 < facts["taxels"] <= 100
    assert call("data", "inspect", real_recording) == 0
    assert "665" in capsys.readouterr().out
