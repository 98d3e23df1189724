"""A replay of one sample of a check, with every spike of every layer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.build import build
from deploy.network.loihi_import import nengo_loihi
from deploy.network.stream import show


@dataclass(frozen=True)
class Replay:
    """Spikes in the gap before a sample and during its presentation.

    Attributes
    ----------
    spikes : dict of str to (steps, neurons)
        For each layer two arrays of int, one entry per spike: its step, which is 0 at the start of
        the presentation and negative in the gap, and its neuron.
    neurons : dict of str to int
        Number of neurons of each layer.
    steps : int
    """

    spikes: dict
    neurons: dict
    steps: int


def replay(bundle: Bundle, index: int, seed: int = 0) -> Replay:
    """Run NengoLoihi's emulator on a sample and on those before it in its stream.

    Parameters
    ----------
    bundle : Bundle
    index : int
        Index of the sample in the bundle's check.
    seed : int

    Returns
    -------
    Replay
    """
    spec = bundle.spec
    built = build(spec, seed)
    length = spec.presentation.stream_length
    first = index - index % length
    samples = spec.stimulus.flat(bundle.checks.inputs[first : index + 1])
    with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as simulator:
        *_, shown = show(built, simulator, samples)
    fired = shown.spikes
    spikes = {}
    for name, mask in fired.items():
        steps, neurons = np.nonzero(mask)
        spikes[name] = steps - spec.presentation.gap, neurons
    return Replay(
        spikes=spikes,
        neurons={name: mask.shape[1] for name, mask in fired.items()},
        steps=spec.presentation.steps,
    )
