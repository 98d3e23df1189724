"""Convert the NIR graph of a run to a network for the chip."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.network.chip import LOIHI
from deploy.network.spec import Layer, NetworkSpec, Presentation
from deploy.network.stimulus import Stimulus
from models.architecture import Convolution
from models.integers import on_loihi
from models.nir_graph import NirNetwork
from models.nir_layers import NirLayer, chosen, fired, layers_of
from pipeline.data.dataset import Dataset
from pipeline.roads.layers import chip_layer, host_readout
from pipeline.roads.nir_answers import input_spikes
from pipeline.roads.nir_settings import GRAPH, Stepped, exported_here, give_again, graph_in
from pipeline.settings import Settings

CALIBRATED_ON = 48
"""Training samples on which the scales of the weights are chosen."""


def deployed_nir(
    folder: Path,
    confidence: float | None,
    settings: Settings,
    dataset: Dataset,
    provenance: dict,
) -> NetworkSpec:
    """Describe the deployed network of a run's graph; see :func:`spec_of_nir`.

    Parameters
    ----------
    folder : Path
        Folder of the network.
    confidence : float or None
        Confidence for early decisions; None without early decisions.
    settings, dataset, provenance
    """
    network = graph_in(folder, settings)
    presentation = settings.presented(confidence)
    if (exported := exported_here(network, folder / GRAPH)) is not None:
        fed = (settings.stimulus, dataset.inputs.shape[-3:])
        if fed != (exported.stimulus, exported.input_shape):
            raise UserError(
                f"{settings.nir.file}: exported from a bundle with another input than these "
                f"settings say ({exported.stimulus}); {give_again(settings)}"
            )
        return replace(exported, presentation=presentation, provenance=provenance)
    rng = np.random.default_rng([settings.seed, 0x41B])
    some = np.sort(rng.permutation(dataset.split.train)[:CALIBRATED_ON])
    return spec_of_nir(
        network,
        Stepped.of(settings, network),
        settings.stimulus,
        presentation,
        dataset.inputs[some],
        provenance,
    )


def spec_of_nir(
    network: NirNetwork,
    stepped: Stepped,
    stimulus: Stimulus,
    presentation: Presentation,
    samples,
    provenance: dict,
) -> NetworkSpec:
    """Describe the deployed network of a NIR graph; see :mod:`models.nir_layers` for differences.

    Parameters
    ----------
    network : NirNetwork
    stepped : Stepped
    stimulus : Stimulus
    presentation : Presentation
    samples : ndarray
        Training samples in the format of the stimulus, on which the scales of the weights are
        chosen; their shape is that of the input.
    provenance : dict
        Stored in the bundle.
    """
    samples = np.asarray(samples)
    shape = samples.shape[-3:]
    layers = layers_of(network, stepped.seconds, stepped.method, shape)
    height = stimulus.area / LOIHI.dt  # of a spike of the input neurons, in the graph's units
    signal = input_spikes(stimulus, samples, presentation.steps)
    made = []
    for index, layer in enumerate(layers):
        if not layer.spiking:
            made.append(_readout(layer, presentation))
            continue
        factor = height if index == 0 else 1.0
        scaled = replace(layer, weights=layer.weights * factor)
        made.append(_on_chip(scaled, chosen(scaled, signal), factor))
        signal = fired(scaled, signal)
    return NetworkSpec(
        architecture=notation(shape, layers),
        input_shape=shape,
        stimulus=stimulus,
        layers=tuple(made),
        presentation=presentation,
        provenance=provenance,
    )


def _on_chip(layer: NirLayer, integers, height) -> Layer:
    chip = on_loihi(integers, LOIHI.dt)
    weights = chip.weights * (layer.pool**2 / height)
    weights = weights if layer.kind == "conv" else weights.T
    return chip_layer(chip, weights, _geometry(layer))


def _readout(layer: NirLayer, presentation) -> Layer:
    read = np.arange(presentation.readout_start, presentation.steps) + 1
    # The host's bias is the same at each step: it gets the mean of the graph's.
    bias = layer.bias - layer.fading * np.mean(layer.keep_u**read)
    synapse = float(-LOIHI.dt / np.log(layer.keep_u)) if layer.keep_u > 0 else None
    return host_readout(layer.weights.T, bias, _geometry(layer), synapse)


def _geometry(layer):
    same = ("name", "kind", "input_shape", "shape", "stride", "padding", "pool")
    kernel = layer.weights.shape[0] if layer.kind == "conv" else 0
    geometry = {name: getattr(layer, name) for name in same}
    return {**geometry, "kernel": kernel, "block_shape": None}


def notation(shape, layers) -> str:
    """The layers in the notation of architectures, such as ``10x10x2-12c4s2-64-10o``."""
    parts = ["x".join(map(str, shape))]
    for layer in layers:
        if layer.pool > 1:
            parts.append(f"{layer.pool}a")
        if layer.kind == "conv":
            filters, kernel = layer.shape[-1], layer.weights.shape[0]
            parts.append(str(Convolution(filters, kernel, layer.stride, layer.padding)))
        else:
            parts.append(f"{layer.size}{'o' if layer.name == 'output' else ''}")
    return "-".join(parts)
