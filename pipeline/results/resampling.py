"""Accuracies over several splits of the same samples: mean, spread, intervals, paired differences.

The splits share most of their training samples, so that their accuracies are not independent and
the usual t interval is too narrow.  Nadeau and Bengio (2003, "Inference for the generalization
error", Section 3.3) widen the variance of the mean from s^2/J to (1/J + n_test/n_train) s^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy


@dataclass(frozen=True)
class Estimate:
    """A mean over splits.

    Attributes
    ----------
    mean : float
    sd : float or None
        Standard deviation over the splits (n - 1); None for a single split.
    interval : tuple of float or None
        95 % interval of the mean for overlapping splits; None for a single split.
    p_value : float or None
        Two-sided, of the mean being zero; None for a single split.
    """

    mean: float
    sd: float | None
    interval: tuple | None
    p_value: float | None

    def to_json(self) -> dict:
        """``mean`` and ``ci95``, a list of two, or None for a single split."""
        return {"mean": self.mean, "ci95": list(self.interval) if self.interval else None}


def estimate(values, n_train: float, n_test: float) -> Estimate:
    """Mean over splits, with the corrected resampled t statistic.

    Parameters
    ----------
    values : array_like, shape (n_splits,)
        An accuracy, or a difference of two models' accuracies, of each split.
    n_train, n_test : float
        Samples of each split, or their mean where splits differ.

    Returns
    -------
    Estimate

    Raises
    ------
    ValueError
        There are no values.
    """
    values = np.asarray(values, float)
    n = len(values)
    if n == 0:
        raise ValueError("no values")
    mean = float(values.mean())
    if n == 1:
        return Estimate(mean, None, None, None)
    sd = float(values.std(ddof=1))
    error = sd * np.sqrt(1 / n + n_test / n_train)
    reach = float(scipy.stats.t.ppf(0.975, n - 1) * error)
    if error > 0:
        p_value = float(2 * scipy.stats.t.sf(abs(mean) / error, n - 1))
    else:
        p_value = 1.0 if mean == 0 else 0.0
    return Estimate(mean, sd, (mean - reach, mean + reach), p_value)
