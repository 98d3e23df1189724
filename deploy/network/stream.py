"""Present a stream of samples to a simulator or a board, and read its probes."""

from __future__ import annotations

from typing import Dict, Iterator, NamedTuple

import numpy as np

from .chip import LOIHI


class ShortOfSteps(Exception):
    """A simulator or board returned an impossible number of steps or spikes."""


class Shown(NamedTuple):
    """Output and spikes of one sample, including the gap before it.

    Attributes
    ----------
    output : ndarray, shape (period, n_outputs)
        The readout at each step.
    spikes : dict of str to ndarray of bool, shape (period, n_neurons)
        Spikes of each spiking layer, in order.
    """

    output: np.ndarray
    spikes: Dict[str, np.ndarray]


def show(built, sim, samples) -> Iterator[Shown]:
    """Present one stream, sample by sample, so that the probes only store one sample's steps.

    Parameters
    ----------
    built : deploy.network.build.Built
        The network that ``sim`` runs.
    sim : nengo.Simulator or nengo_loihi.Simulator
        A simulator at its first step; its probes are cleared after each sample.
    samples : ndarray
        Samples in the format of ``built.feed``.

    Raises
    ------
    ShortOfSteps
        The simulator returned an impossible number of steps or spikes.
    """
    built.feed.samples = samples
    period = built.feed.period
    for _ in samples:
        sim.run_steps(period)
        spikes = {}
        for name, probe in built.spikes.items():
            rows = sim.data[probe]
            if len(rows) != period:
                raise ShortOfSteps(f"{len(rows)} of {period} steps of layer {name} were returned")
            spikes[name] = np.asarray(rows) != 0
            one = probe.target.ensemble.neuron_type.amplitude / LOIHI.dt
            if not np.allclose(np.asarray(rows)[spikes[name]], one, rtol=1e-6):
                raise ShortOfSteps(f"layer {name} had more than one spike per step and neuron")
        output = np.array(sim.data[built.output])
        sim.clear_probes()
        yield Shown(output, spikes)


def streams_of(n_samples: int, stream_length: int) -> list:
    """Cut samples 0 to n_samples - 1 into streams, as slices in order."""
    return [
        slice(start, min(start + stream_length, n_samples))
        for start in range(0, n_samples, stream_length)
    ]
