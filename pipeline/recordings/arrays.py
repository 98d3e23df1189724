"""Recordings from and to events in memory, by the same rules as files."""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import replace
from pathlib import Path

from deploy.errors import SeveralErrors, UserError
from deploy.tables import plural
from pipeline.recordings.events import Recordings
from pipeline.recordings.library import import_recordings
from pipeline.recordings.sensor import ReadingOptions
from pipeline.recordings.writing import write_recordings

# Name of recordings that were made of arrays.
NAME = "arrays"

# Class of recordings without labels.
UNLABELLED = "unlabelled"


@contextlib.contextmanager
def errors_naming(name: str, path: Path):
    """Errors in the block name what the user gave instead of a temporary file."""
    try:
        yield
    except SeveralErrors as error:
        raise SeveralErrors([line.replace(str(path), name) for line in error.lines]) from error
    except UserError as error:
        raise UserError(str(error).replace(str(path), name)) from error


def read_recordings(path, time_unit: str = "") -> Recordings:
    """See :meth:`pipeline.recordings.events.Recordings.read`."""
    return import_recordings(Path(path), reading=ReadingOptions(time_unit=time_unit))


def recordings_from_arrays(events, labels=None, **more) -> Recordings:
    """See :meth:`pipeline.recordings.events.Recordings.from_arrays`."""
    events = list(events)
    labels = [UNLABELLED] * len(events) if labels is None else list(labels)
    if len(events) != len(labels):
        raise UserError(
            f"{NAME}: {plural(len(events), 'recording')} and {plural(len(labels), 'label')}; give "
            "a label for each"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{NAME}.zip"
        with errors_naming(NAME, path):
            write_recordings(path, zip(events, labels, strict=True), **more)
            recordings = import_recordings(path)
    return replace(recordings, source=replace(recordings.source, name=NAME))


def write_zip(recordings: Recordings, path) -> Path:
    """See :meth:`pipeline.recordings.events.Recordings.write`."""
    taxels = recordings.taxels
    names = recordings.sensor.classes

    def events_of(index):
        events = recordings[index]
        return {
            "x": taxels.column[events.taxel],
            "y": taxels.row[events.taxel],
            "t": events.time_ns,
            "p": events.polarity,
        }

    labels = [names[label] for label in recordings.labels]
    known_writers = bool((recordings.writers >= 0).all())
    return write_recordings(
        path,
        zip(map(events_of, range(len(recordings))), labels, strict=True),
        classes=list(names),
        time_unit="ns",
        writers=recordings.writers.tolist() if known_writers else None,
        simulated=recordings.source.simulated,
        parts=recordings.parts if recordings.is_split else None,
    )
