"""Which layer loses: firing rates on the chip against the rate-based network's activations.

Of a layer's neurons, two shares say whether they can tell inputs apart at all:

- *silent*: neurons that fire on none of the samples;
- *saturated*: neurons that on at least 1 % of the samples fire at 90 % or more of the fastest rate
  there is, 1 / (tau_ref + dt): one spike each refractory period and the step after it.  A larger
  input changes nothing there.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from deploy.network.responses import streams_of
from deploy.network.spec import DT, NetworkSpec
from deploy.targets.fast.emulation import Emulation, compile_spec

NEAR_FASTEST = 0.9
"""Share of the fastest rate from which a neuron is at its limit."""

SATURATED_SAMPLES = 0.01
"""Share of the samples on which a saturated neuron is at its limit, at the least."""

STREAMS_AT_ONCE = 8
"""Streams whose every spike is held in memory at a time."""


@dataclass(frozen=True)
class Activity:
    """Neurons of a layer that cannot tell inputs apart; see the module.

    Attributes
    ----------
    silent, saturated : float
        Shares of the layer's neurons.
    """

    silent: float
    saturated: float


@dataclass(frozen=True)
class LayerFidelity:
    """How well a convolution's firing rates on the chip stand for its activations.

    Attributes
    ----------
    layer : str
    correlation : float or None
        Pearson's, over all neurons and samples; None where either side does not vary.
    worst_error, mean_error : float
        Largest and mean magnitude of rate less activation, in units of ``max_rate``.
    chip, rate_network : Activity
    """

    layer: str
    correlation: float | None
    worst_error: float
    mean_error: float
    chip: Activity
    rate_network: Activity


def fastest_rate(tau_ref: float) -> float:
    """Spikes a second that a neuron with whole-step intervals cannot exceed."""
    return 1 / (DT * (round(tau_ref / DT) + 1))


def activity(rates, fastest: float) -> Activity:
    """Count silent and saturated neurons.

    Parameters
    ----------
    rates : ndarray, shape (n_samples, n_neurons)
        In spikes a second.
    fastest : float
        See :func:`fastest_rate`.
    """
    rates = np.asarray(rates)
    at_limit = np.mean(rates >= NEAR_FASTEST * fastest, axis=0)
    return Activity(
        silent=float(np.mean(np.all(rates <= 0, axis=0))),
        saturated=float(np.mean(at_limit >= SATURATED_SAMPLES)),
    )


def fidelity(layer: str, rates, activations, max_rate: float, tau_ref: float) -> LayerFidelity:
    """Compare a layer's firing rates with its activations.

    Parameters
    ----------
    layer : str
        Its name.
    rates : ndarray, shape (n_samples, n_neurons)
        On the chip, in spikes a second.
    activations : ndarray, shape (n_samples, n_neurons)
        Of the rate-based network, on the same samples; 1 stands for ``max_rate``.
    max_rate : float
        Spikes a second at activation 1.
    tau_ref : float
        Refractory period in seconds.
    """
    measured, expected = np.asarray(rates) / max_rate, np.asarray(activations)
    error = np.abs(measured - expected)
    varies = np.ptp(measured) > 0 and np.ptp(expected) > 0
    fastest = fastest_rate(tau_ref)
    return LayerFidelity(
        layer=layer,
        correlation=float(np.corrcoef(measured.ravel(), expected.ravel())[0, 1])
        if varies
        else None,
        worst_error=float(error.max()),
        mean_error=float(error.mean()),
        chip=activity(rates, fastest),
        rate_network=activity(expected * max_rate, fastest),
    )


def window_rates(spec: NetworkSpec, images, seed: int = 0, advance=None) -> dict:
    """Firing rates in the readout window, by the fast emulator, in the network's presentation.

    Parameters
    ----------
    spec : NetworkSpec
    images : ndarray, shape (n_samples, ...)
    seed : int
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        Of each convolution, in spikes a second from ``readout_start`` on.
    """
    emulation = Emulation(compile_spec(spec, seed))
    shown = spec.presentation
    sizes = {layer.name: layer.size for layer in spec.layers if layer.kind == "conv"}
    window = shown.steps - shown.readout_start
    images = np.asarray(images, float).reshape(len(images), -1)
    counts = {name: [] for name in sizes}
    for batch in _batches(images, shown.stream_length):
        of_batch = {name: [] for name in sizes}

        def watch(spikes, of_batch=of_batch):
            """Spikes of one sample of each stream, packed to bits."""
            for name, size in sizes.items():
                read = np.unpackbits(spikes[name][:, -window:], axis=2, count=size)
                of_batch[name].append(read.sum(axis=1))

        emulation.run(batch, shown.steps, shown.gap, watch=watch)
        for name, of_samples in of_batch.items():
            counts[name].append(np.stack(of_samples, axis=1).reshape(-1, sizes[name]))
        if advance is not None:
            advance(batch.shape[0] * batch.shape[1])
    return {name: np.concatenate(parts) / (window * DT) for name, parts in counts.items()}


def _batches(images, stream_length):
    """Arrays of streams of one length each, shape (n_streams, n_samples, n_pixels), in order."""
    whole = [part for part in streams_of(len(images), stream_length)]
    rest = [whole.pop()] if len(images) % stream_length else []
    for first in range(0, len(whole), STREAMS_AT_ONCE):
        yield np.stack([images[part] for part in whole[first : first + STREAMS_AT_ONCE]])
    for part in rest:
        yield images[part][None]


def layers_json(spec: NetworkSpec, images, activations: dict, seed: int = 0, advance=None) -> list:
    """Compare every convolution; each a dict of :class:`LayerFidelity`'s attributes.

    Parameters
    ----------
    spec, images, seed, advance
        As in :func:`window_rates`.
    activations : dict of str to ndarray, shape (n_samples, n_neurons)
        Of the rate-based network, on the same images.
    """
    rates = window_rates(spec, images, seed, advance)
    neurons = {layer.name: layer.neurons for layer in spec.layers}
    return [
        asdict(
            fidelity(
                name,
                rates[name],
                activations[name],
                max_rate=1 / neurons[name].amplitude,
                tau_ref=neurons[name].tau_ref,
            )
        )
        for name in rates
    ]


def least_faithful(layers: list) -> str:
    """Name of the layer with the lowest correlation; one that does not vary at all is lower yet."""
    return min(
        layers, key=lambda layer: -2 if layer["correlation"] is None else layer["correlation"]
    )["layer"]


def layers_text(layers: list) -> str:
    """The comparison as a table that says what its columns mean."""
    lines = [
        "firing rate on the chip in the readout window against the rate network's activation:",
        f"  {'layer':<8} {'correlation':>11} {'worst error':>11} {'mean error':>10} "
        f"{'silent':>15} {'saturated':>15}",
    ]
    for layer in layers:
        r = layer["correlation"]
        chip, rate = layer["chip"], layer["rate_network"]
        shares = " ".join(
            f"{chip[name]:>6.1%} ({rate[name]:>6.1%})" for name in ("silent", "saturated")
        )
        lines.append(
            f"  {layer['layer']:<8} {'-' if r is None else format(r, '.4f'):>11} "
            f"{layer['worst_error']:>11.3f} {layer['mean_error']:>10.4f} {shares}"
        )
    lines += [
        f"  lowest correlation: {least_faithful(layers)}",
        "  errors in units of max_rate; in brackets the rate network.  silent: share of neurons",
        "  that fire on no sample; saturated: share that on 1 % of the samples or more fire at",
        "  90 % or more of the fastest rate, 1 / (tau_ref + 1 step)",
    ]
    return "\n".join(lines)


def training_lines(neurons: dict) -> list:
    """What to say of the neurons after training, a line a layer, with a warning where it is due.

    Parameters
    ----------
    neurons : dict of str to dict
        Of each layer, :class:`Activity`'s attributes.
    """
    lines = []
    for name, layer in neurons.items():
        line = f"{name}: {layer['silent']:.1%} silent, {layer['saturated']:.1%} saturated"
        if layer["silent"] == 1:
            line = f"warning: {line}: the layer is dead; lower the learning rate or max_rates"
        elif layer["silent"] > 0.5:
            line = f"warning: {line}: most of its neurons never fire"
        elif layer["saturated"] > 0.1:
            line = f"warning: {line}: lower max_rates, or train with smaller weights"
        lines.append(line)
    return lines
