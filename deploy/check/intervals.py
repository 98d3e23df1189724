"""Intervals and paired tests for accuracies."""

from __future__ import annotations

import numpy as np
from scipy import stats


def wilson_interval(correct: int, n: int, confidence: float = 0.95):
    """Confidence interval of a proportion (Wilson 1927).

    Parameters
    ----------
    correct, n : int
        Successes and trials, ``n`` at least 1.
    confidence : float

    Returns
    -------
    low, high : float
        In [0, 1].
    """
    interval = stats.binomtest(correct, n).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def mcnemar(correct_a, correct_b) -> float:
    """Exact two-sided McNemar test of two classifiers on the same samples.

    Parameters
    ----------
    correct_a, correct_b : array_like of bool, shape (n,)
        Whether each classifier was right on each sample.

    Returns
    -------
    float
        Probability of a difference at least this large if both were equally good; 1 if they are
        right on the same samples.
    """
    correct_a, correct_b = np.asarray(correct_a, bool), np.asarray(correct_b, bool)
    only_a = int(np.sum(correct_a & ~correct_b))
    only_b = int(np.sum(correct_b & ~correct_a))
    if only_a + only_b == 0:
        return 1.0
    return float(stats.binomtest(only_a, only_a + only_b).pvalue)
