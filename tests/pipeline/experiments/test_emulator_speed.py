"""The benchmark of the target ``fast``: it times two equal answers, and notices unequal ones."""

from __future__ import annotations

import json

import numpy as np
import pytest

from deploy.check.bundle import CheckSet, write_bundle
from deploy.targets.fast.emulation import Emulation, compile_spec
from pipeline.experiments import emulator_speed as measure
from tests.command import call
from tests.deploy.fast_networks import images_for
from tests.deploy.networks import bundle_at, events_spec, random_frames, small_spec
from tools import emulator_limits

pytest.importorskip("numba")

PROMISED = {
    "identical", "ratio_whole", "ratio_chip", "ratio_whole_numpy",
    "samples_per_second", "reference_samples_per_second",
}  # fmt: skip


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """A bundle of a small network with 7 samples in streams of 3."""
    return bundle_at(tmp_path_factory.mktemp("benchmark") / "bundle", small_spec(), 7)


def test_json_has_what_is_promised(bundle, capsys):
    assert call("benchmark", "emulator", bundle.path, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) >= PROMISED
    assert result["identical"] is True
    assert result["n_samples"] == 7
    assert result["turns"] == 3
    assert result["mean_rates_hz"]["conv1"] > 0
    assert set(result["processor_time"]) == {name for name in result if name.startswith("ratio")}


def test_the_text_has_a_row_for_each_kernel(bundle, capsys):
    assert call("benchmark", "emulator", bundle.path, "--samples", "6") == 0
    text = capsys.readouterr().out
    for said in ("6 simulated samples", "fast, numba", "fast, numpy"):
        assert said in text


def test_a_bundle_of_events_is_measured_as_well(tmp_path, capsys):
    spec = events_spec()
    checks = CheckSet(random_frames(spec, 4), np.zeros(4, int), tuple("abcd"), 0)
    bundle = write_bundle(tmp_path / "bundle", spec, checks)
    assert call("benchmark", "emulator", bundle.path, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["identical"] is True
    assert result["step_ms"] == 10
    emulator_limits.main(bundle.path, as_json=True)
    limits = json.loads(capsys.readouterr().out)
    assert [row["steps"] for row in limits["growth"]["steps"]] == [25, 50, 100, 200, 400]
    rates = [row["chip_hz"] for row in limits["growth"]["brightness"]]
    assert rates[0] < rates[1]
    # Of the same samples as the rates by layer, and in the same seconds.  Streams of three: the
    # fourth sample is in neither.
    layers, rates_of = {"conv1": 36, "dense1": 5}, result["mean_rates_hz"]
    mean = sum(n * rates_of[name] for name, n in layers.items()) / sum(layers.values())
    assert rates[1] == pytest.approx(mean)
    # A share of two times: on a busy machine it may be above 1.
    assert limits["limits"]["share_of_time_updating"] > 0
    emulator_limits.main(bundle.path)
    assert "limit: " in capsys.readouterr().out


def test_a_rate_is_of_the_seconds_that_the_steps_stand_for():
    """Of 20 steps and 4 in the gap, 12 spikes are 500 Hz at 1 ms a step and 50 at 10 ms."""
    shown = {"steps": 20, "gap": 4, "readout_start": 0}
    assert measure.mean_rate(small_spec(**shown), [10, 14]) == pytest.approx(500)
    assert measure.mean_rate(events_spec(**shown), [10, 14]) == pytest.approx(50)


def test_missing_bundle_is_one_line(tmp_path, capsys):
    assert call("benchmark", "emulator", tmp_path / "none") == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_single_other_spike_is_noticed():
    spec = small_spec()
    images = images_for(spec, 2)
    _, output, spikes = measure.reference_turn(spec, images)
    emulation = Emulation(compile_spec(spec))
    assert measure.same_answer(spec, emulation, images, output, spikes)
    assert not measure.same_answer(spec, emulation, images, output + 1e-6, spikes)
    spikes["conv1"][1] = spikes["conv1"][1].copy()
    spikes["conv1"][1][3, 0] ^= 1
    assert not measure.same_answer(spec, emulation, images, output, spikes)


def test_disagreement_is_a_failed_check(bundle, capsys, monkeypatch):
    monkeypatch.setattr(measure, "same_answer", lambda *_: False)
    assert call("benchmark", "emulator", bundle.path) == 1
    captured = capsys.readouterr()
    assert len(captured.err.strip().splitlines()) == 1
    assert "identical: NO" in captured.out


def test_without_numba_the_numpy_kernel_is_measured(monkeypatch, bundle):
    monkeypatch.setattr(measure, "kernels_here", lambda: ("numpy",))
    result = measure.measure(bundle, 3)
    assert result["identical"]
    assert result["ratio_whole"] == result["ratio_whole_numpy"]
    assert "numba" not in measure.speed_text(result)
