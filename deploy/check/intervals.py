"""Confidence intervals and tests for accuracies."""

from __future__ import annotations

import numpy as np


def compute_wilson_interval(correct: int, n: int):
    """95 % confidence interval of a proportion (Wilson 1927).

    Parameters
    ----------
    correct, n : int
        Successes and trials, ``n`` at least 1.

    Returns
    -------
    low, high : float
        In [0, 1].
    """
    from scipy import stats  # slow to import, which --help need not wait for

    interval = stats.binomtest(correct, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def compute_mcnemar_p(correct_a, correct_b) -> float:
    """Exact two-sided McNemar test of two classifiers on the same samples.

    Parameters
    ----------
    correct_a, correct_b : array_like of bool, shape (n,)
        True where the classifier was right.

    Returns
    -------
    float
        Probability of a difference at least this large if both were equally good; 1 if they are
        right on the same samples.
    """
    correct_a = np.asarray(correct_a, bool)
    correct_b = np.asarray(correct_b, bool)
    only_a = int(np.sum(correct_a & ~correct_b))
    only_b = int(np.sum(correct_b & ~correct_a))
    if only_a + only_b == 0:
        return 1.0
    from scipy import stats

    return float(stats.binomtest(only_a, only_a + only_b).pvalue)


def compute_fisher_p(correct_a: int, n_a: int, correct_b: int, n_b: int) -> float:
    """Exact two-sided test of two classifiers on different samples (Fisher 1922).

    Parameters
    ----------
    correct_a, n_a, correct_b, n_b : int
        Numbers of right answers and of samples of each classifier.

    Returns
    -------
    float
        Probability of a table at most as likely if both were equally good.  If the two have some
        samples in common, it is too large: the test is then conservative.
    """
    table = [[correct_a, n_a - correct_a], [correct_b, n_b - correct_b]]
    from scipy import stats

    return float(stats.fisher_exact(table)[1])
