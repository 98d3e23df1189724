"""Recordings as events x, y, t, p, the conventions of event cameras: arrays, and files of them.

``x`` is the column from the left and ``y`` the row from the top, whole numbers from 0; ``p`` is the
polarity, as truth values, 0 and 1, or -1 and 1; ``t`` is the time in seconds, milliseconds,
microseconds or nanoseconds.  A file has one recording:

``.npz``     four arrays x, y, t, p, or one array, structured or with rows of four numbers
``.npy``     one such array
``.csv``     one line per event, four columns, with or without their names in the first line
``.aedat4``, ``.raw``, ``.dat``   of iniVation's and Prophesee's cameras, read with faery

Nothing in a file is executed: only plain arrays of numbers are read, and no more than a recording
can have.
"""

import io
import re
import tempfile
import zipfile
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from deploy.errors import SeveralErrors, UserError
from deploy.files import replacing, require_ending, zip_member
from pipeline.recordings.events import Events
from pipeline.recordings.formats.mat import BadRecording, writer_of

CAMERA_SUFFIXES = (".aedat4", ".raw", ".dat")
# File name endings of files of events.
SUFFIXES = (".npz", ".npy", ".csv", *CAMERA_SUFFIXES)

# Duration of each unit of time in seconds.
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

ARRAYS = ("x", "y", "t", "p")

# Names of fields and columns, in upper or lower case, the preferred one first; some include the
# unit.
NAMES = {
    "x": ("x", "column", "col"),
    "y": ("y", "row"),
    "t": (*(f"t_{unit}" for unit in UNITS), "t", "time", "timestamp", "ts"),
    "p": ("p", "polarity", "pol", "on"),
}

# Events of one recording.
MAX_EVENTS = 5_000_000

# Highest coordinate of any sensor; the input of a network is smaller.
MAX_PLACE = 16_383

# Bytes of an event in an array: eight fields of eight bytes.
LARGEST_EVENT = 64


@dataclass(frozen=True)
class EventRecording:
    """The events of one file or array, in order of time.

    Attributes
    ----------
    x, y : ndarray of int64, shape (n,)
        Column and row, from 0.
    time : ndarray of int64 or float64, shape (n,)
        Not negative, in ``unit``.
    polarity : ndarray of int8, shape (n,)
    unit : str
        One of :data:`UNITS`; empty if it is not known.
    size : (int, int) or None
        Rows and columns of the sensor, if the file has them.
    simulated : bool
        True if the file states that it is simulated.
    writer : int
        Number of the person who made the recording, from 0; -1 if the file does not have it.
    """

    x: np.ndarray
    y: np.ndarray
    time: np.ndarray
    polarity: np.ndarray
    unit: str = ""
    size: tuple | None = None
    simulated: bool = False
    writer: int = -1

    def __len__(self):
        return len(self.polarity)

    def events(self, rows: int, time_ns: np.ndarray) -> Events:
        """The events with taxels numbered as by :meth:`pipeline.recordings.events.TaxelMap.grid`.

        Parameters
        ----------
        rows : int
            Number of rows of the sensor.
        time_ns : ndarray of int64, shape (n,)
        """
        taxel = self.y + rows * self.x
        return Events(time_ns, taxel, self.polarity, np.ones(len(taxel)))


def recording_of(events) -> EventRecording:
    """Check events and bring them into order of time.

    Parameters
    ----------
    events : structured array, array_like of shape (n, 4), dict, or sequence of four arrays
        A dict has the arrays by name; a sequence and rows of four numbers have the order x, y,
        t, p.

    Raises
    ------
    BadRecording
        The events have another form; arrays are missing, empty, not numbers or of different
        lengths; coordinates are not whole numbers from 0; times are NaN or negative; polarities
        have three values.
    """
    named, unit = _named(events)
    arrays = {name: np.asarray(array) for name, array in named.items()}
    for name, array in arrays.items():
        if array.ndim != 1 or array.dtype.kind not in "fiub" or array.dtype.itemsize > 8:
            raise BadRecording(f"{name!r} is not a row of numbers")
    lengths = {len(array) for array in arrays.values()}
    if len(lengths) != 1:
        listed = ", ".join(f"{name} {len(array)}" for name, array in arrays.items())
        raise BadRecording(f"has arrays of different lengths: {listed}")
    if lengths == {0}:
        raise BadRecording("is empty: no events")
    if max(lengths) > MAX_EVENTS:
        raise BadRecording(f"has {max(lengths)} events, more than {MAX_EVENTS}")
    x, y, t, p = (arrays[name] for name in ARRAYS)
    t = _times(t)
    for name, places in (("x", x), ("y", y)):
        outside = ~((places >= 0) & (places <= MAX_PLACE) & (places == np.floor(places)))
        if outside.any():
            raise BadRecording(
                f"{name} has {places[outside][0]:g}, not whole numbers from 0 to {MAX_PLACE}"
            )
    order = np.argsort(t, kind="stable")
    places = (np.asarray(array, np.int64)[order] for array in (x, y))
    return EventRecording(*places, time=t[order], polarity=_polarity(p)[order], unit=unit)


