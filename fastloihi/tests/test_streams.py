"""`StreamEmulator` against NengoLoihi's emulator, one stream after the other."""

from __future__ import annotations

import fastloihi.compiled
import nengo
import numpy as np
import pytest
from block_models import random_model
from fastloihi.layout import Unsupported
from fastloihi.streams import StreamEmulator, sum_rows
from hypothesis import HealthCheck, Phase, event, given, reject, settings
from hypothesis import strategies as st
from nengo_loihi.builder.discretize import overflow_signed
from nengo_loihi.emulator.interface import EmulatorInterface
from networks import learning

from fastloihi import FastSimulator


def emulated(model, inputs):
    """Spikes of each step, and overflows of each compartment and place, of one stream."""
    emulator, spikes = EmulatorInterface(model), []
    overflows = np.zeros((emulator.block_info.n_compartments, 3), int)

    def counting(x, bits, name=None):
        _, over = overflow_signed(x, bits=bits, out=x)
        overflows[:, ("q0", "current", "u2").index(name)] += over

    emulator.compartment._overflow = counting
    first = 0
    for item in emulator.inputs:
        for step, row in enumerate(inputs[:, first : first + item.n_neurons]):
            item.spikes[step + 1] = np.flatnonzero(row)
        first += item.n_neurons
    for _ in inputs:
        emulator.step()
        spikes.append(emulator.compartment.spiked.copy())
    for item in emulator.inputs:
        item.spikes.clear()
    return np.array(spikes), overflows, emulator.compartment


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_spike_and_overflow_of_every_stream_is_the_emulators(seed):
    """Loops, several inputs, population axons and weights of any size; cut into two calls."""
    rng = np.random.RandomState(seed % 2**32)
    try:
        model = random_model(seed)
        streams = StreamEmulator(model)
    except (nengo.exceptions.BuildError, Unsupported):
        reject()
    inputs = (rng.rand(3, 40, sum(streams.input_sizes)) < 0.3).astype(np.uint8)
    state = streams.start(3)
    parts = [streams.advance(state, inputs[:, part]) for part in (slice(17), slice(17, None))]
    spikes = np.concatenate([part[0] for part in parts], axis=1)
    total = sum(part[1] for part in parts)
    expected = np.zeros_like(total)
    for b in range(3):
        spiked, overflows, compartment = emulated(model, inputs[b])
        assert np.array_equal(spikes[b], spiked)
        assert np.array_equal(state.cells[b, fastloihi.compiled.VOLTAGE], compartment.voltage)
        expected += [overflows[part].sum(axis=0) for part in streams.blocks.values()]
    assert np.array_equal(total, expected)
    event(f"overflows: {total.any()}")


def test_weights_and_constants_are_those_of_the_blocks():
    compared = 0
    for seed in range(60):
        try:
            model = random_model(seed)
            streams = StreamEmulator(model)
        except (nengo.exceptions.BuildError, Unsupported):
            continue
        constants = streams.read_constants()
        source, target, value = streams.read_weights()
        matrix = np.zeros((sum(streams.input_sizes) + streams.n, streams.n), int)
        np.add.at(matrix, (source, target), value)
        for block, part in streams.blocks.items():
            assert np.array_equal(constants["threshold"][part], block.compartment.vth)
            assert np.array_equal(constants["bias"][part], block.compartment.bias)
        if not len(streams.input_sizes) or not matrix.any():
            continue
        compared += 1
        # One spike of each input neuron: what arrives is a row of the matrix.
        for neuron in range(matrix.shape[0] - streams.n):
            inputs = np.zeros((1, 2, matrix.shape[0] - streams.n), np.uint8)
            inputs[0, 0, neuron] = 1
            quiet = streams.start(1)
            quiet.cells[:, fastloihi.compiled.BIAS] = 0
            streams.advance(quiet, inputs)
            q = quiet.cells[0, fastloihi.compiled.INPUT]
            if np.abs(matrix[neuron]).max() < 2**21:
                assert np.array_equal(q, matrix[neuron])
    assert compared > 10


def test_learning_is_refused():
    simulator = FastSimulator(learning(20)[0])
    with simulator, pytest.raises(Unsupported, match="learning"):
        StreamEmulator(simulator.model)


def test_rows_are_summed_in_order():
    rng = np.random.RandomState(0)
    spikes, matrix = (rng.rand(2, 5, 19) < 0.4).astype(np.uint8), rng.normal(size=(19, 3))
    sums = sum_rows(spikes, matrix)
    for index in np.ndindex(2, 5):
        expected = np.zeros(3)
        for row in np.flatnonzero(spikes[index]):
            expected += matrix[row]
        assert np.array_equal(sums[index], expected)
