"""The paper's Table 1 for any recordings."""

from __future__ import annotations

import math

import numpy as np

MEASURES = ("on", "off", "x_mean", "y_mean", "x_range", "y_range")
"""Rows of the table, in the paper's order."""


def per_sample(recordings) -> dict:
    """The measures of every recording.

    Every column of the published array counts as an event, as in the paper; ``on_physical`` and
    ``off_physical`` count each burst once.  X and Y are 1-based.

    Returns
    -------
    dict of str to ndarray of float, shape (n_samples,)
        The means and ranges of a recording without events are NaN.
    """
    events, n = recordings.events, len(recordings)
    sample = recordings.sample_of_event
    columns = events.columns.astype(float)
    is_on = events.polarity > 0
    total = np.bincount(sample, columns, n)
    measures = {
        "on": np.bincount(sample, columns * is_on, n),
        "off": np.bincount(sample, columns * ~is_on, n),
        "on_physical": np.bincount(sample, is_on, n),
        "off_physical": np.bincount(sample, ~is_on, n),
    }
    empty = total == 0
    for axis, where in (("x", recordings.taxels.x), ("y", recordings.taxels.y)):
        place = where[events.taxel] + 1.0
        low, high = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(low, sample, place)
        np.maximum.at(high, sample, place)
        with np.errstate(invalid="ignore"):
            measures[axis + "_mean"] = np.bincount(sample, columns * place, n) / np.where(
                empty, np.nan, total
            )
            measures[axis + "_range"] = np.where(empty, np.nan, high - low)
    return measures


def table(recordings) -> dict:
    """Mean and standard deviation of each measure over the recordings of each digit.

    Returns
    -------
    dict of int to dict
        For each digit that occurs: a pair (mean, SD) for each measure, and ``samples``.
    """
    measures = per_sample(recordings)
    result = {}
    for digit in np.unique(recordings.labels):
        mine = recordings.labels == digit
        result[int(digit)] = {name: _mean_sd(values[mine]) for name, values in measures.items()}
        result[int(digit)]["samples"] = int(mine.sum())
    return result


def _mean_sd(values):
    """Mean and sample SD of what is not NaN; NaN where there is too little."""
    values = values[~np.isnan(values)]
    mean = float(values.mean()) if len(values) else math.nan
    return mean, float(values.std(ddof=1)) if len(values) > 1 else math.nan


_PAPER = {
    "on": [
        (1738.13, 1365.54), (362.95, 204.57), (878.78, 405.13), (1053.44, 673.43),
        (823.63, 458.51), (1113.90, 701.60), (739.37, 521.99), (809.30, 631.05),
        (1399.14, 898.56), (773.13, 483.25),
    ],
    "off": [
        (1139.66, 803.17), (245.77, 124.34), (623.88, 294.57), (810.22, 1403.10),
        (597.57, 355.25), (819.76, 677.03), (548.48, 410.00), (538.98, 361.39),
        (1000.42, 755.04), (546.29, 295.75),
    ],
    "x_mean": [
        (5.57, 0.51), (6.17, 0.70), (6.57, 0.70), (5.88, 0.59), (6.05, 0.57),
        (5.41, 0.53), (6.04, 0.45), (5.32, 0.57), (5.78, 0.57), (5.24, 0.54),
    ],
    "y_mean": [
        (6.84, 0.75), (6.21, 1.16), (7.02, 0.82), (7.12, 0.88), (6.93, 0.93),
        (6.57, 0.79), (6.68, 0.76), (6.92, 0.89), (6.76, 0.90), (6.58, 0.91),
    ],
    "x_range": [
        (8.92, 0.53), (8.72, 0.70), (8.80, 0.64), (8.94, 0.53), (8.95, 0.52),
        (8.91, 0.58), (8.94, 0.52), (8.96, 0.49), (8.94, 0.52), (8.91, 0.53),
    ],
    "y_range": [
        (8.48, 1.04), (7.04, 1.36), (8.21, 1.04), (8.20, 1.08), (8.44, 0.87),
        (8.38, 1.00), (8.33, 1.02), (7.97, 1.18), (8.19, 1.17), (8.17, 1.13),
    ],
    "samples": [697, 690, 699, 690, 690, 693, 698, 704, 697, 695],
}  # fmt: skip

PAPER = {digit: {name: row[digit] for name, row in _PAPER.items()} for digit in range(10)}
"""Table 1 of the paper, in the form of :func:`table`."""
