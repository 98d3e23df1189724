"""Convert a network trained on events to the deployed network."""

from __future__ import annotations

import numpy as np

from deploy.network.chip import LOIHI
from deploy.network.decision import Estimator
from deploy.network.spec import NetworkSpec, Presentation
from deploy.network.stimulus import EventFrames
from models.architecture import parse
from models.integers import on_loihi
from pipeline.roads.layers import chip_layer, host_readout
from pipeline.settings import Settings
from pipeline.training.events import EventRecipe, network_of


def deployed_on_events(
    settings: Settings, weights: dict, confidence: float, provenance: dict
) -> NetworkSpec:
    """Describe the spiking network of a run; see :func:`spec_of_events`.

    Parameters
    ----------
    settings : Settings
        With ``input.kind = "events"``.
    weights, provenance
        As in :func:`spec_of_events`.
    confidence : float
        Confidence for an early decision.
    """
    recipe, presentation = EventRecipe.of(settings), settings.presented(confidence)
    return spec_of_events(recipe, weights, presentation, provenance)


def spec_of_events(
    recipe: EventRecipe, weights: dict, presentation: Presentation, provenance: dict
) -> NetworkSpec:
    """Describe the spiking network with the given weights.

    NengoLoihi discretises it to the integers used in training; a step of the chip is a step of the
    recipe, independently of the recording time that it represents.

    Parameters
    ----------
    recipe : EventRecipe
    weights : dict
        Weights of a :class:`pipeline.training.events.TrainedOnEvents`.
    presentation : Presentation
    provenance : dict
        Stored in the bundle.

    Returns
    -------
    NetworkSpec
    """
    architecture = parse(recipe.architecture)
    network = network_of(recipe, weights)
    integers, layers = network.integers(), []
    *hidden, readout = architecture.folded
    for folded in hidden:
        chip = on_loihi(integers[folded.name], LOIHI.dt)
        kernel = folded.layer.deployed_weights(chip.weights)
        layers.append(chip_layer(chip, kernel, folded.geometry()))
    bias = np.zeros(readout.shape)
    layers.append(host_readout(weights["output.kernel"].T, bias, readout.geometry()))
    return NetworkSpec(
        architecture=str(architecture),
        input_shape=architecture.input_shape,
        stimulus=EventFrames(recipe.step_ms / 1000, recipe.rest),
        layers=tuple(layers),
        presentation=presentation,
        provenance=provenance,
        estimator=Estimator.from_arrays(weights, architecture.outputs),
    )
