"""Check results of the stages before the bundle: the classifier of event counts, the CNN,
rate-based LIF, NengoDL's spiking LIF, and the network trained on events."""

from __future__ import annotations

import importlib.metadata
import time
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.results import result_of
from deploy.check.run import records_of
from deploy.network.responses import Responses, read_output
from pipeline.roads.nir_answers import NUMPY, graph_responses
from pipeline.settings import Settings

NETWORKS = {
    "counts": ("Event counts", "logistic regression on event counts, the simplest classifier"),
    "cnn": ("CNN", "the convolutional network, no spikes"),
    "rate-lif": ("Rate LIF", "LIF neurons with firing rates instead of spikes"),
    "spiking-lif": ("Spiking LIF, NengoDL", "the same weights with spiking neurons"),
    "trained": (
        "Trained on events",
        "the spiking network as trained, with each sample from rest",
    ),
    "nir": ("NIR", "the graph as written, in floating point, each sample from rest"),
}
"""Title and note of each network before the bundle; later stages are targets."""

REFERENCES = {
    "image": ("counts", "cnn", "rate-lif", "spiking-lif"),
    "events": ("counts", "trained"),
    "nir": ("counts", "nir"),
}
"""The reference stages by `Settings.network`."""

LADDER_ONLY = ("counts",)
"""Reference stages with an artifact of their own, which only the ladder needs."""


def compared_with(stages) -> str:
    """The reference stage that the stages after it are compared with: the first that is trained as
    a network.

    Parameters
    ----------
    stages : sequence of str
        Stages in the order of the ladder.
    """
    return next(stage for stage in stages if stage != "counts")


def reference_result(
    stage: str, settings: Settings, network: dict | Path, bundle: Bundle, advance=None
) -> dict:
    """Make the check result of a network that is not a target, on the samples of a bundle.

    Parameters
    ----------
    stage : str
        One of `REFERENCES`.
    settings : Settings
    network : dict or Path
        Weights: the CNN's for ``"cnn"``, otherwise those from which the bundle was made; for
        ``"nir"`` the folder of the graph; for ``"counts"`` the ``scores`` of samples by ``ids``.
    bundle : Bundle
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    dict
        See :func:`deploy.check.results.result_of`.
    """
    begun = time.perf_counter()
    versions = training_versions()
    if stage == "counts":
        scores = dict(zip(network["ids"].tolist(), network["scores"], strict=True))
        logits = np.stack([scores[name] for name in bundle.checks.ids])[:, None]
        responses, versions = responses_of(logits, settings.presentation), BASELINE
    elif stage == "nir":
        responses = graph_responses(network, settings, bundle, advance)
        versions = NUMPY
    elif stage == "trained":
        responses = _on_events(settings, network, bundle, advance)
    else:
        logits = _logits(stage, settings, network, bundle.checks.inputs, advance)
        responses = responses_of(logits, settings.presentation)
    seconds = time.perf_counter() - begun
    samples = records_of(bundle.checks, responses)
    return result_of(bundle, stage, settings.seed, samples, seconds, {"versions": versions})


def responses_of(logits: np.ndarray, presentation) -> Responses:
    """Compute scores and decisions from logits.

    Parameters
    ----------
    logits : ndarray, shape (n_samples, steps, classes)
        Logits at each step; one step for a network without time.
    presentation : pipeline.settings.PresentationSettings
        In networks with time, the score at a step is the mean from ``readout_start`` to it.
    """
    start = presentation.readout_start if logits.shape[1] > 1 else 0
    window = logits[:, start:]
    scores = np.cumsum(window, axis=1) / np.arange(1, window.shape[1] + 1)[:, None]
    decisions = np.full(logits.shape[:2], -1)
    decisions[:, start:] = np.argmax(scores, axis=2)
    return Responses(scores[:, -1], decisions, {}, {})


BASELINE = {"scikit_learn": importlib.metadata.version("scikit-learn")}
"""Version of the package that the classifier of event counts needs."""


def training_versions() -> dict:
    """Versions of the packages that only these networks need."""
    names = ("tensorflow", "nengo-dl")
    return {name.replace("-", "_"): importlib.metadata.version(name) for name in names}


def event_rates(settings, weights, bundle) -> dict:
    """Firing rates of the network trained on events, each sample from rest.

    Parameters
    ----------
    settings : Settings
    weights : dict
    bundle : Bundle
        Its samples are answered.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        In spikes per second of the recording.
    """
    from pipeline.training.events import TrainedOnEvents

    frames = bundle.checks.inputs.astype(np.uint8)
    spikes = TrainedOnEvents.of(settings, weights).answers(frames).spikes
    seconds = frames.shape[1] * bundle.spec.stimulus.step_seconds
    return {name: counts / seconds for name, counts in spikes.items()}


def _on_events(settings, weights, bundle, advance):
    """Responses of the network trained on events, each sample from rest, delayed as on the chip."""
    from pipeline.training.events import TrainedOnEvents, arriving

    network, frames = TrainedOnEvents.of(settings, weights), bundle.checks.inputs.astype(np.uint8)
    found = network.answers(frames, advance)
    spikes = {"input": frames.reshape(*frames.shape[:2], -1).sum(1, dtype=np.int64), **found.spikes}
    output = np.diff(arriving(found.outputs, network.recipe).astype(float), axis=1, prepend=0)
    return read_output(bundle.spec, output, spikes)


def _logits(stage, settings, weights, images, advance):
    """Logits at each step, shape (n_samples, steps, classes)."""
    # Both import TensorFlow, which takes ten seconds and is not needed for a finished stage.
    if stage == "spiking-lif":
        from pipeline.training import nengodl

        return nengodl.run(settings, weights, images, settings.steps, advance=advance)
    from pipeline.training.networks import TrainedCNN, TrainedRates

    network = TrainedCNN if stage == "cnn" else TrainedRates
    logits = network(settings, weights).logits(images)[:, None]
    if advance is not None:
        advance(len(images))
    return logits