def _times(t):
    """Convert values to integers if all are whole numbers, else to floating point."""
    if not np.isfinite(t).all():
        raise BadRecording("has a time that is NaN or infinite")
    if t.max() >= 2.0**62:
        raise BadRecording("has a time past every clock's")
    if t.min() < 0:
        raise BadRecording("has a negative time")
    is_whole = t.dtype.kind in "iub" or ((t == np.rint(t)).all() and t.max() > 0)
    return t.astype(np.int64 if is_whole else float)


def _polarity(p):
    values = set(np.unique(p).tolist())
    if p.dtype.kind == "b" or values <= {0, 1}:
        return np.where(p > 0, 1, -1).astype(np.int8)
    if values <= {-1, 1}:
        return p.astype(np.int8)
    wrong = values - {-1, 0, 1}
    which = f"{min(wrong):g}" if wrong else "-1, 0 and 1 together"
    raise BadRecording(f"p has {which}, not 1 (ON) and -1 (OFF), 1 and 0, or true and false")


def _named(events):
    """The four arrays by name, from any form of events; and the unit of time if a name has it."""
    if isinstance(events, np.ndarray) and events.dtype.names:
        if events.ndim != 1:
            raise BadRecording(f"is a structured array of {events.ndim} dimensions, not one")
        events = {name: events[name] for name in events.dtype.names}
    if isinstance(events, dict):
        chosen = _by_name(events)
        unit = str(chosen["t"]).strip().lower().partition("t_")[2]
        return {name: events[key] for name, key in chosen.items()}, unit
    is_four = isinstance(events, (tuple, list)) and len(events) == 4
    if is_four and all(isinstance(row, (list, tuple)) and len(row) == 4 for row in events):
        raise BadRecording("is four lists of four: rows or columns? give a dict of x, y, t and p")
    if is_four and all(np.ndim(array) == 1 for array in events):
        return dict(zip(ARRAYS, events, strict=True)), ""
    rows = np.asarray(events)
    if rows.ndim == 2 and rows.shape[1] == 4:
        return dict(zip(ARRAYS, rows.T, strict=True)), ""
    raise BadRecording(
        f"is an array of shape {rows.shape}, not four arrays x, y, t, p, a structured array or "
        "rows of four numbers"
    )


def _by_name(names) -> dict:
    """The names of the columns x, y, t and p among others; :data:`NAMES` has the alternatives."""
    lower = {str(name).strip().lower(): name for name in names}
    chosen = {}
    for name, others in NAMES.items():
        key = next((other for other in others if other in lower), None)
        if key is None:
            raise BadRecording(f"has no array {name!r}; expected x, y, t and p")
        chosen[name] = lower[key]
    return chosen


def read_events(content: bytes, name: str = "recording.npz") -> EventRecording:
    """Read a file of events.

    Parameters
    ----------
    content : bytes
        Content of a file.
    name : str
        The file's name, whose end determines the format, one of :data:`SUFFIXES`.

    Raises
    ------
    BadRecording
        The file has another format, or its content is not a recording: see
        :func:`recording_of`.
    """
    if not content:
        raise BadRecording("is an empty file")
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in CAMERA_SUFFIXES:
        return _camera(content, suffix)
    if suffix == ".npz":
        return _npz(content)
    return recording_of(_csv(content) if suffix == ".csv" else _array(content, "the array"))


