"""The deployed network of a run, from what was trained or imported."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deploy.network.chip import LOIHI
from deploy.network.decision import Estimator
from deploy.network.spec import NetworkSpec, Presentation
from deploy.network.stimulus import EventFrames, Stimulus
from models import chain
from models.architecture import parse
from models.integers import from_integers, in_integers
from models.nir_chain import from_nir
from models.nir_graph import NirNetwork
from pipeline.data.dataset import Dataset, require_images_fit
from pipeline.roads.nir_answers import input_spikes
from pipeline.roads.nir_settings import Stepped, graph_in
from pipeline.settings import Settings

CALIBRATED_ON = 48
"""Training samples on which the scales of a graph's weights are chosen."""


def deployed(settings: Settings, weights: dict, provenance: dict, data) -> NetworkSpec:
    """Describe the spiking network on images with the given weights.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the rate-based network.
    provenance : dict
        Stored in the bundle.
    data : (images, labels)
        Training samples, which determine the range of a readout on the chip.

    Raises
    ------
    UserError
        The images cannot be presented to this network.
    """
    images, labels = data
    require_images_fit(images, settings)
    range_of = None
    if settings.deployment.readout == "chip":
        from pipeline.training.networks import TrainedRates

        range_of = TrainedRates(settings, weights).logits(images), labels
    return to_spec(settings, weights, provenance, range_of)


def to_spec(settings: Settings, weights: dict, provenance: dict, range_of=None) -> NetworkSpec:
    """As :func:`deployed`; ``range_of`` is that of :func:`models.chain.from_rates`."""
    architecture, synapse = parse(settings.cnn.architecture), settings.deployment.synapse
    links = chain.from_rates(architecture, weights, settings.snn, synapse, range_of)
    return chain.deployed(links, settings.stimulus, settings.presented(), provenance)


def deployed_on_events(
    settings: Settings, weights: dict, confidence: float, provenance: dict
) -> NetworkSpec:
    """Describe the spiking network trained on events.

    NengoLoihi discretises it to the integers used in training; a step of the chip is a step of the
    recipe, independently of the recording time that it represents.

    Parameters
    ----------
    settings : Settings
        With ``input.kind = "events"``.
    weights : dict
        Weights of a :class:`pipeline.training.events.TrainedOnEvents`.
    confidence : float
        Confidence for an early decision.
    provenance : dict
        Stored in the bundle.
    """
    from pipeline.training.events import EventRecipe

    recipe, presentation = EventRecipe.of(settings), settings.presented(confidence)
    return spec_of_events(recipe, weights, presentation, provenance)


def spec_of_events(
    recipe, weights: dict, presentation: Presentation, provenance: dict
) -> NetworkSpec:
    """As :func:`deployed_on_events`, for a :class:`pipeline.training.events.EventRecipe`."""
    from pipeline.training.events import network_of  # imports TensorFlow

    architecture = parse(recipe.architecture)
    integers = network_of(recipe, weights).integers()
    links = from_integers(architecture, weights, integers, recipe.starts)
    estimator = Estimator.from_arrays(weights, architecture.outputs)
    stimulus = EventFrames(recipe.step_ms / 1000, recipe.rest)
    return chain.deployed(links, stimulus, presentation, provenance, estimator)


def deployed_nir(
    folder: Path,
    confidence: float | None,
    settings: Settings,
    dataset: Dataset,
    provenance: dict,
) -> NetworkSpec:
    """Describe the deployed network of a NIR graph.

    Parameters
    ----------
    folder : Path
        Folder of the graph.
    confidence : float or None
        Confidence for early decisions; None without early decisions.
    settings, dataset
    provenance : dict
        Stored in the bundle.
    """
    network, shown = graph_in(folder, settings), settings.presented(confidence)
    rng = np.random.default_rng([settings.seed, 0x41B])
    samples = dataset.inputs[np.sort(rng.permutation(dataset.split.train)[:CALIBRATED_ON])]
    stepped = Stepped.of(settings, network)
    return spec_of_nir(network, stepped, settings.stimulus, shown, samples, provenance)


def spec_of_nir(
    network: NirNetwork,
    stepped: Stepped,
    stimulus: Stimulus,
    presentation: Presentation,
    samples,
    provenance: dict,
) -> NetworkSpec:
    """As :func:`deployed_nir`, calibrated on samples in the format of the stimulus."""
    read = range(presentation.readout_start, presentation.steps)
    links = from_nir(network, stepped.seconds, stepped.method, samples.shape[-3:], read)
    spikes = input_spikes(stimulus, samples, presentation.steps)
    links = in_integers(links, spikes, stimulus.area / LOIHI.dt)
    return chain.deployed(links, stimulus, presentation, provenance)
