"""Facts about recordings: about a whole source and about one file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import open_regular
from deploy.terminal import printable
from pipeline.data.archive import read_file
from pipeline.data.eventarrays import EventRecording
from pipeline.data.events import DIGITS, Recordings, Sensor, expand_bursts
from pipeline.data.matfile import BadRecording, read_limited
from pipeline.data.timeunits import UNIT_NAMES, of_a_clock, recognised, to_ns


def facts_of(recordings: Recordings) -> dict:
    """The source, the sensor and the number of recordings of each class, as plain values.

    If the classes are the digits, these are also in a separate list.
    """
    source, sensor = recordings.source, recordings.sensor
    counts = np.bincount(recordings.labels, minlength=len(sensor.classes)).tolist()
    facts = {
        "source": source.name,
        "sha256": source.sha256,
        "simulated": source.simulated,
        "written": source.written,
        "samples": len(recordings),
        "files_left_out": len(source.left_out),
        "samples_per_class": dict(zip(sensor.classes, counts, strict=True)),
        "sensor": {
            "rows": sensor.rows,
            "columns": sensor.columns,
            "taxels": len(recordings.taxels),
            "polarities": sensor.polarities,
            "duration_s": sensor.duration_s,
        },
    }
    return {**facts, "samples_per_digit": counts} if sensor.classes == DIGITS else facts


def facts_with_events(recordings: Recordings) -> dict:
    """:func:`facts_of` with the numbers of physical events and of the files' columns."""
    return {
        **facts_of(recordings),
        "events": len(recordings.events),
        "columns": int(recordings.events.columns.sum(dtype=np.int64)),
    }


def reading_text(recordings: Recordings) -> str:
    """Summary of a source in one line: numbers, sizes, durations and the unit of times."""
    events, offsets, sensor = recordings.events, recordings.offsets, recordings.sensor
    some = np.diff(offsets) > 0
    first, last = (
        events.time_ns[offsets[:-1][some]],
        events.time_ns[np.maximum(offsets[1:][some] - 1, 0)],
    )
    lasts = (last - first) * 1e-9 if some.any() else np.zeros(1)
    parts = [
        f"{len(recordings)} recordings",
        size_text(sensor),
        f"{len(sensor.classes)} class{'es' * (len(sensor.classes) != 1)}",
        f"{lasts.min():.2g} to {lasts.max():.2g} s",
    ]
    if recordings.source.time_unit:
        parts.append(f"times read as {UNIT_NAMES[recordings.source.time_unit]}")
    return ", ".join(parts)


def size_text(sensor: Sensor) -> str:
    """Rows and columns in words."""
    rows, columns = sensor.rows, sensor.columns
    return f"{rows} row{'s'[: rows != 1]} x {columns} column{'s'[: columns != 1]}"


def recordings_text(facts: dict, recordings: Recordings) -> str:
    """:func:`facts_with_events` of recordings in a few lines."""
    sensor = recordings.sensor
    kind = "simulated recordings" if facts["simulated"] else "recordings"
    if facts["written"]:
        kind = "recordings, written by hand on the simulated skin,"
    of_each = facts.get("samples_per_digit") or _of_classes(facts["samples_per_class"])
    of_what = "digit" if "samples_per_digit" in facts else "class"
    source = printable(facts["source"])
    text = f"{facts['samples']} {kind} in {source}; of each {of_what}: {of_each}\n"
    if facts["columns"] == facts["events"]:
        text += f"{facts['events']} events"
    else:
        text += f"{facts['events']} physical events in {facts['columns']} columns"
    if sensor != Sensor():
        text += f"\n{reading_text(recordings)}"
    return text


MOST_NAMED = 12
"""Maximum number of classes whose recordings are counted separately in a line."""


def _of_classes(counts):
    """Number of recordings of each class; the range if there are many classes."""
    if len(counts) > MOST_NAMED:
        return f"{min(counts.values())} to {max(counts.values())} (stmnist data stats)"
    return ", ".join(f"{printable(name)} {count}" for name, count in counts.items())


def facts_of_file(path: Path, time_unit: str = "") -> dict:
    """Counts and times of one recording: columns of the file, and physical events.

    Parameters
    ----------
    path : Path
    time_unit : str
        Unit of times in a file of events; empty to infer it from the times.

    Raises
    ------
    UserError
        The file cannot be read, or is not a recording.
    """
    try:
        with open_regular(path) as opened:
            recording = read_file(path.name, read_limited(opened))
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror}); check the path") from error
    except BadRecording as error:
        raise UserError(
            f"{path}: {error}; expected a recording as ST-MNIST has them, or a file of events "
            "x, y, t, p"
        ) from error
    events, found = recording.events, {}
    if isinstance(recording, EventRecording):
        unit = time_unit or recording.unit or recognised([recording.time])
        if not unit:
            raise UserError(f"{path}: no unit fits its times; give --time-unit")
        time_ns = to_ns(recording.time, unit, of_a_clock([recording.time], unit))
        events = events(int(recording.y.max()) + 1, time_ns)
        # Not those of the events, whose numbers end at the taxels of the largest input.
        taxels = len(np.unique(recording.x << 16 | recording.y))
        rows, columns = recording.size or (recording.y.max() + 1, recording.x.max() + 1)
        found = {"sensor": {"rows": int(rows), "columns": int(columns)}, "time_unit": unit}
    else:
        taxels = len(np.unique(events.taxel))
    times, _, _ = expand_bursts(events)
    facts = {
        "simulated": recording.simulated,
        "columns": len(times),
        "events": len(events),
        "on": int((events.polarity == 1).sum()),
        "off": int((events.polarity == -1).sum()),
        "t_first_s": float(times[0] * 1e-9),
        "t_last_s": float(times[-1] * 1e-9),
        "taxels": taxels,
        **found,
    }
    if getattr(recording, "written", None) is None:
        return facts
    return {
        **facts,
        "source": "written",
        "time": recording.written.time,
        "writer": recording.writer,
        "handedness": recording.written.handedness or None,
    }


def file_text(name: str, facts: dict) -> str:
    """:func:`facts_of_file` in a line."""
    kind = " (simulated)" if facts["simulated"] else ""
    if facts.get("source") == "written":
        kind = f" (written by hand on the simulated skin, {printable(facts['time'])})"
    if "time_unit" in facts:
        sensor = facts["sensor"]
        return (
            f"{printable(name)}{kind}: {facts['events']} events ({facts['on']} ON, "
            f"{facts['off']} OFF), {sensor['rows']} rows x {sensor['columns']} columns, "
            f"{facts['t_first_s']:.4f} s to {facts['t_last_s']:.4f} s, times read as "
            f"{UNIT_NAMES[facts['time_unit']]}"
        )
    return (
        f"{printable(name)}{kind}: {facts['columns']} columns, {facts['events']} physical events "
        f"({facts['on']} ON, {facts['off']} OFF) of {facts['taxels']} taxels, "
        f"{facts['t_first_s']:.4f} s to {facts['t_last_s']:.4f} s"
    )
