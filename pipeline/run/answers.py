"""What the networks before the bundle answer: CNN, rate-based LIF and NengoDL's spiking LIF."""

from __future__ import annotations

import importlib.metadata
import time

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.results import result_of
from deploy.check.run import records_of
from deploy.network.responses import Responses
from pipeline.settings import Settings

STAGES = ("cnn", "rate-lif", "spiking-lif")


def reference_result(
    stage: str, settings: Settings, weights: dict, bundle: Bundle, advance=None
) -> dict:
    """A check result of a network that is no target, on the samples of a bundle.

    Parameters
    ----------
    stage : str
        One of `STAGES`.
    settings : Settings
    weights : dict
        The CNN's for ``"cnn"``, the rate-based network's for the others.
    bundle : Bundle
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    dict
        See :func:`deploy.check.results.result_of`.
    """
    begun = time.perf_counter()
    logits = _logits(stage, settings, weights, bundle.checks.inputs, advance)
    seconds = time.perf_counter() - begun
    everything = slice(0, len(bundle.checks))
    samples = records_of(bundle, everything, responses_of(logits, settings.presentation))
    extra = {"versions": training_versions()}
    return result_of(bundle, stage, settings.seed, samples, seconds, extra)


def responses_of(logits: np.ndarray, presentation) -> Responses:
    """Scores and decisions from logits.

    Parameters
    ----------
    logits : ndarray, shape (n_samples, steps, classes)
        At each step; one step for a network without time.
    presentation : pipeline.settings.Presentation
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


def _logits(stage, settings, weights, images, advance):
    """Logits at each step, shape (n_samples, steps, classes)."""
    # Both import TensorFlow: ten seconds that a finished stage can spare.
    if stage == "spiking-lif":
        from pipeline.training import nengodl

        return nengodl.run(settings, weights, images, settings.presentation.steps, advance=advance)
    from pipeline.training.networks import TrainedCNN, TrainedRates

    network = TrainedCNN if stage == "cnn" else TrainedRates
    logits = network(settings, weights).logits(images)[:, None]
    if advance is not None:
        advance(len(images))
    return logits
