"""Simulation of a run's graph in floating point, on the samples of the run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.responses import Responses, compute_responses
from models.nir.chain import merges_polarities
from models.nir.graph import NirNetwork
from models.nir.simulator import SAMPLES_AT_ONCE, simulate
from pipeline.kinds.nir.importing import Stepping, read_copy_of_graph
from pipeline.settings import Settings

# Versions of the packages that simulate a graph.
NUMPY = {"numpy": np.__version__}


def simulate_samples(network, stepping, inputs, settings, advance=None):
    """Simulate the graph on samples of a run.

    Parameters
    ----------
    network : NirNetwork
    stepping : Stepping
    inputs : ndarray
        Images or frames of events, as in :func:`make_graph_inputs`.
    settings : Settings
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    outputs : ndarray, shape (n_samples, steps, classes)
    spikes : dict of str to ndarray of int, shape (n_samples, neurons)
        Number of spikes of each neuron, by the name of its node.
    """
    outputs = []
    counts = []
    for start in range(0, len(inputs), SAMPLES_AT_ONCE):
        batch = inputs[start : start + SAMPLES_AT_ONCE]
        presented = make_graph_inputs(network, batch, settings.steps)
        result = simulate(network, presented, stepping.step_s, stepping.method, stepping.reset)
        outputs.append(result.outputs.reshape(*result.outputs.shape[:2], -1))
        counts.append(
            {n: _put_in_chip_order(s.sum(1, dtype=np.int64)) for n, s in result.spikes.items()}
        )
        if advance is not None:
            advance(len(batch))
    joined = {}
    for name in counts[0]:
        joined[name] = np.concatenate([batch[name] for batch in counts])
    return np.concatenate(outputs), joined


def compute_predictions(outputs, settings):
    """Predictions from the mean outputs in the readout window."""
    start = 0 if settings.on_events else settings.presentation.readout_start
    return outputs[:, start:].mean(1).argmax(1)


def make_graph_inputs(network: NirNetwork, inputs, n_steps: int) -> np.ndarray:
    """Samples of a run in the form of a graph's input.

    Parameters
    ----------
    network : NirNetwork
    inputs : ndarray
        Images (n_samples, rows, columns, channels), which are presented for ``n_steps`` steps, or
        frames of events (n_samples, steps, rows, columns, 2).
    n_steps : int

    Returns
    -------
    ndarray, shape (n_samples, steps, ...)
        Channels first, or flat.
    """
    if inputs.ndim == 4:
        inputs = np.broadcast_to(inputs[:, None], (len(inputs), n_steps, *inputs.shape[1:]))
    if merges_polarities(network, inputs.shape[-3:]):
        inputs = inputs.max(-1, keepdims=True)
    first = np.moveaxis(inputs, -1, 2)
    return first.reshape(*first.shape[:2], *network.input_shape)


def _put_in_chip_order(values):
    """Values (n, channels, rows, columns), or flat, converted to the chip's order and flattened."""
    return (np.moveaxis(values, 1, -1) if values.ndim > 2 else values).reshape(len(values), -1)


def compute_graph_responses(
    folder: Path, settings: Settings, bundle: Bundle, advance=None
) -> Responses:
    """Responses of the original graph to a bundle's samples, in floating point, each from rest.

    Parameters
    ----------
    folder : Path
        Folder of the graph.
    settings : Settings
    bundle : Bundle
    advance : callable, optional
        Called with the number of samples done since the last call.
    """
    network = read_copy_of_graph(folder, settings)
    inputs = bundle.checks.inputs
    spec = bundle.spec
    stepping = Stepping.from_settings(settings, network)
    outputs, counts = simulate_samples(network, stepping, inputs, settings, advance)
    readout = spec.layers[-1]
    if readout.neurons is None:
        outputs = outputs - readout.bias  # which compute_responses adds
    if spec.stimulus.is_static:  # a graph takes the image itself, not spikes
        sizes = {"input": int(np.prod(spec.input_shape))}
        sizes |= {layer.name: layer.size for layer in spec.layers if layer.neurons}
        silent = {name: np.zeros((len(inputs), size)) for name, size in sizes.items()}
        responses = compute_responses(replace(spec, estimator=None), outputs, silent)
        return replace(responses, spikes={}, operations={})
    spikes = {"input": inputs.reshape(*inputs.shape[:2], -1).sum(1, dtype=np.int64)}
    names = [name for name in spec.spiking_layers if name != "input"]
    spikes |= dict(zip(names, counts.values(), strict=True))
    return compute_responses(spec, outputs, spikes)
