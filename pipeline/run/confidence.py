"""At which confidence a network decides before a sample's end: chosen on validation samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.network.responses import first_confident

POINTS = 0.5
"""Of accuracy that deciding early may cost."""

LIMITS = tuple(float(limit) for limit in 1 - np.exp(-np.arange(0.7, 9.05, 0.1)))
"""Confidences to choose from, evenly spaced in the logarithm of what is missing to 1."""


@dataclass(frozen=True)
class EarlyDecision:
    """A confidence and what it gives on the samples that it was chosen on.

    Attributes
    ----------
    confidence : float
    accuracy, accuracy_at_end : float
    share_of_writing : float
        Mean share of the time until the last event after which the samples were decided.
    samples : int
    """

    confidence: float
    accuracy: float
    accuracy_at_end: float
    share_of_writing: float
    samples: int


def choose_confidence(sums, last_step, labels, points: float = POINTS) -> EarlyDecision:
    """The confidence that decides soonest and costs at most some points of accuracy.

    Parameters
    ----------
    sums : ndarray, shape (n_samples, steps, classes)
        Outputs summed up to each step.
    last_step : ndarray of int, shape (n_samples,)
        Step (from 0) of each sample's last event.
    labels : ndarray of int, shape (n_samples,)
    points : float

    Returns
    -------
    EarlyDecision
        The highest confidence if none costs so little.
    """
    decisions, everyone = sums.argmax(-1), np.arange(len(labels))
    at_end = float(np.mean(decisions[:, -1] == labels))
    written = np.asarray(last_step) + 1
    found = []
    for limit in LIMITS:
        steps = first_confident(sums, limit)
        accuracy = float(np.mean(decisions[everyone, steps - 1] == labels))
        share = float(np.minimum(steps / written, 1).mean())
        found.append(EarlyDecision(limit, accuracy, at_end, share, len(labels)))
    cheap = [one for one in found if one.accuracy >= at_end - points / 100 - 1e-9]
    return min(cheap, key=lambda one: one.share_of_writing, default=found[-1])
