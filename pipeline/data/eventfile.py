"""Read a file of events with one recording: formats, each converted to x, y, t and p.

``.npz``     four arrays x, y, t, p, or one array, structured or with rows of four numbers
``.npy``     one such array
``.csv``     one line per event, four columns, with or without their names in the first line
``.bin``     the layout of N-MNIST and N-Caltech101: five bytes per event
``.aedat``   AEDAT 3.1, the layout of DVS Gesture
``.aedat4``, ``.raw``, ``.dat``   of iniVation's and Prophesee's cameras, read with faery

The arrays are described in :mod:`pipeline.data.eventarrays`.  Nothing in a file is executed:
only plain arrays of numbers are read, and no more than a recording can have.
"""

from __future__ import annotations

import contextlib
import io
import zipfile
import zlib
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np

from pipeline.data.camerafile import CAMERA_SUFFIXES, read_camera
from pipeline.data.eventarrays import (
    ARRAYS,
    MAX_EVENTS,
    MAX_PLACE,
    NAMES,
    EventRecording,
    by_name,
    recording_of,
)
from pipeline.data.matfile import BadRecording, writer_of

SUFFIXES = (".npz", ".npy", ".csv", ".bin", ".aedat", *CAMERA_SUFFIXES)
"""File name endings of files of events."""

MOST_ARRAYS = 16
"""Largest number of arrays in a .npz file."""

LARGEST_EVENT = 64
"""Bytes of an event in an array: eight fields of eight bytes."""


def read_events(
    content: bytes, name: str = "recording.npz", most: int = MAX_EVENTS
) -> EventRecording:
    """Read a recording.

    Parameters
    ----------
    content : bytes
        Content of a file.
    name : str
        The file's name, whose end determines the format.
    most : int
        Maximum number of events of an ``.aedat`` or ``.bin`` file.

    Raises
    ------
    BadRecording
        The file has another format, or its content is not a recording: see
        :func:`pipeline.data.eventarrays.recording_of`.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in CAMERA_SUFFIXES:
        return read_camera(content, suffix)
    if suffix == ".bin":
        return recording_of(_nmnist(content), "us", most)
    if suffix == ".aedat":
        return recording_of(_aedat3(content), "us", most)
    if suffix == ".npz":
        return _npz(content)
    return recording_of({".npy": _npy, ".csv": _csv}[suffix](content))


NMNIST_OVERFLOW, NMNIST_LAP = 240, 2**13
"""The y of an entry that marks an overflow of the clock, and the microseconds to add after it."""


def _nmnist(content):
    """Read N-MNIST and N-Caltech101 (Orchard et al., 2015): x, y, polarity and 23 bits of time."""
    if len(content) % 5:
        raise BadRecording("is not a whole number of events of five bytes, as N-MNIST has them")
    values = np.frombuffer(content, np.uint8).reshape(-1, 5).astype(np.int64)
    time = (values[:, 2] & 0x7F) << 16 | values[:, 3] << 8 | values[:, 4]
    overflows = values[:, 1] == NMNIST_OVERFLOW
    time = (time + NMNIST_LAP * np.cumsum(overflows))[~overflows]
    values = values[~overflows]
    return {"x": values[:, 0], "y": values[:, 1], "t": time, "p": values[:, 2] >> 7}


AEDAT3_POLARITY = 1
"""Kind of a packet with events of pixels."""


def _aedat3(content):
    """AEDAT 3.1: lines of a header, then packets; only those of pixels count.

    A packet has 28 bytes of header (kind, source, bytes of an event, offset of its time, overflows
    of the time, capacity, number of events, valid ones); an event of a pixel has four bytes (bit 0:
    valid, bit 1: polarity, 15 bits y, 15 bits x) and four of the time in microseconds (iniVation's
    specification of AEDAT 3.1).
    """
    if not content.startswith(b"#!AER-DAT3"):
        raise BadRecording("is not an AEDAT 3.1 file")
    end = content.find(b"#!END-HEADER\r\n")
    if end < 0:
        raise BadRecording("has a header without an end")
    at, parts = end + len(b"#!END-HEADER\r\n"), []
    while at < len(content):
        if at + 28 > len(content):
            raise BadRecording("is cut short")
        kind = int.from_bytes(content[at : at + 2], "little")
        size, _, overflow, _, number, _ = np.frombuffer(content, "<u4", 6, at + 4).tolist()
        at += 28
        if size < 1 or at + size * number > len(content):
            raise BadRecording("is cut short")
        if kind == AEDAT3_POLARITY and size == 8:
            data, time = np.frombuffer(content, "<u4", 2 * number, at).reshape(-1, 2).T
            valid = (data & 1) == 1
            parts.append((data[valid], time[valid].astype(np.int64) + (overflow << 31)))
        at += size * number
    if not parts:
        raise BadRecording("is empty: no events")
    data, time = (np.concatenate(part) for part in zip(*parts, strict=True))
    return {"x": data >> 17, "y": data >> 2 & 0x7FFF, "t": time, "p": data >> 1 & 1}


def _csv(content):
    """Columns by the names in the first line, or four columns of numbers."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadRecording("is not text in UTF-8") from error
    first = text.lstrip().partition("\n")[0]
    separator = next((mark for mark in ",;\t" if mark in first), None)
    words = [word.strip().strip('"').lower() for word in first.split(separator)]
    known = {name for names in NAMES.values() for name in names}
    has_names = any(word in known for word in words)
    try:
        table = np.loadtxt(
            io.StringIO(text),
            delimiter=separator,
            skiprows=int(has_names),
            ndmin=2,
            max_rows=MAX_EVENTS + 1,
            comments=None if has_names else "#",
        )
    except ValueError as error:
        raise BadRecording("has a line that is not numbers, as many as in the others") from error
    if not len(table):
        raise BadRecording("is empty: no events")
    if not has_names:
        return dict(zip(ARRAYS, table.T, strict=True)) if _in_order(table) else table
    if len(words) != table.shape[1]:
        raise BadRecording(f"has {table.shape[1]} columns below {len(words)} names")
    return dict(zip(words, table.T, strict=True))


