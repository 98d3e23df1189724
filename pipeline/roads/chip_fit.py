"""A check, before training, that the chip can hold a network of an architecture."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from deploy.network.spec import NetworkSpec, Neurons, Presentation
from deploy.network.stimulus import EventFrames, ImageSpikes
from models.architecture import parse
from models.chain import deployed, links_of
from pipeline.settings import Deployment, Settings


def remedy(resource: str, is_conv: bool, on_events: bool) -> str:
    """How a layer can need less of a resource.

    Parameters
    ----------
    resource : str
        One of :data:`deploy.preflight.resources.LIMITS`.
    is_conv : bool
        Whether the layer is a convolution, not dense.
    on_events : bool
        Whether the network's input is events, which no averaging may pass.
    """
    averaging = "" if on_events else ", or an averaging such as 4a,"
    fewer_inputs = (
        f"let the layer have fewer inputs: a convolution with a stride{averaging} before it"
    )
    size = "filters" if is_conv else "neurons"
    outgoing = f"choose fewer {size}, or fewer neurons in the layer after it"
    return {
        "compartments": f"choose fewer {size}",
        "input axons": fewer_inputs,
        "output axons": outgoing,
        "AxonCfg registers": outgoing,
        "synapse words": "choose fewer filters, or a smaller kernel"
        if is_conv
        else f"choose fewer neurons, or {fewer_inputs}",
    }[resource]


def chip_problems(settings: Settings) -> list:
    """Reasons why the network that the settings describe does not fit the cores of the chip.

    NengoLoihi's builder makes the blocks of an untrained network of the same architecture; the
    resources that it needs do not depend on the values of the weights.

    Parameters
    ----------
    settings : Settings

    Returns
    -------
    list of str
        One line for each layer and limit, with the excess and a remedy; empty if the network fits,
        and for a network from a NIR graph, which is checked when it is read.
    """
    default = Settings()
    section = "events" if settings.on_events else "cnn"
    text, usual = (getattr(s, section).architecture for s in (settings, default))
    if settings.nir.file or (text, settings.deployment) == (usual, default.deployment):
        return []
    return list(_problems(text, settings.on_events, settings.deployment))


@functools.lru_cache(maxsize=8)
def _problems(text, on_events, deployment):
    from deploy.preflight.plan import excesses  # imports NengoLoihi, which takes seconds

    convolutions = {n for n, layer in parse(text).spiking.items() if layer.kind == "conv"}
    return tuple(
        f"{text}: layer {excess.layer} needs {excess.used} {excess.resource} on {excess.cores} of "
        f"its {excess.of_cores} core{'' if excess.of_cores == 1 else 's'}, a core has "
        f"{excess.limit}; {remedy(excess.resource, excess.layer in convolutions, on_events)}"
        for excess in excesses(untrained(text, on_events, deployment))
    )


def untrained(text: str, on_events: bool, deployment: Deployment) -> NetworkSpec:
    """A network with random weights.

    Parameters
    ----------
    text : str
        Its architecture.
    on_events : bool
        Whether its input is events, not images.
    deployment : pipeline.settings.Deployment
    """
    rng, links = np.random.default_rng(0), links_of(parse(text))
    on_host = on_events or deployment.readout == "host"
    chain = [
        replace(
            link,
            weights=rng.uniform(0.5, 1.0, link.weights.shape),
            neuron=None if on_host and link is links[-1] else Neurons(0.01),
            tau_syn=deployment.synapse or None,
        )
        for link in links
    ]
    return deployed(chain, EventFrames() if on_events else ImageSpikes(), Presentation())
