"""Answers of a NIR graph as it was written, in floating point, to the samples of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.files import sha256_of
from deploy.network.chip import LOIHI
from deploy.network.responses import Responses, read_output
from deploy.network.stimulus import EventFrames
from models.nir_chain import merges_polarities
from models.nir_graph import NirNetwork, read_nir
from models.nir_simulator import AT_ONCE, simulate
from pipeline.run import DELETE_ITS_FOLDER
from pipeline.settings import Settings

# Versions of the packages that simulate a graph.
NUMPY = {"numpy": np.__version__}

# The run's copy of the graph, in the folder of its network.
GRAPH = "network.nir"


@dataclass(frozen=True)
class Stepped:
    """Division of a graph's time into the chip's steps.

    Attributes
    ----------
    seconds : float
        Seconds of the graph's time per step.
    method : str
        One of :data:`models.nir_simulator.METHODS`.
    """

    seconds: float
    method: str

    @classmethod
    def of(cls, settings: Settings, network: NirNetwork) -> Stepped:
        """The values of the settings, or those of the graph where the settings have none."""
        nir, by_snntorch = settings.nir, network.written_by_snntorch
        seconds = settings.input.step / 1000 if settings.on_events else LOIHI.dt
        if nir.step:
            seconds = nir.step / 1000
        elif network.step is not None:
            seconds = network.step
        method = nir.method
        if method == "auto":
            method = "euler" if by_snntorch else "exact"
        return cls(seconds, method)

    def __str__(self):
        how = "Euler steps" if self.method == "euler" else "exact steps"
        return f"{how} of {1000 * self.seconds:g} ms of the graph's time"


def graph_in(folder: Path, settings: Settings) -> NirNetwork:
    """The run's copy of the graph, in the folder of its network.

    Raises
    ------
    UserError
        The file cannot be read, or is not the graph that was imported.
    """
    path = folder / GRAPH
    network = read_nir(path)
    if sha256_of(path) != settings.nir.sha256:
        raise UserError(f"{path}: has changed since it was imported; {DELETE_ITS_FOLDER}")
    return network


def outputs_of(network, stepped, inputs, settings, advance=None, reset="value"):
    """Simulate the graph on samples of a run.

    Parameters
    ----------
    network : NirNetwork
    stepped : Stepped
    inputs : ndarray
        Images or frames of events, as in :func:`graph_inputs`.
    settings : Settings
    advance : callable, optional
        Called with the number of samples done since the last call.
    reset : str
        As in :func:`models.nir_simulator.simulate`.

    Returns
    -------
    outputs : ndarray, shape (n_samples, steps, classes)
    spikes : dict of str to ndarray of int, shape (n_samples, neurons)
        Number of spikes of each neuron, by the name of its node.
    """
    outputs, counts = [], []
    for start in range(0, len(inputs), AT_ONCE):
        part = inputs[start : start + AT_ONCE]
        presented = graph_inputs(network, part, settings.steps)
        found = simulate(network, presented, stepped.seconds, stepped.method, reset)
        outputs.append(found.outputs.reshape(*found.outputs.shape[:2], -1))
        counts.append({n: _in_places(s.sum(1, dtype=np.int64)) for n, s in found.spikes.items()})
        if advance is not None:
            advance(len(part))
    joined = {name: np.concatenate([part[name] for part in counts]) for name in counts[0]}
    return np.concatenate(outputs), joined


def predictions_of(outputs, settings):
    """Predictions from the mean outputs in the readout window."""
    start = 0 if settings.on_events else settings.presentation.readout_start
    return outputs[:, start:].mean(1).argmax(1)


def graph_inputs(network: NirNetwork, inputs, steps: int) -> np.ndarray:
    """Samples of a run in the form of a graph's input.

    Parameters
    ----------
    network : NirNetwork
    inputs : ndarray
        Images (n_samples, rows, columns, 1), which are presented for ``steps`` steps, or frames of
        events (n_samples, steps, rows, columns, 2).
    steps : int

    Returns
    -------
    ndarray, shape (n_samples, steps, ...)
        Channels first, or flat.
    """
    if inputs.ndim == 4:
        inputs = np.broadcast_to(inputs[:, None], (len(inputs), steps, *inputs.shape[1:]))
    if merges_polarities(network, inputs.shape[-3:]):
        inputs = inputs.max(-1, keepdims=True)
    first = np.moveaxis(inputs, -1, 2)
    return first.reshape(*first.shape[:2], *network.input_shape)


def input_spikes(stimulus, samples, steps):
    """Spikes of the input neurons, 0 or 1, shape (n_samples, steps, values)."""
    if isinstance(stimulus, EventFrames):
        return samples.reshape(*samples.shape[:2], -1).astype(float)
    added = samples.reshape(len(samples), -1) * (stimulus.max_rate * LOIHI.dt)
    voltage = np.full(added.shape, stimulus.initial_phase)
    spikes = np.empty((len(samples), steps, added.shape[1]))
    for t in range(steps):
        voltage += added
        spikes[:, t] = voltage >= 1
        voltage -= spikes[:, t]
    return spikes


def _in_places(values):
    """Values (n, channels, rows, columns), or flat, converted to the chip's order and flattened."""
    moved = np.moveaxis(values, 1, -1) if values.ndim > 2 else values
    return moved.reshape(len(values), -1)


def graph_responses(folder: Path, settings: Settings, bundle: Bundle, advance=None) -> Responses:
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
    network, inputs, spec = graph_in(folder, settings), bundle.checks.inputs, bundle.spec
    stepped, reset = Stepped.of(settings, network), settings.nir.reset
    outputs, counts = outputs_of(network, stepped, inputs, settings, advance, reset)
    readout = spec.layers[-1]
    if readout.neurons is None:
        outputs = outputs - readout.bias  # which read_output adds
    if spec.stimulus.static:  # a graph takes the image itself, not spikes
        sizes = {"input": int(np.prod(spec.input_shape))}
        sizes |= {layer.name: layer.size for layer in spec.layers if layer.neurons}
        silent = {name: np.zeros((len(inputs), size)) for name, size in sizes.items()}
        found = read_output(replace(spec, estimator=None), outputs, silent)
        return replace(found, spikes={}, operations={})
    spikes = {"input": inputs.reshape(*inputs.shape[:2], -1).sum(1, dtype=np.int64)}
    names = [name for name in spec.spiking_layers if name != "input"]
    spikes |= dict(zip(names, counts.values(), strict=True))
    return read_output(spec, outputs, spikes)
