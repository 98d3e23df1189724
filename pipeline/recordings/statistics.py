"""Statistics of recordings by class, with the measures of the paper's Table 1."""

import math

import numpy as np

from deploy.tables import align_in_blocks, shorten_apart
from deploy.terminal import escape_control
from pipeline.recordings.activity import (
    format_activity,
    format_polarity_order,
    make_activity_json,
    measure_polarity_order,
)
from pipeline.recordings.recordings import describe_recordings, list_facts
from pipeline.recordings.sensor import is_st_mnist_sensor

LABELS = {
    "on": "ON columns (-1)",
    "off": "OFF columns (1)",
    "on_physical": "ON events",
    "off_physical": "OFF events",
    "x_mean": "X mean",
    "y_mean": "Y mean",
    "x_range": "X range",
    "y_range": "Y range",
}

# The table of recordings other than digits, whose positions are not the paper's X and Y.
OWN_LABELS = {
    name: label.replace("X", "row").replace("Y", "column")
    for name, label in LABELS.items()
    if name not in ("on", "off")
}

# Measures of places, which the paper counts from 1.
PLACES = ("x_mean", "y_mean")

# Names of the measures in JSON, where X is the row and Y the column.
JSON_NAMES = {
    "x_mean": "row_mean",
    "y_mean": "column_mean",
    "x_range": "row_range",
    "y_range": "column_range",
}

# Characters of a class's name above its column.
MAX_HEAD_CHARACTERS = 20


def measure_recordings(recordings) -> dict:
    """The measures of every recording.

    Every column of the published array counts as an event, as in the paper; ``on_physical`` and
    ``off_physical`` count each burst once.  X and Y are 1-based.

    Returns
    -------
    dict of str to ndarray of float, shape (n_samples,)
        The means and ranges of a recording without events are NaN.
    """
    events = recordings.events
    n = len(recordings)
    sample = recordings.sample_of_event
    columns = events.columns.astype(float)
    is_on = events.polarity > 0
    total = np.bincount(sample, columns, n)
    measures: dict[str, np.ndarray] = {
        "on": np.bincount(sample, columns * is_on, n),
        "off": np.bincount(sample, columns * ~is_on, n),
        "on_physical": np.bincount(sample, is_on, n),
        "off_physical": np.bincount(sample, ~is_on, n),
    }
    total = np.where(total, total, np.nan)
    for axis, row_or_column in (("x", recordings.taxels.row), ("y", recordings.taxels.column)):
        number = row_or_column[events.taxel] + 1.0
        low = np.full(n, np.inf)
        high = np.full(n, -np.inf)
        np.minimum.at(low, sample, number)
        np.maximum.at(high, sample, number)
        measures[axis + "_mean"] = np.bincount(sample, columns * number, n) / total
        measures[axis + "_range"] = np.where(np.isnan(total), np.nan, high - low)
    return measures


def measure_classes(recordings) -> dict:
    """Mean and standard deviation of each measure over the recordings of each digit.

    Returns
    -------
    dict of int to dict
        For each digit that occurs: a pair (mean, SD) for each measure, and ``samples``.
    """
    measures = measure_recordings(recordings)
    result = {}
    for digit in np.unique(recordings.labels):
        of_digit = recordings.labels == digit
        result[int(digit)] = {
            name: _compute_mean_sd(values[of_digit]) for name, values in measures.items()
        }
        result[int(digit)]["samples"] = int(of_digit.sum())
    return result


def _compute_mean_sd(values):
    """Mean and sample SD without NaN; NaN if there are too few values."""
    values = values[~np.isnan(values)]
    mean = float(values.mean()) if len(values) else math.nan
    return mean, float(values.std(ddof=1)) if len(values) > 1 else math.nan


def make_statistics_json(recordings) -> dict:
    """The table by class, the order of the polarities and the activity of the taxels.

    Rows and columns count from 0.
    """
    names = recordings.sensor.classes
    facts = list_facts(recordings)
    return {
        "simulated": recordings.source.simulated,
        "samples": len(recordings),
        "sensor": facts["sensor"],
        "time_unit": recordings.source.time_unit or None,
        "classes": {
            names[label]: _make_plain(row) for label, row in measure_classes(recordings).items()
        },
        "polarity_order": measure_polarity_order(recordings),
        "taxels": make_activity_json(recordings),
    }


def format_statistics(recordings) -> str:
    """The source, the table, the order of the polarities and the activity of the taxels."""
    return "\n".join(
        [
            f"{escape_control(recordings.source.name)}: {describe_recordings(recordings)}",
            format_table1(recordings),
            format_polarity_order(measure_polarity_order(recordings)),
            format_activity(recordings),
        ]
    )


def format_table1(recordings) -> str:
    """The table as text."""
    ours = measure_classes(recordings)
    name = escape_control(recordings.source.name)
    if recordings.source.simulated and "simulated" not in name:
        name += " (simulated)"
    sensor = recordings.sensor
    written = is_st_mnist_sensor(sensor.rows, sensor.columns, sensor.classes)
    rows = [["", *shorten_apart([sensor.classes[digit] for digit in ours], MAX_HEAD_CHARACTERS)]]
    is_paper = written and bool((recordings.events.columns > 1).any())
    for measure, label in (LABELS if is_paper else OWN_LABELS).items():
        form = ("{:.2f} ({:.2f})" if measure[0] in "xy" else "{:.0f} ({:.0f})").format
        values = (row[measure] for row in ours.values())
        if not is_paper:
            values = (_count_from_0(measure, value) for value in values)
        rows.append([label, *(form(*value) for value in values)])
    rows.append(["samples", *(str(row["samples"]) for row in ours.values())])
    places = "X and Y from 1, as in the paper" if is_paper else "rows and columns from 0"
    title = f"{name}, {len(recordings)} samples: mean (SD); {places}"
    return "\n".join([title, *align_in_blocks(rows)])


def _count_from_0(measure, value):
    """A mean and its deviation, of places as the user's x and y count them."""
    if measure not in PLACES:
        return value
    mean, deviation = value
    return mean - 1, deviation


def _make_plain(row):
    return {
        JSON_NAMES.get(name, name): _replace_nan(_count_from_0(name, value))
        for name, value in row.items()
    }


def _replace_nan(value):
    """A mean and its deviation for JSON, which has no NaN; other values as they are."""
    if not isinstance(value, tuple):
        return value
    return [None if math.isnan(number) else number for number in value]
