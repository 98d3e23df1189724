"""When a network decides by itself: a confidence at every step, and a threshold for it.

The output of a network on events is a sum over the steps from a sample's start; trained as logits,
the largest share of their softmax is what the network gives for its answer being right.  It decides
in the first step in which that reaches a threshold, and at the end if it never does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Threshold(NamedTuple):
    """A threshold and what deciding by it did on the samples that it was chosen on.

    Attributes
    ----------
    confidence : float
        From 0 to 1.
    accuracy : float
        Share of right decisions.
    share : float
        Mean share of a sample's own time after which it was decided.
    """

    confidence: float
    accuracy: float
    share: float


def confidence(outputs) -> np.ndarray:
    """Largest share of the softmax.

    Parameters
    ----------
    outputs : ndarray, shape (..., classes)
        Sums of the readout from a sample's start on.

    Returns
    -------
    ndarray, shape (...)
    """
    outputs = np.asarray(outputs, float)
    return 1 / np.exp(outputs - outputs.max(-1, keepdims=True)).sum(-1)


def decide(outputs, threshold: float):
    """Step and class of each sample's decision.

    Parameters
    ----------
    outputs : ndarray, shape (n_samples, steps, classes)
    threshold : float
        Of the confidence.

    Returns
    -------
    steps : ndarray of int, shape (n_samples,)
        From 0; the last one where the confidence never reaches the threshold.
    classes : ndarray of int, shape (n_samples,)
    """
    sure = confidence(outputs) >= threshold
    sure[:, -1] = True
    steps = sure.argmax(1)
    return steps, np.asarray(outputs)[np.arange(len(steps)), steps].argmax(-1)


def share_of_time(steps, last_step) -> np.ndarray:
    """Share of a sample's own time that has passed at its decision, at most 1.

    Parameters
    ----------
    steps, last_step : ndarray of int, shape (n_samples,)
        Of the decision and of the sample's last event, from 0.
    """
    return np.minimum((np.asarray(steps) + 1) / (np.asarray(last_step) + 1), 1)


def choose_threshold(outputs, labels, last_step, loss: float = 0.005) -> Threshold:
    """The threshold that decides earliest without losing much; choose it on validation samples.

    Parameters
    ----------
    outputs : ndarray, shape (n_samples, steps, classes)
    labels, last_step : ndarray of int, shape (n_samples,)
    loss : float
        By how much the accuracy may be below that of the last step.

    Returns
    -------
    Threshold
    """
    labels = np.asarray(labels)
    allowed = np.mean(np.asarray(outputs)[:, -1].argmax(-1) == labels) - loss
    best = None
    for level in 1 - np.geomspace(0.5, 1e-4, 100):
        steps, classes = decide(outputs, level)
        found = Threshold(
            float(level), float(np.mean(classes == labels)),
            float(np.mean(share_of_time(steps, last_step))),
        )  # fmt: skip
        if found.accuracy >= allowed and (best is None or found.share < best.share):
            best = found
    return best or Threshold(1.0, float(allowed + loss), 1.0)
