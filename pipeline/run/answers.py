"""What the networks before the bundle answer: CNN, rate-based LIF and NengoDL's spiking LIF, or the
network trained on events."""

from __future__ import annotations

import importlib.metadata
import time

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.results import result_of
from deploy.check.run import records_of
from deploy.network.responses import Responses, read_output
from pipeline.settings import Settings

NETWORKS = {
    "cnn": ("CNN", "the convolutional network, no spikes"),
    "rate-lif": ("Rate LIF", "the firing rates of LIF neurons in the place of spikes"),
    "spiking-lif": ("Spiking LIF, NengoDL", "the same weights, neurons that spike"),
    "trained": (
        "Trained on events",
        "the spiking network as it was trained, each sample from rest",
    ),
    "nir": ("NIR", "the graph as written, in floating point, each sample from rest"),
}
"""Title and note of each network before the bundle; those after it are targets."""

REFERENCES = {
    "image": ("cnn", "rate-lif", "spiking-lif"),
    "events": ("trained",),
    "nir": ("nir",),
}
"""Which of them there are, by `Settings.network`."""


def reference_result(
    stage: str, settings: Settings, weights: dict, bundle: Bundle, advance=None
) -> dict:
    """A check result of a network that is no target, on the samples of a bundle.

    Parameters
    ----------
    stage : str
        One of `REFERENCES`.
    settings : Settings
    weights : dict
        The CNN's for ``"cnn"``; otherwise those that the bundle was made from.
    bundle : Bundle
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    dict
        See :func:`deploy.check.results.result_of`.
    """
    begun = time.perf_counter()
    if stage == "trained":
        responses = _on_events(settings, weights, bundle, advance)
    else:
        logits = _logits(stage, settings, weights, bundle.checks.inputs, advance)
        responses = responses_of(logits, settings.presentation)
    seconds = time.perf_counter() - begun
    samples = records_of(bundle.checks, responses)
    extra = {"versions": training_versions()}
    return result_of(bundle, stage, settings.seed, samples, seconds, extra)


def responses_of(logits: np.ndarray, presentation) -> Responses:
    """Scores and decisions from logits.

    Parameters
    ----------
    logits : ndarray, shape (n_samples, steps, classes)
        At each step; one step for a network without time.
    presentation : pipeline.settings.Showing
        Where there is time, the score at a step is the mean from ``readout_start`` up to it.
    """
    start = presentation.readout_start if logits.shape[1] > 1 else 0
    window = logits[:, start:]
    scores = np.cumsum(window, axis=1) / np.arange(1, window.shape[1] + 1)[:, None]
    decisions = np.full(logits.shape[:2], -1)
    decisions[:, start:] = np.argmax(scores, axis=2)
    return Responses(scores[:, -1], decisions, {}, {})


def training_versions() -> dict:
    """Versions of what only these networks need."""
    names = ("tensorflow", "nengo-dl")
    return {name.replace("-", "_"): importlib.metadata.version(name) for name in names}


def _on_events(settings, weights, bundle, advance):
    """Of the trained network, each sample from rest; the outputs when they reach the host."""
    from pipeline.training.events import EventRecipe, TrainedOnEvents, arriving

    recipe, frames = EventRecipe.of(settings), bundle.checks.inputs.astype(np.uint8)
    found = TrainedOnEvents(recipe, weights).answers(frames, advance)
    spikes = {"input": frames.reshape(*frames.shape[:2], -1).sum(1, dtype=np.int64), **found.spikes}
    output = np.diff(arriving(found.outputs, recipe).astype(float), axis=1, prepend=0)
    return read_output(bundle.spec, output, spikes)


def _logits(stage, settings, weights, images, advance):
    """Logits at each step, shape (n_samples, steps, classes)."""
    # Both import TensorFlow: ten seconds that a finished stage can spare.
    if stage == "spiking-lif":
        from pipeline.training import nengodl

        return nengodl.run(settings, weights, images, settings.steps, advance=advance)
    from pipeline.training.networks import TrainedCNN, TrainedRates

    network = TrainedCNN if stage == "cnn" else TrainedRates
    logits = network(settings, weights).logits(images)[:, None]
    if advance is not None:
        advance(len(images))
    return logits
