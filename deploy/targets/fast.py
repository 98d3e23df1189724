"""The target ``fast``: bit-identical to NengoLoihi's emulator, with many streams at once."""

from __future__ import annotations

import warnings
from typing import Dict, Iterator, List

import numpy as np

from ..network.output import TargetOutput, hash_spikes
from ..network.spec import NetworkSpec
from .emulation import MAX_SPIKE_BYTES, Emulation

# Sums that can overflow, by NengoLoihi's names: input, current, current and bias.
OVERFLOWS = ("q0", "current", "u2")

# Number of streams whose spikes are in memory at a time.
STREAMS_AT_ONCE = 8


def run_fast(spec, streams, seed=0, options=None) -> Iterator[TargetOutput]:
    """Run NengoLoihi's emulator, with identical integers and spikes, on many streams at once.

    It is the ``run`` of a :class:`~.registry.Target` without options.
    """
    return run_in_batches(spec, streams, seed, MAX_SPIKE_BYTES)


def run_in_batches(spec, streams, seed, max_spike_bytes: int) -> Iterator[TargetOutput]:
    """:func:`run_fast` on as many streams at once as the memory has room for.

    Parameters
    ----------
    spec, streams, seed
        As in :class:`~.registry.Target`.
    max_spike_bytes : int
        Maximum memory for the spikes of a batch of streams; the outputs do not depend on it.
    """
    emulation = Emulation(spec, seed)
    gap = spec.presentation.gap

    def count_fitting_streams(n_samples):
        """Number of streams of some length that fit into the memory."""
        spikes = emulation.count_bytes_per_step(1) * spec.presentation.period
        return max(1, max_spike_bytes // (spikes + emulation.count_bytes_kept() * n_samples))

    for batch in _list_batches(streams, count_fitting_streams):
        hashes: List[list] = []

        def watch(packed, hashes=hashes):
            """Hash the spikes of one sample of each stream."""
            rows = [packed[name] for name in spec.spiking_layers]
            hashes.append([hash_spikes(layers) for layers in zip(*rows)])

        outputs = emulation.run(np.stack(batch), watch, max_spike_bytes)
        _warn_of_overflows(outputs.overflows)
        for index, output in enumerate(outputs.output):
            counts = {name: outputs.counts[name][index] for name in spec.spiking_layers}
            yield TargetOutput(output[:, gap:], counts, np.transpose(hashes)[index])


def _list_batches(streams, count_fitting_streams):
    """Lists of consecutive streams of equal length, as many as fit at once."""
    batch = []
    for stream in streams:
        if batch and (
            len(batch) == count_fitting_streams(len(stream)) or len(stream) != len(batch[0])
        ):
            yield batch
            batch = []
        batch.append(stream)
    if batch:
        yield batch


def _warn_of_overflows(overflows):
    """Warn of the overflows of each layer."""
    for name, counts in overflows.items():
        if counts.any():
            texts = [f"{count} in {number}" for count, number in zip(counts, OVERFLOWS) if count]
            message = f"layer {name!r}: overflows of the chip's integers: {', '.join(texts)}"
            warnings.warn(message, RuntimeWarning, stacklevel=3)


def measure_firing_rates(
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
    counts: Dict[str, List[np.ndarray]] = {name: [] for name in sizes}
    flat = spec.stimulus.flatten(samples)
    streams = [flat[stream] for stream in presentation.list_streams(len(flat))]
    for batch in map(np.stack, _list_batches(streams, lambda n_samples: STREAMS_AT_ONCE)):
        of_batch: Dict[str, List[np.ndarray]] = {name: [] for name in sizes}

        def watch(spikes, of_batch=of_batch):
            """Unpack and count the spikes of one sample of each stream."""
            for name, size in sizes.items():
                in_window = np.unpackbits(spikes[name][:, -window:], axis=2, count=size)
                of_batch[name].append(in_window.sum(axis=1))

        emulation.run(batch, watch)
        for name, of_samples in of_batch.items():
            counts[name].append(np.stack(of_samples, axis=1).reshape(-1, sizes[name]))
        if advance is not None:
            advance(batch.shape[0] * batch.shape[1])
    seconds = window * spec.stimulus.step_seconds
    return {name: np.concatenate(arrays) / seconds for name, arrays in counts.items()}
