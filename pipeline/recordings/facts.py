"""Describe recordings in a few lines: their numbers, classes, sensor and events."""

import numpy as np

from deploy.tables import list_names
from deploy.terminal import escape_control
from pipeline.recordings.recordings import Recordings, describe_recordings, list_facts
from pipeline.recordings.sensor import Sensor


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
    text += format_event_count(facts)
    if len(facts["samples_per_class"]) == 1:
        text += "\nA network needs recordings of at least two classes."
    if sensor != Sensor():
        text += f"\n{describe_recordings(recordings)}"
    return text


def format_event_count(facts: dict, polarities: str = "") -> str:
    """The number of physical events, and that of the file's columns if it is another one."""
    if facts["columns"] == facts["events"]:
        return f"{facts['events']} events{polarities}"
    return f"{facts['events']} physical events{polarities} in {facts['columns']} columns"