def _camera(content, suffix):
    """Read with faery (https://github.com/aestream/faery, LGPL 3), which is optional."""
    try:
        import faery
    except ImportError as error:
        raise BadRecording(
            "needs the package faery; install it: pip install 'stmnist-loihi[cameras]'"
        ) from error
    with tempfile.TemporaryDirectory() as folder:  # faery opens files by their names only
        path = Path(folder) / f"recording{suffix}"
        path.write_bytes(content)
        parts, number = [], 0
        try:
            stream = faery.events_stream_from_file(path)
            columns, rows = stream.dimensions()
            for part in stream:
                parts.append(part.copy())
                number += len(part)
                if number > MAX_EVENTS:
                    raise BadRecording(f"has more than {MAX_EVENTS} events")
        except BadRecording:
            raise
        except BaseException as error:
            # A damaged file may end in a panic of faery's Rust, which is no Exception.
            if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError)):
                raise
            raise BadRecording(f"is damaged, or not a {suffix} file") from error
    events = np.concatenate(parts) if parts else np.empty(0, faery.EVENTS_DTYPE)
    recording = recording_of({"t_us": events["t"], **{name: events[name] for name in "xyp"}})
    return replace(recording, size=(int(rows), int(columns)))


_BOOLEAN = re.compile(r"\b(true|false)\b", re.IGNORECASE)


def _csv(content):
    """Columns by the names in the first line, or four columns of numbers."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadRecording("is not text in UTF-8") from error
    text = _BOOLEAN.sub(lambda found: str(int(found[0].lower() == "true")), text)
    lines = [line.strip() for line in text.splitlines() if line.strip().strip("#").strip()]
    body = [line for line in lines if line[0] != "#"]
    if not body:
        raise BadRecording("is empty: no events")
    separator = next((mark for mark in ",;\t" if mark in body[-1]), None)
    words = [word.strip().strip('"').lower() for word in body[0].split(separator)]
    above = lines[: lines.index(body[0])][-1:]
    has_names = any(word in names for word in words for names in NAMES.values())
    if has_names:
        del body[0]
    elif above:  # NumPy writes the names as a comment
        words = re.findall(r"[^,;#\s]+", above[0].lower())
        has_names = all(set(words) & set(names) for names in NAMES.values())
    if not body:
        raise BadRecording("is empty: no events")
    wanted = read = None
    if has_names:
        wanted = list(_by_name(words).values())
        read = [words.index(name) for name in wanted]  # other columns may have text
        sizes = {len(line.partition("#")[0].split(separator)) for line in body}
        if odd := sizes - {len(words)}:
            raise BadRecording(f"has {min(odd)} columns below {len(words)} names")
    most = MAX_EVENTS + 1
    try:
        table = np.loadtxt(body, delimiter=separator, ndmin=2, max_rows=most, usecols=read)
    except ValueError as error:
        raise BadRecording("has a line that is not numbers, as many as in the others") from error
    return dict(zip(wanted, table.T, strict=True)) if has_names else table


def _npz(content):
    """The four arrays by name, or the single array; and further entries of the file."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            sizes = {
                info.filename.removesuffix(".npy"): info.file_size
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
            about = [name for name in ("simulated", "writer") if name in sizes]
            events = [name for name in sizes if name not in about]
            wanted = events if len(events) == 1 else list(_by_name(events).values())
            if sum(sizes[name] for name in wanted + about) > LARGEST_EVENT * MAX_EVENTS + 4096:
                raise BadRecording(f"has arrays of more than {MAX_EVENTS} events")
            arrays = {name: _array(archive.read(f"{name}.npy"), name) for name in wanted + about}
    except BadRecording:
        raise
    except MemoryError:
        raise
    except Exception as error:  # damaged lists and unsupported compressions fail in many ways
        raise BadRecording("is not a .npz file, or damaged") from error
    about = {name: arrays.pop(name) for name in about}
    writer = about.get("writer", np.empty(0))
    return replace(
        recording_of(arrays if len(arrays) > 1 else next(iter(arrays.values()))),
        simulated=bool(np.any(about.get("simulated", False))),
        writer=writer_of(writer.item() if writer.size == 1 else None),
    )


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
        return np.frombuffer(data.read(), dtype).reshape(shape, order="FC"[not columns_first])
    except BadRecording:
        raise
    except Exception as error:  # damaged headers fail in many ways
        raise BadRecording(f"{name!r} is damaged") from error


# Number of reasons that are listed individually.
LISTED = 10


