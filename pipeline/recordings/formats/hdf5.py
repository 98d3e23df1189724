"""HDF5 files with one table of events, or with a group of columns.

A table is a data set of records with fields named as in
:data:`~pipeline.recordings.formats.recording.COLUMN_NAMES`, or of rows of four numbers.  Columns
are data sets in one group, such as ``events/x``, ``events/y``, ``events/t`` and ``events/p``.

STEMNIST, the successor of ST-MNIST, has the data set ``spikes`` with the fields ``timestamp``,
``polarity`` and ``taxel_id``, in files named ``<person>_<class>_<number>_spikes.h5``.  Its 16 x 16
taxels are numbered row by row from 1.

Files come from elsewhere: links to other files are refused, and nothing is read before its declared
size is known to be small enough.
"""

import io
import math
import re
import zlib
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np

from deploy.errors import shorten_error
from pipeline.recordings.formats.column_order import make_array_recording
from pipeline.recordings.formats.recording import (
    MAX_EVENTS,
    BadRecording,
    EventRecording,
    find_columns,
    make_recording,
)

ENDINGS = (".h5", ".hdf5")

# Rows and columns of STEMNIST's sensor.
STEMNIST_SIDE = 16

# Name of the column of numbered taxels.
TAXEL = "taxel_id"

STEMNIST_NAME = re.compile(r"(?P<person>[^_]+)_.+_\d+_spikes")

# Objects of a file, and bytes of an event in a table: eight fields of eight bytes.
MAX_OBJECTS = 10_000
MAX_EVENT_BYTES = 64


def read_hdf5(content: bytes, name: str) -> EventRecording:
    """Read the events of a file.

    Parameters
    ----------
    content : bytes
    name : str
        Path of the file, which has the person in STEMNIST.

    Raises
    ------
    BadRecording
        The file is damaged, refers to others, or does not have exactly one table of events or
        group of columns; or these are no events.
    """
    import h5py

    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            named, rows = _find_events(file)
            candidates = named or rows
            if len(candidates) != 1:
                listed = f": {', '.join(sorted(candidates)[:4])}" if candidates else ""
                raise BadRecording(
                    f"has {len(candidates)} tables of events{listed}; expected one data set with "
                    "the fields x, y, t and p, or one group of data sets with these names"
                )
            (entry,) = candidates.values()
            events: np.ndarray | dict
            if isinstance(entry, h5py.Group):
                events = {column: _read_dataset(entry[column]) for column in _list_columns(entry)}
            else:
                events = _read_dataset(entry)
    except (BadRecording, MemoryError):
        raise
    except Exception as error:  # h5py fails in many ways on damaged files
        reason = shorten_error(error, 120)
        raise BadRecording(f"is damaged, or not an HDF5 file ({reason})") from error
    columns = events if isinstance(events, dict) else events.dtype.names or ()
    if TAXEL in columns:
        return _make_stemnist_recording({column: events[column] for column in columns}, name)
    if isinstance(events, np.ndarray):
        return make_array_recording(events)
    return make_recording(events)


def _find_events(file):
    """Tables and groups whose columns have names, and tables of rows, by their paths."""
    import h5py

    named = {}
    rows = {}
    number = 0
    waiting = [("", file)]
    while waiting:
        path, group = waiting.pop()
        if _list_columns(group):
            named[path or "/"] = group
        for name in group:
            number += 1
            if number > MAX_OBJECTS:
                raise BadRecording(f"has more than {MAX_OBJECTS} objects")
            where = f"{path}/{name}"
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise BadRecording(f"has a link, {where!r}, which may lead out of the file")
            entry = group[name]
            if isinstance(entry, h5py.Group):
                waiting.append((where, entry))
            elif isinstance(entry, h5py.Dataset) and _is_table(entry):
                (rows if entry.dtype.names is None else named)[where] = entry
    return named, rows


def _is_table(dataset) -> bool:
    """True for records with the fields of events, and for rows of four numbers."""
    if dataset.dtype.names is None:
        return dataset.ndim == 2 and dataset.shape[1] == 4 and dataset.dtype.kind in "fiu"
    return dataset.ndim == 1 and bool(_find_named(dataset.dtype.names))


def _find_named(names) -> list:
    """The names of the columns x, y, t and p, or taxel_id, t and p; empty if one is missing."""
    try:
        if TAXEL in names:
            columns = find_columns([*names, "x", "y"])
            return [columns["t"], columns["p"], TAXEL]
        return list(find_columns(names).values())
    except BadRecording:
        return []


def _list_columns(group) -> list:
    """Names of a group's data sets of columns; an empty list if one is missing."""
    import h5py

    links = {name: group.get(name, getlink=True, default=None) for name in group}
    hard_links = [name for name, link in links.items() if isinstance(link, h5py.HardLink)]
    columns = _find_named(hard_links)
    is_column = [
        isinstance(group[name], h5py.Dataset) and group[name].ndim == 1 for name in columns
    ]
    return columns if all(is_column) else []


def _read_dataset(dataset) -> np.ndarray:
    """The values of a data set, after a check of the sizes that it declares."""
    if dataset.external or dataset.is_virtual:
        raise BadRecording(f"{dataset.name!r} refers to another file")
    fields = dataset.dtype.names
    dtypes = [dataset.dtype[name] for name in fields] if fields else [dataset.dtype]
    type_codes = {dtype.kind for dtype in dtypes}
    if not type_codes <= set("fiub") or dataset.dtype.itemsize > MAX_EVENT_BYTES:
        raise BadRecording(f"{dataset.name!r} has other values than numbers")
    if dataset.shape[0] > MAX_EVENTS:
        raise BadRecording(f"has {dataset.shape[0]} events, more than {MAX_EVENTS}")
    chunk = math.prod(dataset.chunks or (1,))
    if chunk > 4 * MAX_EVENTS:
        raise BadRecording(f"{dataset.name!r} has chunks of {chunk} values, more than its events")
    return dataset[()]


def _make_stemnist_recording(events, name) -> EventRecording:
    """A recording of STEMNIST's sensor, of the person in the name of the file."""
    taxel = events[TAXEL].astype(np.int64) - 1
    outside = (taxel < 0) | (taxel >= STEMNIST_SIDE**2)
    if outside.any():
        raise BadRecording(
            f"taxel_id has {taxel[outside][0] + 1}, not 1 to {STEMNIST_SIDE**2} as in STEMNIST"
        )
    columns = find_columns([*events, "x", "y"])
    recording = make_recording(
        {
            "x": taxel % STEMNIST_SIDE,
            "y": taxel // STEMNIST_SIDE,
            columns["t"]: events[columns["t"]],
            "p": events[columns["p"]],
        },
        size=(STEMNIST_SIDE, STEMNIST_SIDE),
    )
    return replace(recording, writer=_read_writer(name))


def _read_writer(name) -> int:
    """Number of the person in the name of a file of STEMNIST, or -1.

    A name without a number gets one from its characters, the same in every file.
    """
    match = STEMNIST_NAME.fullmatch(PurePosixPath(name).stem)
    if match is None:
        return -1
    person = match["person"]
    digits = re.findall(r"\d{1,9}", person)
    return int(digits[-1]) if digits else zlib.crc32(person.encode()) & 0x7FFFFFFF
