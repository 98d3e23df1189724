"""Statistics of recordings: numbers, sizes, durations, and the values of the paper's Table 1."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import open_regular, reporting_os_errors
from deploy.tables import align_in_blocks, list_names, shorten_apart
from deploy.terminal import escape_control
from pipeline.recordings.activity import (
    format_activity,
    format_polarity_order,
    make_activity_json,
    measure_polarity_order,
)
from pipeline.recordings.events import TICK_NS
from pipeline.recordings.formats import read_file
from pipeline.recordings.formats.recording import (
    MAX_DURATION_S,
    UNIT_NAMES,
    UNITS,
    BadRecording,
    read_limited,
)
from pipeline.recordings.interpretation.binned_counts import choose_rise, make_events
from pipeline.recordings.interpretation.options import AS_FOUND, ReadingOptions
from pipeline.recordings.interpretation.times import infer_unit, to_ns
from pipeline.recordings.recordings import Recordings, describe_recordings, list_facts
from pipeline.recordings.sensor import N_TAXELS, Sensor, format_size, is_st_mnist_sensor


def list_facts_with_events(recordings: Recordings) -> dict:
    """:func:`list_facts` with the numbers of physical events and of the files' columns."""
    return {
        **list_facts(recordings),
        "events": len(recordings.events),
        "columns": int(recordings.events.columns.sum(dtype=np.int64)),
    }


def format_facts(facts: dict, recordings: Recordings) -> str:
    """:func:`list_facts_with_events` of recordings in a few lines."""
    sensor = recordings.sensor
    recordings_name = "simulated recordings" if facts["simulated"] else "recordings"
    if facts["written"]:
        recordings_name = "recordings, written by hand on the simulated sensor,"
    of_each = list_names(
        f"{escape_control(name)} {count}" for name, count in facts["samples_per_class"].items()
    )
    source = escape_control(facts["source"])
    text = f"{facts['samples']} {recordings_name} in {source}; of each class: {of_each}\n"
    text += _format_count(facts)
    if sensor != Sensor():
        text += f"\n{describe_recordings(recordings)}"
    return text


def _format_count(facts, polarities=""):
    if facts["columns"] == facts["events"]:
        return f"{facts['events']} events{polarities}"
    return f"{facts['events']} physical events{polarities} in {facts['columns']} columns"


def list_facts_of_file(path: Path, options: ReadingOptions = AS_FOUND) -> dict:
    """Counts and times of one recording: columns of the file, and physical events.

    Parameters
    ----------
    path : Path
    options : ReadingOptions
        Properties that the user states, such as the unit of times.

    Raises
    ------
    UserError
        The file cannot be read, or is not a recording.
    """
    try:
        with reporting_os_errors(path, "cannot read", "check the path"), open_regular(path) as file:
            recording = read_file(read_limited(file), path.name)
    except BadRecording as error:
        raise UserError(
            f"{path}: {error}; expected a recording as ST-MNIST has them, or a file of events "
            "x, y, t, p"
        ) from error
    if recording.layout == "events":
        events, facts = _read_coordinates(path, recording, options)
    elif recording.layout == "bins":
        events, facts = _read_bins(path, recording, options)
    else:
        events = recording.to_numbered_events()
        facts = {}
    if recording.written:
        facts |= {"source": "written", "writer": recording.writer}
    columns = int(events.columns.sum(dtype=np.int64))
    last_ns = events.time_ns[-1] + TICK_NS * (int(events.columns[-1]) - 1)
    return {
        "simulated": recording.simulated,
        "columns": columns,
        "events": len(recording),
        **facts,
        "on": int((events.polarity == 1).sum()),
        "off": int((events.polarity == -1).sum()),
        "t_first_s": float(events.time_ns[0] * 1e-9),
        "t_last_s": float(last_ns * 1e-9),
        "taxels": len(np.unique(recording.x << 16 | recording.y)),
    }


def _read_coordinates(path, recording, options):
    """The events of a file with coordinates, and facts about its sensor and times."""
    unit = options.time_unit or recording.unit or infer_unit([recording.time])
    if not unit:
        raise UserError(f"{path}: no unit fits its times; give --set data.time_unit=...")
    are_clock_times = recording.time[-1] * UNITS[unit] > MAX_DURATION_S
    rows, columns = recording.size or (recording.y.max() + 1, recording.x.max() + 1)
    facts = {"sensor": {"rows": int(rows), "columns": int(columns)}, "time_unit": unit}
    # Only their number matters here: the coordinates of a camera may exceed what events can have.
    numbered = replace(recording, x=np.zeros_like(recording.x), y=np.zeros_like(recording.y))
    return numbered.to_events(1, to_ns(recording.time, unit, are_clock_times)), facts


def _read_bins(path, recording, options):
    """The events of an array of counts, and facts about its shape."""
    channels, n_bins = recording.bins
    rise = choose_rise(path, channels, recording.n_taxels == N_TAXELS, options)
    facts = {
        "shape": [recording.n_taxels, channels, n_bins],
        "bin_ms": options.bin_ms,
        "rise": rise,
    }
    return make_events(recording, rise, options.bin_ms), facts


def format_facts_of_file(name: str, facts: dict) -> str:
    """:func:`list_facts_of_file` in a line."""
    remark = " (simulated)" if facts["simulated"] else ""
    if facts.get("source") == "written":
        remark = " (written by hand on the simulated sensor)"
    polarities = f" ({facts['on']} ON, {facts['off']} OFF)"
    counts = _format_count(facts, polarities)
    text = f"{escape_control(name)}{remark}: {counts} of {facts['taxels']} taxels"
    if "sensor" in facts:
        text += " in " + format_size(facts["sensor"]["rows"], facts["sensor"]["columns"])
    text += f", {facts['t_first_s']:.4f} s to {facts['t_last_s']:.4f} s"
    if "time_unit" in facts:
        text += f", times read as {UNIT_NAMES[facts['time_unit']]}"
    if "bin_ms" in facts:
        taxels, channels, n_bins = facts["shape"]
        text += (
            f", read from {taxels} taxels x {channels} channels x {n_bins} bins of "
            f"{facts['bin_ms']:g} ms (data.bin)"
        )
        if channels == 2:
            text += f", channel {facts['rise']} as the rise of pressure (data.rise)"
    return text


# The paper's Table 1.


def measure_samples(recordings) -> dict:
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
    measures = measure_samples(recordings)
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
