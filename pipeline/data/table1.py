"""The paper's Table 1 for any recordings."""

from __future__ import annotations

import math

import numpy as np

from deploy.errors import UserError
from deploy.tables import in_blocks
from deploy.terminal import printable
from pipeline.data.events import DIGITS
from pipeline.data.words import is_written, shortened_apart
from pipeline.paper import SAMPLES_PER_DIGIT, TABLE1

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
    for axis, where in (("x", recordings.taxels.row), ("y", recordings.taxels.column)):
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
    """Mean and sample SD without NaN; NaN if there are too few values."""
    values = values[~np.isnan(values)]
    mean = float(values.mean()) if len(values) else math.nan
    return mean, float(values.std(ddof=1)) if len(values) > 1 else math.nan


LABELS = {
    "on": "ON events",
    "off": "OFF events",
    "on_physical": "physical ON",
    "off_physical": "physical OFF",
    "x_mean": "X mean",
    "y_mean": "Y mean",
    "x_range": "X range",
    "y_range": "Y range",
}


OWN_LABELS = {
    name: label.replace("X", "row").replace("Y", "column").replace("physical ", "")
    for name, label in LABELS.items()
    if name not in ("on", "off")
}
"""The table of recordings other than digits, whose positions are not the paper's X and Y."""

LONGEST_HEAD = 20
"""Characters of a class's name above its column."""


def _check(recordings, against_paper):
    if against_paper and recordings.sensor.classes != DIGITS:
        raise UserError("--against-paper: the paper's figures are of the digits; leave it out")


def is_st_mnist(recordings) -> bool:
    """True if recordings can be the paper's: not simulated, with its numbers of each digit."""
    counts = np.bincount(recordings.labels, minlength=10).tolist()
    return not recordings.source.simulated and counts == list(SAMPLES_PER_DIGIT)


def table1_json(recordings, against_paper: bool = False) -> dict:
    """The table as plain values.

    Parameters
    ----------
    recordings : Recordings
    against_paper : bool
        Include the paper's figures and the differences relative to them.
    """
    _check(recordings, against_paper)
    digits = {}
    for digit, row in table(recordings).items():
        name = recordings.sensor.classes[digit]
        digits[name] = _plain(row)
        if against_paper:
            paper = TABLE1[digit]
            digits[name]["paper"] = _plain(paper)
            digits[name]["error"] = _plain(
                {name: _relative(row[name], paper[name]) for name in MEASURES}
            )
    return {
        "simulated": recordings.source.simulated,
        "samples": len(recordings),
        "digits": digits,
    }


def table1_text(recordings, against_paper: bool = False) -> str:
    """The table as text; parameters as in :func:`table1_json`."""
    _check(recordings, against_paper)
    ours = table(recordings)
    name = printable(recordings.source.name)
    if recordings.source.simulated and "simulated" not in name:
        name += " (simulated)"
    sensor = recordings.sensor
    written = is_written(sensor.rows, sensor.columns, sensor.classes)
    rows = [["", *shortened_apart([sensor.classes[digit] for digit in ours], LONGEST_HEAD)]]
    for measure, label in (LABELS if written else OWN_LABELS).items():
        decimals = 2 if measure[0] in "xy" else 0
        rows.append([label, *(_cell(row[measure], decimals) for row in ours.values())])
        if against_paper and measure in MEASURES:
            paper = {digit: TABLE1[digit][measure] for digit in ours}
            rows.append(["  paper", *(_cell(pair, decimals) for pair in paper.values())])
            rows.append(["  error %", *(_error(ours[d][measure], paper[d]) for d in ours)])
    rows.append(["samples", *(str(row["samples"]) for row in ours.values())])
    if against_paper:
        rows.append(["  paper", *(str(TABLE1[digit]["samples"]) for digit in ours)])
    lines = [f"{name}, {len(recordings)} samples: mean (SD)", *in_blocks(rows)]
    if against_paper and not is_st_mnist(recordings):
        what = "simulated" if recordings.source.simulated else "others"
        lines.append(f"The paper's figures are those of ST-MNIST; these recordings are {what}.")
    return "\n".join(lines)


def _plain(row):
    return {
        name: [None if math.isnan(v) else v for v in value] if isinstance(value, tuple) else value
        for name, value in row.items()
    }


def _relative(pair, paper):
    return tuple(value / target - 1 for value, target in zip(pair, paper, strict=True))


def _cell(pair, decimals):
    return f"{pair[0]:.{decimals}f} ({pair[1]:.{decimals}f})"


def _error(pair, paper):
    mean, spread = (np.round(100 * error) + 0.0 for error in _relative(pair, paper))  # no -0
    return f"{mean:+.0f} ({spread:+.0f})"
