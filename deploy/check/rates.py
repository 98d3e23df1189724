"""Firing rates, and their resolution due to the chip's discrete time steps.

On Loihi the interval between two spikes is a whole number of steps, so a neuron with a constant
input fires at 1000 / k Hz: next to 100 Hz the possible rates are 91 and 111 Hz, next to 250 Hz they
are 200 and 333 Hz.  Different values of the trained network can thus have the same rate.
"""

from __future__ import annotations

from typing import Dict, List

import numpy as np

from ..network.spec import DT, NetworkSpec
from ..network.stream import streams_of
from ..targets.fast import Emulation

COARSE = 0.25
"""Spikes per step above which the next possible rate differs by a quarter or more."""

STREAMS_AT_ONCE = 8
"""Number of streams whose spikes are in memory at a time."""


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


def chip_rates(spec: NetworkSpec, samples) -> Dict[str, dict]:
    """Rate summary of the layers on the chip; see :func:`firing_rates`, :func:`rate_summary`."""
    on_chip = [layer.name for layer in spec.layers if layer.placement == "chip"]
    rates = firing_rates(spec, samples)
    return rate_summary(
        {name: rates[name] for name in on_chip}, spec.stimulus.step_seconds, spec.stimulus.static
    )


def silent_share(rates) -> float:
    """Share of the neurons that are silent on all samples.

    Parameters
    ----------
    rates : ndarray, shape (n_samples, n_neurons)
    """
    return float(np.mean(np.all(np.asarray(rates) <= 0, axis=0)))


def rate_summary(
    rates: Dict[str, np.ndarray], dt: float = DT, steady: bool = True
) -> Dict[str, dict]:
    """Summarise each layer: share of silent neurons; mean, 99th percentile and maximum rate.

    Mean and percentile are over nonzero rates.  Also computed are the relative distance from the
    99th percentile to the next lower rate (``step_at_p99``), and the share of rates above `COARSE`.

    Parameters
    ----------
    rates : dict of str to ndarray, shape (n_samples, n_neurons)
        In spikes per second.
    dt : float
        Duration of a step in seconds.
    steady : bool
        True for a constant input, whose values are encoded as rates; otherwise the resolution of
        rates is not computed.
    """
    summary = {}
    for name, values in rates.items():
        firing = values[values > 0]
        p99 = float(np.percentile(firing, 99)) if firing.size else 0.0
        summary[name] = {
            "silent": silent_share(values),
            "mean_hz": float(firing.mean()) if firing.size else 0.0,
            "p99_hz": p99,
            "max_hz": float(values.max()),
        }
        if steady:
            summary[name].update(
                {
                    "step_at_p99": p99 * dt / (1 + p99 * dt),
                    "coarse_above_hz": COARSE / dt,
                    "coarse": float(np.mean(firing > COARSE / dt)) if firing.size else 0.0,
                }
            )
    return summary


def rates_text(summary: Dict[str, dict], n_samples: int) -> str:
    """Format a rate summary as a few lines."""
    steady = all("coarse" in layer for layer in summary.values())
    seconds = "" if steady else ", per second of the recording"
    lines = [f"firing rates on the emulator, {n_samples} samples{seconds}:"]
    for name, layer in summary.items():
        apart = f" (next rate {layer['step_at_p99']:.0%} lower)" if "coarse" in layer else ""
        lines.append(
            f"  {name}: {layer['silent']:.0%} of the neurons silent; rates of the others:\n    "
            f"mean {layer['mean_hz']:.0f} Hz, 99 % below {layer['p99_hz']:.0f} Hz{apart}, "
            f"at most {layer['max_hz']:.0f} Hz"
        )
    lines += [f"warning: {line}" for line in rate_warnings(summary)]
    return "\n".join(lines)


def rate_warnings(summary: Dict[str, dict]) -> List[str]:
    """Warnings about layers whose rates are too coarse, or that do not fire at all."""
    lines = []
    for name, layer in summary.items():
        if layer["silent"] == 1:
            lines.append(f"layer {name}: no neuron fires; its bias or its weights are too small")
        elif layer.get("coarse", 0) > 0.05:
            lines.append(
                f"layer {name}: {layer['coarse']:.0%} of the rates are above "
                f"{layer['coarse_above_hz']:g} Hz, where rates differ by a quarter or more; "
                "train for lower rates"
            )
    return lines
