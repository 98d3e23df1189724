"""Firing rates of a deployed network."""

from __future__ import annotations

from typing import Dict

import numpy as np

from ..network.spec import NetworkSpec
from ..network.stream import streams_of
from ..targets.fast import Emulation

# Number of streams whose spikes are in memory at a time.
STREAMS_AT_ONCE = 8


def firing_rates(
    spec: NetworkSpec, samples, seed: int = 0, start: int = 0, advance=None
) -> Dict[str, np.ndarray]:
    """Firing rates of all neurons, computed by the fast emulator.

    Parameters
    ----------
    spec : NetworkSpec
    samples : ndarray
        Samples in the format of the network's stimulus, in the network's presentation.
    seed : int
    start : int
        Number of steps at the start of each sample that are ignored.
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        In spikes per second, from ``start`` to the end of the sample.  A second is one of the
        stimulus (``step_seconds`` per step): with events, a second of the recording.
    """
    emulation = Emulation(spec, seed)
    presentation = spec.presentation
    sizes = {layer.name: layer.size for layer in spec.layers if layer.neurons is not None}
    window = presentation.steps - start
    counts = {name: [] for name in sizes}
    for batch in _batches(spec.stimulus.flat(samples), presentation.stream_length):
        of_batch = {name: [] for name in sizes}

        def watch(spikes, of_batch=of_batch):
            """Unpack and count the spikes of one sample of each stream."""
            for name, size in sizes.items():
                read = np.unpackbits(spikes[name][:, -window:], axis=2, count=size)
                of_batch[name].append(read.sum(axis=1))

        emulation.run(batch, watch)
        for name, of_samples in of_batch.items():
            counts[name].append(np.stack(of_samples, axis=1).reshape(-1, sizes[name]))
        if advance is not None:
            advance(batch.shape[0] * batch.shape[1])
    seconds = window * spec.stimulus.step_seconds
    return {name: np.concatenate(parts) / seconds for name, parts in counts.items()}


def _batches(samples, stream_length):
    """Arrays of streams of equal length, shape (n_streams, n_samples, ...), in order."""
    whole = [part for part in streams_of(len(samples), stream_length)]
    rest = [whole.pop()] if len(samples) % stream_length else []
    for first in range(0, len(whole), STREAMS_AT_ONCE):
        yield np.stack([samples[part] for part in whole[first : first + STREAMS_AT_ONCE]])
    for part in rest:
        yield samples[part][None]


def silent_share(rates) -> float:
    """Share of the neurons that are silent on all samples.

    Parameters
    ----------
    rates : ndarray, shape (n_samples, n_neurons)
    """
    return float(np.mean(np.all(np.asarray(rates) <= 0, axis=0)))
