"""NengoLoihi's emulator and the fast one side by side: whatever differs is an `AssertionError`."""

from __future__ import annotations

import collections
import warnings
from typing import ClassVar

import numpy as np
from nengo_loihi.emulator.interface import EmulatorInterface

from fastloihi import FastEmulator

NUMPY_1 = np.__version__.startswith("1.")  # on which learning in floating point is not compiled
STATE = ("current", "voltage", "input", "spiked", "ref_count", "spike_count", "bias", "vth")


def state_of(emulator):
    """Everything that an emulator keeps from one step to the next, as a dict of arrays."""
    compartment, synapses = emulator.compartment, emulator.synapses
    state = {name: np.array(getattr(compartment, name)) for name in STATE}
    state["t"] = np.array(emulator.t)
    state["words"], state["position"] = map(np.array, emulator.rng.get_state()[1:3])
    for number, synapse in enumerate(synapses.slices):
        spikes = [(spike.axon_idx, spike.atom) for spike in synapses.spikes_in[synapse]]
        state[f"spikes_in {number}"] = np.array(spikes, int)
        if synapse.learning:
            state[f"trace {number}"] = np.array(synapses.traces[synapse])
            state[f"error {number}"] = np.array(synapses.pes_errors[synapse])
            state[f"waiting {number}"] = np.array(sorted(synapses.trace_spikes[synapse]), int)
            state[f"weights {number}"] = np.concatenate([w.ravel() for w in synapse.weights])
    for number, (probe, parts) in enumerate(emulator.probes.outputs.items()):
        for part, values in enumerate(parts):
            state[f"{probe.key} {number} {part}"] = np.asarray(values)
    for number, item in enumerate(emulator.inputs):
        state[f"input {number}"] = np.array(item.spike_times())
    return state


def assert_same(expected, actual, where=""):
    """Two states, bit for bit."""
    assert expected.keys() == actual.keys()
    for name, value in expected.items():
        other = actual[name]
        assert value.dtype == other.dtype, f"{where}: {name}: {value.dtype}, {other.dtype}"
        assert value.shape == other.shape, f"{where}: {name}: {value.shape}, {other.shape}"
        equal_nan = value.dtype.kind == "f"
        same = np.array_equal(value, other, equal_nan=equal_nan)
        assert same, f"{where}: {name} differs at {np.flatnonzero(value != other)[:5]}"
        if equal_nan:
            zero = (value == 0) & (np.signbit(value) != np.signbit(other))
            assert not zero.any(), f"{where}: {name}: sign of 0 at {np.flatnonzero(zero)[:5]}"


class Outcome(collections.namedtuple("Outcome", "warnings error")):
    """What a call says: warnings in their order, and the error that ends it, if any."""

    @classmethod
    def of(cls, call):
        error = None
        with warnings.catch_warnings(record=True) as record:
            warnings.simplefilter("always")
            try:
                call()
            except Exception as caught:
                error = caught
        messages = [(str(w.message), w.category, w.filename) for w in record]
        return cls(messages, error)

    def __eq__(self, other):
        words = type(self.error), str(self.error)
        return self.warnings == other.warnings and words == (type(other.error), str(other.error))


class Both(EmulatorInterface):
    """NengoLoihi's emulator, compared with the fast one after every call.

    In place of NengoLoihi's class, for tests that are not ours.  Both read one model: what one
    of them changes there, spikes of inputs and weights that are learned, is kept for each.
    """

    tally: ClassVar = collections.Counter()
    each_step = False

    def __init__(self, model, seed=None):
        super().__init__(model, seed=seed)
        plain = [list(synapse.weights) for synapse in self.synapses.traces]
        plain = [[w.copy() for w in weights] for weights in plain]
        self.fast = FastEmulator(model, seed=self.seed)
        Both.tally["emulators"] += 1
        Both.tally["not accelerated"] += type(self.fast) is not FastEmulator
        self._fast_weights = [list(synapse.weights) for synapse in self.synapses.traces]
        self._give(plain)

    def _give(self, weights):
        for synapse, values in zip(self.synapses.traces, weights):
            synapse.weights[:] = values

    def host2chip(self, spikes, errors):
        super().host2chip(spikes, errors)
        for synapse, errors in self.fast.synapses.pes_errors.items():
            errors[...] = self.synapses.pes_errors[synapse]

    def run_steps(self, steps):
        for n in [1] * steps if self.each_step else [steps]:
            self._run_both(n)

    def step(self):
        self._run_both(1)

    def _run_both(self, steps):
        spikes = [dict(item.spikes) for item in self.inputs]
        plain = [list(synapse.weights) for synapse in self.synapses.traces]
        self._give(self._fast_weights)
        actual = Outcome.of(lambda: self.fast.run_steps(steps))
        state = state_of(self.fast)
        self._fast_weights = [list(synapse.weights) for synapse in self.synapses.traces]
        self._give(plain)
        for item, before in zip(self.inputs, spikes):
            item.spikes = before
        count = int(self.compartment.spike_count.sum())
        expected = Outcome.of(lambda: [EmulatorInterface.step(self) for _ in range(steps)])
        assert expected == actual, f"{expected} {actual}"
        assert_same(state_of(self), state, f"after step {self.t}")
        Both.tally["steps"] += steps
        Both.tally["compartment steps"] += steps * self.block_info.n_compartments
        Both.tally["spikes"] += int(self.compartment.spike_count.sum()) - count
        for message, category, _ in expected.warnings:
            warnings.warn(message, category, stacklevel=2)
        if expected.error is not None:
            raise expected.error

    def collect_probe_output(self, probe):
        expected, actual = (
            super().collect_probe_output(probe),
            self.fast.collect_probe_output(probe),
        )
        assert expected.dtype == actual.dtype, probe.key
        assert np.array_equal(expected, actual, equal_nan=True), probe.key
        return expected

    def chip2host(self, probes_receivers):
        super().chip2host(probes_receivers)
        for probe in probes_receivers:
            self.fast.probes.clear_probe(probe)

    def close(self):
        super().close()
        self.fast.close()
