"""Firing rates, against the whole steps that the chip counts in.

On Loihi the time between two spikes is a whole number of steps, so a neuron with a steady input
fires at 1000 / k Hz and nothing between: at 100 Hz the next rates are 91 and 111 Hz, at 250 Hz they
are 200 and 333 Hz.  Values that a network was trained to keep apart fall together there.
"""

from __future__ import annotations

from typing import Dict, List

import numpy as np

from ..network.build import build
from ..network.loihi_import import nengo_loihi
from ..network.spec import DT, NetworkSpec

COARSE_HZ = 250
"""Above this the neighbouring rates are a quarter and more away."""


def firing_rates(spec: NetworkSpec, images) -> Dict[str, np.ndarray]:
    """Rates of each neuron of each spiking layer on the chip, by NengoLoihi's emulator.

    Parameters
    ----------
    spec : NetworkSpec
    images : ndarray, shape (n_samples, ...)
        Shown one after the other in one stream.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        In Hz, while the sample is shown.
    """
    images = np.asarray(images, float).reshape(len(images), -1)
    built = build(spec)
    built.feed.images = images
    on_chip = [layer.name for layer in spec.layers if layer.placement == "chip"]
    counts = {name: [] for name in on_chip}
    with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:
        for _ in images:
            sim.run_steps(built.feed.period)
            for name in on_chip:
                shown = sim.data[built.spikes[name]][spec.presentation.gap :]
                counts[name].append(np.count_nonzero(shown, axis=0))
            sim.clear_probes()
    return {name: np.array(rows) / (spec.presentation.steps * DT) for name, rows in counts.items()}


def rate_summary(rates: Dict[str, np.ndarray]) -> Dict[str, dict]:
    """Of each layer: share of silent neurons, mean, 99th percentile and maximum of the others.

    Also how far, relative to it, the next lower rate is from the 99th percentile
    (``step_at_p99``), and the share of the firing neurons above `COARSE_HZ`.
    """
    summary = {}
    for name, values in rates.items():
        firing = values[values > 0]
        p99 = float(np.percentile(firing, 99)) if firing.size else 0.0
        summary[name] = {
            "silent": float(np.mean(values == 0)),
            "mean_hz": float(firing.mean()) if firing.size else 0.0,
            "p99_hz": p99,
            "max_hz": float(values.max()),
            "step_at_p99": p99 * DT / (1 + p99 * DT),
            "coarse": float(np.mean(firing > COARSE_HZ)) if firing.size else 0.0,
        }
    return summary


def rates_text(summary: Dict[str, dict], n_samples: int) -> str:
    """A summary in a few lines."""
    lines = [f"firing rates on the emulator, {n_samples} samples:"]
    for name, layer in summary.items():
        lines.append(
            f"  {name}: {layer['silent']:.0%} silent; the others: mean {layer['mean_hz']:.0f} Hz, "
            f"99 % below {layer['p99_hz']:.0f} Hz (next rate {layer['step_at_p99']:.0%} lower), "
            f"at most {layer['max_hz']:.0f} Hz"
        )
    lines += [f"warning: {line}" for line in rate_warnings(summary)]
    return "\n".join(lines)


def rate_warnings(summary: Dict[str, dict]) -> List[str]:
    """Layers whose rates are too coarse, or that do not fire at all."""
    lines = []
    for name, layer in summary.items():
        if layer["silent"] == 1:
            lines.append(f"layer {name}: no neuron fires; its bias or its weights are too small")
        elif layer["coarse"] > 0.05:
            lines.append(
                f"layer {name}: {layer['coarse']:.0%} of the firing neurons are above {COARSE_HZ} "
                "Hz, where rates are a quarter and more apart; train for lower rates"
            )
    return lines
