"""Compare firing rates on the chip with the rate-based network's activations, layer by layer.

Two shares of a layer's neurons measure how much information they can transmit:

- *silent*: neurons that fire on none of the samples;
- *saturated*: neurons that on at least 1 % of the samples fire at 90 % or more of the fastest
  possible rate 1 / (tau_ref + dt), one spike per refractory period and one more step.  A larger
  input does not change their rate.
"""

import numpy as np

from deploy.network.chip import DT
from deploy.network.spec import NetworkSpec
from deploy.tables import align_rows, format_count
from deploy.terminal import WARNING

# Share of the fastest rate from which a neuron counts as saturated on a sample.
SATURATED_RATE_SHARE = 0.9

# Minimum share of the samples on which a saturated neuron is at its limit.
MIN_SATURATED_SAMPLE_SHARE = 0.01


def compute_fastest_rate(tau_ref: float) -> float:
    """Largest rate in spikes per second of a neuron with intervals of whole steps."""
    return 1 / (DT * (round(tau_ref / DT) + 1))


def measure_activity(rates, fastest: float) -> dict:
    """Shares of ``silent`` and ``saturated`` neurons of a layer; see the module's docstring.

    Parameters
    ----------
    rates : ndarray, shape (n_samples, n_neurons)
        In spikes per second.
    fastest : float
        See :func:`compute_fastest_rate`.
    """
    rates = np.asarray(rates)
    at_limit = np.mean(rates >= SATURATED_RATE_SHARE * fastest, axis=0)
    saturated = float(np.mean(at_limit >= MIN_SATURATED_SAMPLE_SHARE))
    return {"silent": float(np.mean(np.all(rates <= 0, axis=0))), "saturated": saturated}


def compare_layer(layer: str, rates, activations, max_rate: float, tau_ref: float) -> dict:
    """Compare a layer's firing rates with its activations.

    Parameters
    ----------
    layer : str
        Name of the layer.
    rates : ndarray, shape (n_samples, n_neurons)
        Rates on the chip, in spikes per second.
    activations : ndarray, shape (n_samples, n_neurons)
        Activations of the rate-based network on the same samples; 1 means ``max_rate``.
    max_rate : float
        Spikes per second at activation 1.
    tau_ref : float
        Refractory period in seconds.

    Returns
    -------
    dict
        ``layer``; ``n_samples``; the ``correlation`` (Pearson) over all neurons and samples, None
        if either side is constant; ``worst_error`` and ``mean_error``, the largest and the mean
        magnitude of rate minus activation, in units of ``max_rate``; :func:`measure_activity` on
        the ``chip`` and in the ``rate_network``.
    """
    measured = np.asarray(rates) / max_rate
    expected = np.asarray(activations)
    error = np.abs(measured - expected)
    correlation = None
    if np.ptp(measured) > 0 and np.ptp(expected) > 0:
        correlation = float(np.corrcoef(measured.ravel(), expected.ravel())[0, 1])
    fastest = compute_fastest_rate(tau_ref)
    return {
        "layer": layer,
        "n_samples": len(measured),
        "correlation": correlation,
        "worst_error": float(error.max()),
        "mean_error": float(error.mean()),
        "chip": measure_activity(rates, fastest),
        "rate_network": measure_activity(expected * max_rate, fastest),
    }


def compare_rates(spec: NetworkSpec, rates: dict, activations: dict) -> list:
    """Compare the firing rates of every layer with its activations; see :func:`compare_layer`.

    Parameters
    ----------
    spec : NetworkSpec
    rates : dict of str to ndarray, shape (n_samples, n_neurons)
        On the chip in the readout window, from :func:`deploy.targets.fast.measure_firing_rates`.
    activations : dict of str to ndarray, shape (n_samples, n_neurons)
        Activations of the rate-based network on the same images.
    """
    neurons = {layer.name: layer.neurons for layer in spec.layers if layer.neurons is not None}
    return [
        compare_layer(name, rates[name], values, 1 / neurons[name].amplitude, neurons[name].tau_ref)
        for name, values in activations.items()
    ]


def find_least_faithful(layers: list) -> str:
    """Name of the layer with the lowest correlation, where a constant layer counts as lowest."""
    return min(
        layers, key=lambda layer: -2 if layer["correlation"] is None else layer["correlation"]
    )["layer"]


def format_layers(layers: list) -> str:
    """The comparison as a table with an explanation of its columns."""
    rows = [("layer", "correlation", "worst error", "mean error", "silent", "saturated")]
    for layer in layers:
        r = layer["correlation"]
        chip = layer["chip"]
        rate = layer["rate_network"]
        shares = (f"{chip[name]:.1%} ({rate[name]:6.1%})" for name in ("silent", "saturated"))
        errors = (f"{layer['worst_error']:.3f}", f"{layer['mean_error']:.4f}")
        rows.append((layer["layer"], "-" if r is None else f"{r:.4f}", *errors, *shares))
    samples = (
        format_count(layers[0]["n_samples"], "sample") if "n_samples" in layers[0] else "samples"
    )
    lines = [
        "firing rate on the chip in the readout window against the rate network's activation,",
        f"on {samples}:",
        *(f"  {line}" for line in align_rows(rows)),
        f"  lowest correlation: {find_least_faithful(layers)}",
        "  errors in units of max_rate; in brackets the rate network.  silent: share of neurons",
        "  that fire on no sample; saturated: share that on 1 % of the samples or more fire at",
        "  90 % or more of the fastest rate, 1 / (tau_ref + 1 step)",
    ]
    return "\n".join(lines)


def describe_neurons(neurons: dict) -> list:
    """Lines about the neurons after training, one per layer, with warnings.

    Parameters
    ----------
    neurons : dict of str to dict
        The :func:`measure_activity` of each layer.
    """
    lines = []
    for name, layer in neurons.items():
        line = f"{name}: {layer['silent']:.1%} silent, {layer['saturated']:.1%} saturated"
        if layer["silent"] == 1:
            line = f"{WARNING}{line}: the layer is dead; lower the learning rate or max_rates"
        elif layer["silent"] > 0.5:
            line = f"{WARNING}{line}: most of its neurons never fire; a smaller layer may do"
        elif layer["saturated"] > 0.1:
            line = f"{WARNING}{line}: lower max_rates, or train with smaller weights"
        lines.append(line)
    return lines
