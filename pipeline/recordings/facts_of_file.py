"""Describe the file of one recording in a line: its events, times and sensor."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import open_regular, reporting_os_errors
from deploy.terminal import escape_control
from pipeline.recordings.events import TICK_NS
from pipeline.recordings.facts import format_event_count
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
from pipeline.recordings.sensor import N_TAXELS, format_size


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
    has_clock_times = recording.time[-1] * UNITS[unit] > MAX_DURATION_S
    rows, columns = recording.size or (recording.y.max() + 1, recording.x.max() + 1)
    facts = {"sensor": {"rows": int(rows), "columns": int(columns)}, "time_unit": unit}
    # Only their number matters here: the coordinates of a camera may exceed what events can have.
    numbered = replace(recording, x=np.zeros_like(recording.x), y=np.zeros_like(recording.y))
    return numbered.to_events(1, to_ns(recording.time, unit, has_clock_times)), facts


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
    counts = format_event_count(facts, polarities)
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
