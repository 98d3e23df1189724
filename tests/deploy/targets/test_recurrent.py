"""Recurrent layers on every target, and what they cost."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.conformance.networks import make_dense, make_readout
from deploy.errors import UserError
from deploy.network.blocks import BlockNeeds, choose_blocks
from deploy.network.presentation import Presentation
from deploy.network.reference import run_reference
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames
from deploy.preflight.plan import make_plan
from deploy.targets.registry import run_target


def recurrent_spec(units=12, seed=0, strength=1.0, **presentation):
    """Events into a recurrent layer."""
    rng = np.random.default_rng(seed)
    layer = make_dense("dense1", (3, 4, 2), units, rng)
    own = strength * rng.normal(size=(units, units)) / np.sqrt(units)
    object.__setattr__(layer, "recurrent", own)
    shown = {"steps": 40, "gap": 5, "readout_start": 0, "stream_length": 2, **presentation}
    layers = (layer, make_readout((units,), rng))
    return NetworkSpec("3x4x2-12-10o", (3, 4, 2), EventFrames(), layers, Presentation(**shown))


def frames_of(count=4, steps=40, seed=0):
    return (np.random.default_rng(seed).random((count, steps, 3, 4, 2)) < 0.2).astype(np.uint8)


def test_description_and_arrays_are_read_back():
    spec = recurrent_spec()
    again = NetworkSpec.from_json(spec.to_json(), spec.to_arrays())
    np.testing.assert_array_equal(again.layers[0].recurrent, spec.layers[0].recurrent)
    with pytest.raises(UserError, match="recurrent"):
        NetworkSpec.from_json(
            spec.to_json(), {**spec.to_arrays(), "dense1.recurrent": np.ones((12, 11))}
        )


@pytest.mark.parametrize("target", ["nengo", "simreal", "emulator", "fast"])
def test_spikes_come_back_one_step_later(target):
    """A spike that brings the neuron past its threshold again keeps it going to the end."""
    spikes = {}
    for weight in (0.0, 1.0):
        spec = recurrent_spec(units=1, gap=0, stream_length=1)
        changes = {"weights": np.ones((1, 24)), "bias": np.zeros(1), "synapse": None}
        neurons = replace(spec.layers[0].neurons, tau_ref=0.0)
        recurrent = np.full((1, 1), 10 * weight)
        layer = replace(spec.layers[0], neurons=neurons, recurrent=recurrent, **changes)
        frames = np.zeros((1, 40, 3, 4, 2), np.uint8)
        frames[0, 10] = 1
        one = run_target(replace(spec, layers=(layer, spec.layers[1])), frames, target)
        spikes[weight] = int(one.spikes["dense1"].sum())
    assert spikes[0.0] == 1
    assert 28 <= spikes[1.0] <= 30


def test_operations_count_the_loop():
    spec = recurrent_spec()
    spikes = {"input": np.ones((1, 24)), "dense1": np.ones((1, 12))}
    counted = spec.count_synaptic_operations(spikes)
    assert counted["dense1"].tolist() == [24 * 12 + 12 * 12]
    assert spec.multiply_accumulates["dense1"] == 24 * 12 + 12 * 12


def test_the_plan_counts_the_loop():
    plan = make_plan(recurrent_spec())
    assert plan.problems == []
    (core,) = [core for core in plan.cores if core.layer == "dense1"]
    assert core.used["input axons"] == 24 + 12
    assert core.used["output axons"] >= 12


def with_two_synapses(spec):
    """The same network, whose first layer has two synapses for each weight."""
    first, *others = spec.layers
    return replace(spec, layers=(replace(first, synapses_per_weight=2), *others))


def test_two_synapses_for_a_weight_count_twice():
    one = recurrent_spec()
    two = with_two_synapses(one)
    spikes = {"input": np.ones((1, 24)), "dense1": np.ones((1, 12))}
    counted = [spec.count_synaptic_operations(spikes)["dense1"].tolist() for spec in (one, two)]
    assert counted == [[24 * 12 + 12 * 12], [2 * (24 * 12 + 12 * 12)]]
    assert two.multiply_accumulates == one.multiply_accumulates
    (core,), (core_of_two,) = (
        [core for core in make_plan(spec).cores if core.layer == "dense1"] for spec in (one, two)
    )
    for name in ("input axons", "synapse words"):
        assert core_of_two.used[name] == 2 * core.used[name]
    assert BlockNeeds(two.layers[0]).count([(0, 12)]) == (
        core_of_two.used["input axons"],
        core_of_two.used["synapse words"],
    )


def test_every_target_adds_two_synapses():
    spec = with_two_synapses(recurrent_spec())
    frames = frames_of()
    real = run_target(spec, frames, "simreal").spikes["dense1"]
    (reference,) = run_reference(spec, [spec.flatten_samples(frames)[:2]])
    np.testing.assert_allclose(real[:2], reference.spikes["dense1"].sum(1), atol=1)
    emulated, fast = (run_target(spec, frames, target) for target in ("emulator", "fast"))
    np.testing.assert_array_equal(emulated.spike_hashes, fast.spike_hashes)
    assert emulated.spikes["dense1"].sum() > 0


def test_a_layer_too_large_for_a_core_with_its_loop_is_divided():
    spec = recurrent_spec(units=500)
    (units,) = choose_blocks(spec.layers)["dense1"]
    assert units < 500
    assert make_plan(spec).problems == []
    emulated, fast = (run_target(spec, frames_of(2), target) for target in ("emulator", "fast"))
    assert emulated.spikes["dense1"].sum() > 0
    np.testing.assert_array_equal(emulated.spike_hashes, fast.spike_hashes)