def _in_order(table):
    """True if four columns without names can be x, y, t and p, the documented order.

    Another order is not inferred from times that are out of order, because x may increase in a
    recording and the times in another one.
    """
    if table.shape[1] != len(ARRAYS):
        return False
    x, y, _, p = table.T
    places = np.stack([x, y])
    whole = (places >= 0) & (places <= MAX_PLACE) & (places == np.floor(places))
    return bool(whole.all() and np.isin(p, (-1, 0, 1)).all())


def _npz(content):
    """The four arrays by name, or the single array; and further entries of the file."""
    sizes = _sizes(content)
    about = [name for name in ("simulated", "writer") if name in sizes]
    events = [name for name in sizes if name not in about]
    wanted = about + (events if len(events) == 1 else list(by_name(events).values()))
    if sum(sizes[name] for name in wanted) > LARGEST_EVENT * MAX_EVENTS + 4096:
        raise BadRecording(f"has arrays of more than {MAX_EVENTS} events")
    arrays = {name: _array(_member(content, name + ".npy"), name) for name in wanted}
    about = {name: arrays.pop(name) for name in about}
    (only,) = arrays.values() if len(arrays) == 1 else (arrays,)
    read = recording_of(only)
    return replace(
        read,
        simulated=bool(np.any(about.get("simulated", False))),
        writer=_writer(about.get("writer")),
    )


def _writer(said):
    """A number from 0, or -1 for anything else."""
    whole = said is not None and said.size == 1 and said.dtype.kind in "iu"
    return writer_of(said.ravel()[0] if whole else None)


def _npy(content):
    return _array(content, "the array")


def _sizes(content):
    """The declared sizes of the arrays, in bytes, by name."""
    with _reading_zip(content) as archive:
        sizes = {
            info.filename.removesuffix(".npy"): info.file_size
            for info in archive.infolist()
            if info.filename.endswith(".npy")
        }
    if not 1 <= len(sizes) <= MOST_ARRAYS:
        raise BadRecording(f"has {len(sizes)} arrays, not x, y, t and p")
    return sizes


def _member(content, name):
    with _reading_zip(content) as archive:
        member = archive.getinfo(name)
        with archive.open(member) as file:
            return file.read(member.file_size)


@contextlib.contextmanager
def _reading_zip(content):
    """The archive; anything that fails is damage of the file."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            yield archive
    except zipfile.BadZipFile as error:
        raise BadRecording("is not a .npz file, or damaged") from error
    except Exception as error:  # damaged lists and unsupported compressions fail in many ways
        raise BadRecording(f"is a damaged .npz file ({type(error).__name__})") from error


def _array(content, name):
    """An array of numbers, after comparing its declared size with the number of bytes."""
    data = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(data)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, columns_first, dtype = read_header(data)
        kinds = {dtype[field].kind for field in dtype.names} if dtype.names else {dtype.kind}
        if not kinds <= set("fiub") or dtype.itemsize > LARGEST_EVENT or len(shape) > 2:
            raise BadRecording(f"{name!r} is not a row of numbers")
        values = np.frombuffer(data.read(), dtype)
        if len(values) != np.prod(shape, dtype=object):
            raise BadRecording(f"{name!r} is damaged")
        return values.reshape(shape, order="F" if columns_first else "C")
    except BadRecording:
        raise
    except (ValueError, TypeError, KeyError, OSError, EOFError, zlib.error) as error:
        raise BadRecording(f"{name!r} is damaged") from error
    except Exception as error:  # crafted headers fail in many ways
        raise BadRecording(f"{name!r} is damaged ({type(error).__name__})") from error
