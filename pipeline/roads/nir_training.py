"""Use a NIR graph as the initial network of a training on events.

The network on events (:mod:`models.spiking`) has layers of current-based neurons with a leak, which
reset to 0, and an output that adds up weights over the spikes of the last layer.  A graph of LIF
and CubaLIF neurons becomes one with the same weights and time constants.  These changes are made
before the first step of training:

=====================  =========================================================================
averaging              is folded into the kernel and the stride of the next convolution
spiking outputs        become a hidden layer whose spikes the output counts
a filter at the end    is left out: it shifts the outputs in time but does not change their sum
biases of the outputs  are left out: the output has none
biases of neurons      are limited so that no neuron fires without input
lower voltage bound    NIR has none; here it is that of :class:`models.spiking.Neuron`
scale of the outputs   is multiplied by the power of two with the least cross-entropy
=====================  =========================================================================
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from models.integers import DECAY_UNIT
from models.nir_graph import SPIKING, NirNetwork, read_nir
from models.nir_layers import NirLayer, layers_of
from pipeline.roads.nir_conversion import notation
from pipeline.roads.nir_settings import Stepped, graph_in, settings_of_nir
from pipeline.settings import Settings

TRAINABLE = ("LIF", "CubaLIF")
"""Nodes whose neurons are those of the network on events."""

SCALED_ON = 256
"""Maximum number of training samples on which the scale of the outputs is chosen."""

NO_BUDGET = 1000.0
"""Budget of synaptic operations in multiples of the CNN's: none for a user's network."""

SCALES = 2.0 ** np.arange(-12, 9)
"""Candidate factors of the outputs."""


def settings_of_retrained(
    path, step: float | None = None, kind: str | None = None, before: Settings | None = None
) -> dict:
    """Changes of the settings that let a run train a NIR graph further.

    Samples are presented as to any network on events, because its biases settle in the gap.

    Parameters
    ----------
    path, step, kind, before
        As in :func:`pipeline.roads.nir_settings.settings_of_nir`.

    Raises
    ------
    UserError
        As there, and as :func:`trainable`; or the graph is for images.
    """
    changes = settings_of_nir(path, step, kind, before, retrain=True)
    network = read_nir(path)
    if changes["input"]["kind"] != "events":
        raise UserError(
            f"{path}: --retrain trains networks on events, and {network.nodes[0]} reads an image; "
            "train it further in PyTorch, or give a graph with two channels"
        )
    shape, usual = network.input_shape, Settings().presentation
    side = round((math.prod(shape) / 2) ** 0.5)
    place = (*shape[1:], 2) if len(shape) == 3 else (side, side, 2)
    try:
        architecture = architecture_of(network, place)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    if "presentation" not in changes:  # the run trains a graph with this input already
        return {**changes, "events": {"architecture": architecture}}
    return {
        **changes,
        "events": {"architecture": architecture, "budget": NO_BUDGET},
        "presentation": {name: getattr(usual, name) for name in ("gap", "stream_length")},
    }


def trainable(network: NirNetwork, step: float, method: str, input_shape) -> tuple:
    """A graph's layers in the form of the network on events.

    Parameters
    ----------
    network : NirNetwork
    step, method, input_shape
        As in :func:`models.nir_layers.layers_of`.

    Returns
    -------
    tuple of NirLayer
        Without pooling; the last one does not spike and has neither filter nor biases.

    Raises
    ------
    UserError
        A node's neurons are not those of the network on events, or it averages before a
        convolution with padding; the message names the node.
    """
    for node in network.nodes:
        if node.kind in SPIKING and node.kind not in TRAINABLE:
            raise UserError(
                f"{node}: --retrain continues training LIF and CubaLIF, the neurons of the network "
                "on events; use one of them in PyTorch, or convert without --retrain"
            )
    layers = []
    for layer in layers_of(network, step, method, input_shape):
        if layer.pool > 1 and layer.padding != "valid":
            pools = [n for n in network.nodes if n.name in layer.nodes and "Pool" in n.kind]
            raise UserError(
                f"{pools[0]}: --retrain trains no averaging before a convolution with padding; use "
                "a stride, or no padding, or convert without --retrain"
            )
        layers.append(_unpooled(layer))
    if layers[-1].spiking:
        dense = sum(layer.kind == "dense" for layer in layers)
        layers[-1] = replace(layers[-1], name=f"dense{dense}")
        outputs = layers[-1].shape
        counted = ("output", (), False, "dense", outputs, outputs)
        layers.append(NirLayer(*counted, weights=np.eye(*outputs), bias=np.zeros(outputs)))
    return tuple(layers)


def _unpooled(layer):
    """The layer with its averaging folded into kernel and stride, as on the chip."""
    if layer.pool == 1:
        return layer
    kernel = layer.weights.repeat(layer.pool, 0).repeat(layer.pool, 1) / layer.pool**2
    return replace(layer, weights=kernel, stride=layer.stride * layer.pool, pool=1)


def architecture_of(network: NirNetwork, input_shape) -> str:
    """The architecture of a graph that is trained further, in the notation of the settings.

    Parameters
    ----------
    network : NirNetwork
    input_shape : tuple of int
        (rows, columns, channels).

    Raises
    ------
    UserError
        As :func:`trainable`.
    """
    times = [node[name].min() for node in network.nodes for name in ("tau", "tau_syn", "tau_mem")
             if name in node.parameters]  # fmt: skip
    step = float(min(times, default=1.0))  # any valid one: shapes do not depend on it
    return notation(input_shape, trainable(network, step, "exact", input_shape))


def start(folder: Path, settings: Settings, samples) -> tuple:
    """The initial weights of the training.

    Parameters
    ----------
    folder : Path
        Folder of the graph.
    settings : Settings
    samples : pipeline.roads.event_training.EventSamples

    Returns
    -------
    weights : dict of str to ndarray
        See :meth:`models.spiking.SpikingNetwork.get_weights`.
    lines : list of str
        Messages about the weights.
    """
    from models.spiking import BIAS_CAP  # imports TensorFlow
    from pipeline.training.events import EventRecipe, answer_frames

    network = graph_in(folder, settings)
    stepped, recipe = Stepped.of(settings, network), EventRecipe.of(settings)
    shape = (*samples.table.size, 2)
    layers = trainable(network, stepped.seconds, stepped.method, shape)
    weights = weights_of(layers)
    limited = sum(int((x.bias > BIAS_CAP * (1 - x.keep_v)).sum()) for x in layers[:-1])
    some = samples.train[np.linspace(0, len(samples.train) - 1,
                                     min(len(samples.train), SCALED_ON)).astype(int)]  # fmt: skip
    frames = np.moveaxis(
        samples.table.frames(some, recipe.step_ms, settings.steps, recipe.rest), 0, 1
    )
    scores = answer_frames(recipe, weights, frames).outputs[:, -1].astype(float)
    labels = samples.labels[some]
    weights["output.kernel"] = weights["output.kernel"] * best_scale(scores, labels)
    lines = [
        f"trained further from an accuracy of {(scores.argmax(1) == labels).mean():.3f} on "
        f"{len(some)} training samples, as {recipe.architecture}"
    ]
    if limited:
        lines.append(f"{limited} biases are limited so that no neuron fires without input")
    return weights, lines


def weights_of(layers) -> dict:
    """Layers as weights by the names of :meth:`models.spiking.SpikingNetwork.get_weights`.

    Parameters
    ----------
    layers : sequence of NirLayer
        From :func:`trainable`.
    """
    weights = {"output.kernel": layers[-1].weights}
    for layer in layers[:-1]:
        weights[f"{layer.name}.kernel"] = layer.weights
        weights[f"{layer.name}.bias"] = layer.bias
        for name, keep in (("tau_u", layer.keep_u), ("tau_v", layer.keep_v)):
            share = np.clip(keep, 2 / DECAY_UNIT, 1 - 1 / DECAY_UNIT)
            weights[f"{layer.name}.{name}"] = -1 / np.log(share)
    return weights


def best_scale(scores, labels) -> float:
    """The factor in :data:`SCALES` with which scores, as logits, have the least cross-entropy.

    Parameters
    ----------
    scores : ndarray, shape (n_samples, classes)
    labels : ndarray of int, shape (n_samples,)
    """
    logits = scores[None] * SCALES[:, None, None]
    logits -= logits.max(2, keepdims=True)
    right = np.take_along_axis(logits, labels[None, :, None].astype(int), 2)[..., 0]
    loss = (np.log(np.exp(logits).sum(2)) - right).mean(1)
    return float(SCALES[loss.argmin()])
