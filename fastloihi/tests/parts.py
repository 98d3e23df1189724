"""A model of one input and one block, and changes of it that NengoLoihi's users could make."""

from __future__ import annotations

import warnings

import numpy as np
from nengo_loihi.block import Axon, LoihiBlock, Synapse
from nengo_loihi.builder import Model
from nengo_loihi.builder.discretize import discretize_model
from nengo_loihi.emulator.interface import EmulatorInterface
from nengo_loihi.inputs import SpikeInput
from nengo_loihi.probe import LoihiProbe

from fastloihi import FastEmulator, NotAccelerated

N = 6


class Parts:
    """An input of as many neurons as a block, a synapse between them, and a probe."""

    def __init__(self):
        rng = np.random.RandomState(0)
        self.model, self.block, self.input = Model(), LoihiBlock(N), SpikeInput(N)
        self.block.compartment.configure_lif(tau_ref=0.001)
        self.synapse, self.axon = Synapse(N), Axon(N)
        self.synapse.set_weights(rng.uniform(0.5, 2, size=(N, N)))
        self.axon.target = self.synapse
        self.block.add_synapse(self.synapse)
        self.input.add_axon(self.axon)
        self.probe = LoihiProbe(target=[self.block], key="voltage")
        self.discretized, self.spikes = True, [[0, 1], [2, 5], [5], [], [1, 3, 4], [0]]

    @property
    def compartment(self):
        return self.block.compartment

    def emulator(self, kind):
        self.model.add_block(self.block)
        self.model.add_input(self.input)
        self.model.add_probe(self.probe)
        if self.discretized:
            discretize_model(self.model)
        self.finish()
        for t, spikes in enumerate(self.spikes):
            self.input.add_spikes(t + 1, np.array(spikes, int))
        return kind(self.model, seed=1)

    def finish(self):
        """What is changed after discretising."""


def after_discretising(change):
    """A change that is made after discretising."""
    return lambda parts: setattr(parts, "finish", lambda: change(parts))


def change_nothing(part):
    """No change."""


def combine(*changes):
    """Several changes, one after the other."""

    def change(parts):
        for change_part in changes:
            change_part(parts)

    return change


def with_attributes(part, **values):
    """Other attributes of a part."""

    def change(parts):
        for name, value in values.items():
            setattr(getattr(parts, part), name, value)

    return change


def with_axons(axons, atoms=None):
    """Other axons and atoms of the neurons."""
    return lambda parts: parts.axon.set_compartment_axon_map(axons, atoms=atoms)


def with_each(name, change):
    """Other arrays of weights or indices, each made from what it was."""

    def changed(parts):
        arrays = getattr(parts.synapse, name)
        arrays[:] = map(change, arrays)

    return after_discretising(changed)


def enable_noise(parts):
    parts.compartment.enable_noise[:] = True


def with_noise(**values):
    return after_discretising(combine(enable_noise, with_attributes("compartment", **values)))


def stay_floating(parts):
    parts.discretized = False


def start_learning(parts):
    parts.synapse.set_learning(tracing_mag=20.0)


def with_learning(**values):
    return combine(start_learning, after_discretising(with_attributes("synapse", **values)))


def with_probe(**attributes):
    def change(parts):
        parts.probe = LoihiProbe(target=[parts.block], **attributes)

    return change


def odd_block_that_learns(parts):
    parts.block = LoihiBlock(N + 1)
    parts.block.compartment.configure_lif()
    parts.synapse.set_weights(np.ones((N, N + 1)))
    parts.block.add_synapse(parts.synapse)
    with_probe(key="voltage")(parts)
    start_learning(parts)


def weights_of_other_shapes(parts):
    first, second = parts.synapse.weights[:2]
    parts.synapse.weights[:2] = [first[:, :-1], np.hstack([second, second[:, :1]])]


def one_weight(parts):
    parts.synapse.weights[5] = parts.synapse.weights[5][:, :1]


class Twice(Axon):
    def map_spikes(self, spikes):
        return 2 * super().map_spikes(spikes)


class Shifted(Synapse):
    def axon_weights_indices(self, axon, atom=0):
        weights, indices = super().axon_weights_indices(axon, atom)
        return weights, indices[::-1]


class Doubled(SpikeInput):
    def spike_idxs(self, ti):
        return np.repeat(super().spike_idxs(ti), 2)


def make_emulator(kind, change):
    parts = Parts()
    change(parts)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        emulator = parts.emulator(kind)
    return emulator, sum(issubclass(w.category, NotAccelerated) for w in caught)


def make_both(change=change_nothing):
    """NengoLoihi's emulator of a changed model, and the fast one."""
    return [make_emulator(kind, change)[0] for kind in (EmulatorInterface, FastEmulator)]
