"""Recordings from and to events in memory, by the same rules as files."""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from deploy.errors import SeveralErrors, UserError
from deploy.tables import format_count
from deploy.terminal import remark
from pipeline.recordings.cached_recordings import import_recordings
from pipeline.recordings.files.writing import write_recordings
from pipeline.recordings.formats.recording import UNIT_NAMES
from pipeline.recordings.interpretation.options import ReadingOptions
from pipeline.recordings.recordings import Recordings

# Name of the temporary file of recordings that are made of arrays.
NAME = "arrays"

# Longest name that a user may give recordings.
MAX_NAME = 60

# Class of recordings without labels.
UNLABELLED = "unlabelled"

# How messages name the settings of reading: as options of the command line, or alone.
_OPTION = re.compile(r"(?:--set )?(?:data|skin)\.(\w+)")

# The remedy for files that cannot be read, which arrays are not.
_LEAVE_OUT = re.compile(r", or leave them out: .*--skip-bad\)")


@contextlib.contextmanager
def name_in_errors(name: str, path: Path):
    """Errors in the block name what the user gave instead of a temporary file."""
    try:
        yield
    except SeveralErrors as error:
        raise SeveralErrors([line.replace(str(path), name) for line in error.lines]) from error
    except UserError as error:
        raise UserError(str(error).replace(str(path), name)) from error


@contextlib.contextmanager
def name_arguments_in_errors():
    """Errors in the block name arguments of Python instead of options of the command line."""
    try:
        yield
    except SeveralErrors as error:
        raise SeveralErrors(list(map(_name_arguments, error.lines))) from error
    except UserError as error:
        raise UserError(_name_arguments(str(error))) from error


def _name_arguments(line):
    return _OPTION.sub(r"\1", _LEAVE_OUT.sub("", line))


def read_recordings(path, **reading) -> Recordings:
    """See :meth:`pipeline.recordings.recordings.Recordings.read`."""
    with name_arguments_in_errors():
        return import_recordings(
            Path(path),
            warn=lambda line: remark(_name_arguments(line)),
            reading=ReadingOptions(**reading),
        )


def make_recordings(events, labels, size, name: str, details: dict) -> Recordings:
    """See :meth:`pipeline.recordings.recordings.Recordings.from_arrays`.

    Parameters
    ----------
    events : iterable
    labels : iterable or None
    size : (int, int)
        Rows and columns of the sensor; 0 where they are not known.
    name : str
    details : dict
        Arguments of :func:`pipeline.recordings.files.writing.write_recordings`.
    """
    _require_name(name)
    events = _list_recordings(events, name)
    labels = [UNLABELLED] * len(events) if labels is None else _list_labels(labels, name)
    if len(events) != len(labels):
        raise UserError(
            f"{name}: {format_count(len(events), 'recording')} and "
            f"{format_count(len(labels), 'label')}; give a label for each"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{NAME}.zip"

        def warn(line):
            remark(_name_arguments(line.replace(str(path), name)))

        with name_in_errors(name, path), name_arguments_in_errors():
            write_recordings(path, zip(events, labels, strict=True), **details)
            recordings = import_recordings(path, warn=warn, reading=ReadingOptions(*size))
    unit = recordings.source.time_unit
    if unit and not details["time_unit"]:
        remark(f"{name}: times are read as {UNIT_NAMES[unit]}; give another unit as time_unit")
    # The names of the files are the numbers of the recordings; a source is sorted by class.
    in_given_order = np.argsort([int(PurePosixPath(each).name) for each in recordings.ids])
    recordings = recordings.subset(in_given_order)
    return replace(recordings, source=replace(recordings.source, name=name))


def _require_name(name):
    """Refuse a name that cannot be that of a file, as messages of reading have it."""
    is_text = isinstance(name, str) and name.isprintable() and name.strip(" .")
    if not is_text or "/" in name or len(name) > MAX_NAME:
        raise UserError(f"name {name!r}: give at most {MAX_NAME} characters without a slash")


def _list_recordings(events, name) -> list:
    """The events of each recording; those of a single one are refused with the remedy."""
    in_list = f"{name}: the events of one recording; give a list of recordings: [events]"
    if isinstance(events, Mapping):
        raise UserError(in_list)
    if isinstance(events, np.ndarray):
        is_structured = events.dtype.names is not None
        if (events.ndim == 1 and is_structured) or (events.ndim == 2 and not is_structured):
            raise UserError(in_list)
    events = list(events)
    shapes = [np.shape(each) for each in events if isinstance(each, np.ndarray)]
    are_columns = len(events) == len(shapes) == 4 and {len(shape) for shape in shapes} == {1}
    if are_columns and all(each.dtype.names is None for each in events):
        raise UserError(in_list)
    return events


def _list_labels(labels, name) -> list:
    """The labels of recordings; arrays that are no labels are refused with the remedy."""
    if isinstance(labels, str):
        raise UserError(f"{name}: labels {labels!r} are one name; give a list of them")
    labels = list(labels)
    values = [each for each in labels if not isinstance(each, str)]
    if any(np.ndim(value) for value in values):
        raise UserError(
            f"{name}: a label is a number or a name, not an array; give one-hot labels as "
            "labels.argmax(1), a single column as labels[:, 0]"
        )
    if any(isinstance(value, (float, np.floating)) for value in values):
        raise UserError(
            f"{name}: labels are whole numbers from 0, or names; give labels.astype(int)"
        )
    return labels


@dataclass(frozen=True)
class _OfOneSensor:
    """Recordings of one sensor, in the form of a data set of Tonic's.

    Attributes
    ----------
    pairs : iterable of (events, label)
    sensor_size : (int, int)
        Columns and rows.
    """

    pairs: Iterable
    sensor_size: tuple

    def __iter__(self):
        return iter(self.pairs)


def write_npz_zip(recordings: Recordings, path) -> Path:
    """See :meth:`pipeline.recordings.recordings.Recordings.write`."""
    taxels = recordings.taxels
    names = recordings.sensor.classes

    def make_events(index):
        events = recordings[index]
        return {
            "x": taxels.column[events.taxel],
            "y": taxels.row[events.taxel],
            "t": events.time_ns,
            "p": events.polarity,
        }

    labels = [names[label] for label in recordings.labels]
    known_writers = bool((recordings.writers >= 0).all())
    pairs = zip(map(make_events, range(len(recordings))), labels, strict=True)
    sensor = recordings.sensor
    return write_recordings(
        path,
        _OfOneSensor(pairs, (sensor.columns, sensor.rows)),
        classes=list(names),
        time_unit="ns",
        writers=recordings.writers.tolist() if known_writers else None,
        simulated=recordings.source.simulated,
        parts=recordings.parts if recordings.is_split else None,
    )
