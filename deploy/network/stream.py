"""Feeding a stream of samples to a simulator or a board, and reading its probes."""

from __future__ import annotations

from typing import Dict, Iterator, NamedTuple

import numpy as np

from .chip import LOIHI


class ShortOfSteps(Exception):
    """A simulator or board handed back other steps or spikes than it can have."""


class Shown(NamedTuple):
    """What one sample gave, the gap before it included.

    Attributes
    ----------
    output : ndarray, shape (period, n_outputs)
        What the readout said at each step.
    spikes : dict of str to ndarray of bool, shape (period, n_neurons)
        Of each spiking layer, in order.
    """

    output: np.ndarray
    spikes: Dict[str, np.ndarray]


def show(built, sim, samples) -> Iterator[Shown]:
    """Show one stream, sample by sample, so that the probes hold no more than one sample's steps.

    Parameters
    ----------
    built : deploy.network.build.Built
        The network that ``sim`` runs.
    sim : nengo.Simulator or nengo_loihi.Simulator
        Fresh; what was probed is cleared after each sample.
    samples : ndarray
        As ``built.feed`` takes them.

    Raises
    ------
    ShortOfSteps
        The simulator handed back other steps or spikes than it can have.
    """
    built.feed.samples = samples
    period = built.feed.period
    for _ in samples:
        sim.run_steps(period)
        spikes = {}
        for name, probe in built.spikes.items():
            rows = sim.data[probe]
            if len(rows) != period:
                raise ShortOfSteps(f"{len(rows)} of {period} steps of layer {name} came back")
            spikes[name] = np.asarray(rows) != 0
            one = probe.target.ensemble.neuron_type.amplitude / LOIHI.dt
            if not np.allclose(np.asarray(rows)[spikes[name]], one, rtol=1e-6):
                raise ShortOfSteps(f"layer {name} gave more than one spike a step and neuron")
        output = np.array(sim.data[built.output])
        sim.clear_probes()
        yield Shown(output, spikes)


def streams_of(n_samples: int, stream_length: int) -> list:
    """Cut samples 0 to n_samples - 1 into streams, as slices in order."""
    return [
        slice(start, min(start + stream_length, n_samples))
        for start in range(0, n_samples, stream_length)
    ]
