"""Present streams of samples to a simulator of Nengo, or to a board, and record its output."""

from __future__ import annotations

from typing import Dict, Iterator, NamedTuple

import numpy as np

from .chip import LOIHI
from .output import TargetOutput, hash_spikes
from .spec import NetworkSpec


class ImpossibleOutput(Exception):
    """A simulator or board returned an impossible number of steps or spikes."""


class SampleOutput(NamedTuple):
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


def present_samples(built, sim, samples) -> Iterator[SampleOutput]:
    """Present one stream, sample by sample, so that the probes only store one sample's steps.

    Parameters
    ----------
    built : deploy.network.build.BuiltNetwork
        The network that ``sim`` runs.
    sim : nengo.Simulator or nengo_loihi.Simulator
        A simulator at its first step; its probes are cleared after each sample.
    samples : ndarray
        Samples in the format of ``built.feed``.

    Raises
    ------
    ImpossibleOutput
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
                raise ImpossibleOutput(
                    f"{len(rows)} of {period} steps of layer {name} were returned"
                )
            spikes[name] = np.asarray(rows) != 0
            amplitude_per_step = probe.target.ensemble.neuron_type.amplitude / LOIHI.dt
            if not np.allclose(np.asarray(rows)[spikes[name]], amplitude_per_step, rtol=1e-6):
                raise ImpossibleOutput(f"layer {name} had more than one spike per step and neuron")
        output = np.array(sim.data[built.output])
        sim.clear_probes()
        yield SampleOutput(output, spikes)


def record_stream(spec: NetworkSpec, built, sim, samples) -> TargetOutput:
    """Present one stream to a simulator, or to a board run by NengoLoihi, and record its output.

    Parameters
    ----------
    spec : NetworkSpec
    built : BuiltNetwork
        The network that ``sim`` runs.
    sim : nengo.Simulator or nengo_loihi.Simulator
        A simulator at its first step.
    samples : ndarray
        Samples as returned by `Stimulus.flatten`.

    Raises
    ------
    ImpossibleOutput
        The simulator returned fewer steps than requested.
    """
    readouts: list = []
    hashes: list = []
    counts: dict = {name: [] for name in built.spikes}
    for sample in present_samples(built, sim, samples):
        for name, rows in sample.spikes.items():
            counts[name].append(np.count_nonzero(rows, axis=0))
        hashes.append(hash_spikes(np.packbits(rows, axis=1) for rows in sample.spikes.values()))
        readouts.append(sample.output[spec.presentation.gap :])
    spikes = {name: np.array(rows) for name, rows in counts.items()}
    return TargetOutput(np.array(readouts), spikes, np.array(hashes))