def write_recordings(
    path,
    recordings: Iterable,
    classes: Sequence[str] | None = None,
    time_unit: str = "",
    writers: Sequence[int] | None = None,
    simulated: bool = False,
    parts: Sequence[str] | None = None,
) -> Path:
    """Write events and labels as a zip that every command accepts as recordings.

    A training needs at least two recordings of each class; `stmnist adapt` does not.

    Give its path as ``data.source`` in the settings, or as ``--data`` to a command.

    Parameters
    ----------
    path : path-like
        The zip; its name must end in ``.zip``.  An existing file is replaced.
    recordings : iterable of (events, label)
        For example a data set of Tonic, or ``zip(events, labels)``.  Events have any of the forms
        of :func:`recording_of`: x is the column from the left, y the row from the top.  A label is
        a number from 0, or the name of a class.
    classes : sequence of str, optional
        Names of the labels 0, 1, ...; default: the ``classes`` of ``recordings`` if it has this
        attribute, else the labels themselves.
    time_unit : str
        Unit of the times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; empty: inferred from the
        duration of the recordings when the file is read.
    writers : sequence of int, optional
        Number of the person who made each recording, from 0.
    simulated : bool
        True if the recordings are simulated; every result repeats this.
    parts : sequence of str, optional
        ``"train"`` or ``"test"`` for each recording, of a data set with a published split.

    Returns
    -------
    Path

    Raises
    ------
    UserError
        Events or labels are not valid, with a line for each reason; or there are none.
    """
    path = Path(path)
    require_ending(path, ".zip")
    if time_unit and time_unit not in UNITS:
        raise UserError(f"time_unit {time_unit!r}: choose one of {', '.join(UNITS)}")
    if parts is not None and not set(parts) <= {"train", "test"}:
        raise UserError(f"{path}: a part is 'train' or 'test', for each recording")
    if writers is not None and not all(
        isinstance(writer, (int, np.integer)) and writer >= 0 for writer in writers
    ):
        raise UserError(f"{path}: a writer is a whole number from 0, for each recording")
    if classes is None:
        classes = getattr(recordings, "classes", None)
    if isinstance(classes, Set):
        raise ValueError("classes: a set has no order; give a list of names")
    names, written, problems = list(map(str, () if classes is None else classes)), 0, {}
    if len(set(names)) < len(names):
        raise UserError(f"{path}: two of the classes have the same name")
    index, sizes = -1, {len(values) for values in (writers, parts) if values is not None}
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        for index, (events, label) in enumerate(recordings):
            if index in sizes:  # more recordings than writers or parts
                break
            try:
                name = _class_of(label, names, classes is not None)
                writer = -1 if writers is None else int(writers[index])
                content = _npz_bytes(recording_of(events), time_unit, writer, simulated)
            except BadRecording as error:
                problems.setdefault(str(error), []).append(index)
                continue
            member = PurePosixPath("" if parts is None else parts[index], name, f"{index:06d}.npz")
            archive.writestr(zip_member(member, zipfile.ZIP_STORED), content)
            written += 1
        if sizes - {index + 1}:
            raise UserError(f"{path}: give a writer or a part for each of the recordings")
        lines = [
            f"{path}: {len(where)} of {index + 1}: recording {where[0]} {reason}"
            for reason, where in list(problems.items())[:LISTED]
        ]
        if not lines and not written:
            lines.append(f"{path}: no recordings")
        if lines:
            raise SeveralErrors(lines)
    return path


def _class_of(label, names, is_fixed):
    """The name of a label's class, which must be one of the names if these are fixed."""
    is_number = isinstance(label, (int, np.integer)) and not isinstance(label, bool)
    if is_fixed and is_number:
        if not 0 <= label < len(names):
            raise BadRecording(f"has the label {label}, not from 0 to {len(names) - 1}")
        name = names[label]
    elif isinstance(label, (str, int, np.integer)):
        name = str(label)
    else:
        raise BadRecording(
            f"has a label of the type {type(label).__name__}; give pairs (events, label) with a "
            "number or a name as label"
        )
    parts = PurePosixPath(name).parts
    if len(parts) != 1 or parts[0] in ("..", "/") or name.startswith(".") or not name.isprintable():
        raise BadRecording(f"has the class {name!r}, which is not a valid name of a folder")
    if is_fixed and name not in names:
        raise BadRecording(f"has the class {name!r}, which is not one of those given")
    return name


def _npz_bytes(recording, time_unit, writer, simulated) -> bytes:
    arrays = {"x": recording.x.astype(np.uint16), "y": recording.y.astype(np.uint16)}
    unit = recording.unit or time_unit
    arrays[f"t_{unit}" if unit else "t"] = recording.time
    arrays["p"] = recording.polarity
    if writer >= 0:
        arrays["writer"] = np.array(writer)
    if simulated:
        arrays["simulated"] = np.array(True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()
