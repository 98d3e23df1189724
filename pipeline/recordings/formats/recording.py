"""A recording as events x, y, t, p, the conventions of event cameras: what each format gives.

``x`` is the column from the left and ``y`` the row from the top, whole numbers from 0; ``p`` is the
polarity, as truth values, 0 and 1, or -1 and 1; ``t`` is the time in seconds, milliseconds,
microseconds or nanoseconds.  :func:`make_recording` accepts them in every form of arrays.
"""

import re
from dataclasses import dataclass

import numpy as np

from pipeline.recordings.events import Events

# Duration of each unit of time in seconds.
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

# Names of the arrays of events, in their order.
ARRAYS = ("x", "y", "t", "p")

# Names of fields and columns, in upper or lower case, the preferred one first; that of a time may
# end with its unit, as in t_us, timestamp_ms or time (s), and is preferred then.
COLUMN_NAMES = {
    "x": ("x", "xs", "x_pos", "pos_x", "column", "col"),
    "y": ("y", "ys", "y_pos", "pos_y", "row"),
    "t": ("t", "time", "timestamp", "ts"),
    "p": ("p", "polarity", "pol", "ps", "on"),
}

_NAME_WITH_UNIT = re.compile(r"(.+?)(?:[\s_]*[\[(]|[\s_]+)([mun\u00b5\u03bc]?s)[\])]?")

# What to write where the polarity is missing.
NO_POLARITY = (
    "add the polarity p: 1 for ON, the pressure rises, and 0 for OFF; 1 everywhere if the sensor "
    "does not tell them apart"
)

# Maximum number of events of a recording.
MAX_EVENTS = 5_000_000

# Highest coordinate of any sensor; the input of a network is smaller.
MAX_PLACE = 16_383

# Rows and columns of any sensor, after pixels were combined.
MAX_SIDE = 256

# Taxels of any sensor, since events cannot address more.
MAX_TAXELS = 65_536

# Longest duration of a recording; a time past this is taken for another unit.
MAX_DURATION_S = 60.0

# Bytes of a file.  The largest published layout is 101 rows of 200,000 columns in double precision:
# a hundred taxels that each report an event every 5 ms for 2 s, in five columns each.
MAX_FILE_BYTES = 170_000_000


class BadRecording(ValueError):
    """Raised for a file that is not a recording; the message has the reason.

    Attributes
    ----------
    event : int or None
        Index of the event that is wrong, in the order of the file.
    """

    def __init__(self, reason: str, event: int | None = None):
        super().__init__(reason)
        self.event = event


def read_limited(file) -> bytes:
    """The content of an open file, read at most up to the point at which it is too large."""
    return file.read(MAX_FILE_BYTES + 1)


def parse_writer(number) -> int:
    """The number of a writer, or -1 for None and for anything but a whole number from 0."""
    is_one = number is not None and 0 <= number < 2**31 and number == int(number)
    return int(number) if is_one else -1


@dataclass(frozen=True)
class EventRecording:
    """The events of one file or array, in order of time: what every format gives.

    Attributes
    ----------
    x, y : ndarray of int64, shape (n,)
        Column and row, from 0.  If the file numbers its taxels, ``x`` is the number and ``y`` 0.
    time : ndarray of int64 or float64, shape (n,)
        Not negative, in ``unit`` or in bins.
    polarity : ndarray of int8, shape (n,)
        1 where pressure rises (ON), -1 where it falls (OFF).
    unit : str
        One of :data:`UNITS`; empty if it is not known.
    size : (int, int) or None
        Rows and columns of the sensor, if the file has them.
    simulated : bool
        True if the file states that it is simulated.
    writer : int
        Number of the person who made the recording, from 0; -1 if the file does not have it.
    written : bool
        True if the file states that a person wrote it on the simulated sensor.
    n_taxels : int
        Number of taxels of a file that numbers them instead of having their places; else 0.
    columns : ndarray of int, shape (n,), or None
        Columns of the file that report each event (:mod:`pipeline.recordings.formats.mat`); None
        if there is one entry for each event.
    bins : (int, int) or None
        Channels and bins of an array of counts (:mod:`pipeline.recordings.formats.bins`).
    off : int or None
        Value of OFF in a file of events, 0 or -1; None if the file has no OFF, or another format.
    orders : tuple of str
        Orders of columns without names that fit the values, the one that was read first; empty if
        columns have names (:mod:`pipeline.recordings.formats.column_order`).
    table : ndarray or None
        Those columns, for another order.
    """

    x: np.ndarray
    y: np.ndarray
    time: np.ndarray
    polarity: np.ndarray
    unit: str = ""
    size: tuple | None = None
    simulated: bool = False
    writer: int = -1
    written: bool = False
    n_taxels: int = 0
    columns: np.ndarray | None = None
    bins: tuple | None = None
    off: int | None = None
    orders: tuple = ()
    table: np.ndarray | None = None

    def __post_init__(self):
        if self.layout == "numbered" and self.unit != "ns":
            raise ValueError("times of a file with numbered taxels must be in nanoseconds")

    def __len__(self):
        return len(self.polarity)

    @property
    def layout(self) -> str:
        """``"events"`` with places; ``"numbered"`` or ``"bins"`` with numbers of taxels."""
        if self.bins is not None:
            return "bins"
        return "numbered" if self.n_taxels else "events"

    def to_events(self, rows: int, time_ns: np.ndarray) -> Events:
        """The events with taxels numbered as by :meth:`pipeline.recordings.sensor.TaxelMap.grid`.

        Parameters
        ----------
        rows : int
            Number of rows of the sensor; 1 if taxels are numbered already.
        time_ns : ndarray of int64, shape (n,)
        """
        columns = np.ones(len(self)) if self.columns is None else self.columns
        return Events(time_ns, self.y + rows * self.x, self.polarity, columns)

    def to_numbered_events(self) -> Events:
        """The events of a recording with the layout ``"numbered"``."""
        return self.to_events(1, self.time)


def make_numbered_recording(
    taxel: np.ndarray,
    time_ns: np.ndarray,
    polarity: np.ndarray,
    n_taxels: int,
    columns: np.ndarray | None = None,
) -> EventRecording:
    """Make the recording of a file that numbers its taxels; its events are in order of time.

    Parameters
    ----------
    taxel : ndarray of int, shape (n,)
        Numbers of the taxels, from 0.
    time_ns : ndarray of int64, shape (n,)
        Times in nanoseconds, not negative.
    polarity : ndarray of int8, shape (n,)
        1 where pressure rises (ON), -1 where it falls (OFF).
    n_taxels : int
        Number of taxels of the sensor, the same in all of its files.  If the files do not state it,
        call :func:`make_recording` instead, with the taxels as ``x`` and 0 as ``y``.
    columns : ndarray of int, shape (n,), optional
        See :attr:`EventRecording.columns`.

    Raises
    ------
    BadRecording
        There are no events, they are not in order of time, a taxel is not one of the sensor's, a
        polarity is neither -1 nor 1, or the sensor has more taxels than events can address.
    """
    if len(taxel) == 0:
        raise BadRecording("is empty: no events")
    if n_taxels > MAX_TAXELS:
        raise BadRecording(f"has {n_taxels} taxels, more than {MAX_TAXELS}")
    if not np.isin(polarity, (-1, 1)).all():
        raise BadRecording("has a polarity that is neither -1 nor 1")
    if taxel.min() < 0 or taxel.max() >= n_taxels:
        raise BadRecording(f"has a taxel that is not from 0 to {n_taxels - 1}")
    if time_ns[0] < 0 or (np.diff(time_ns) < 0).any():
        raise BadRecording("has times that are negative or not in order")
    return EventRecording(
        x=taxel.astype(np.int64),
        y=np.zeros(len(taxel), np.int64),
        time=time_ns,
        polarity=polarity,
        unit="ns",
        n_taxels=n_taxels,
        columns=columns,
    )


def make_recording(events, size: tuple | None = None) -> EventRecording:
    """Check events and bring them into order of time.

    Parameters
    ----------
    events : structured array, array_like of shape (n, 4), dict, or sequence of four arrays
        A dict has the arrays by name; a sequence and rows of four numbers have the order x, y,
        t, p.
    size : (int, int), optional
        Rows and columns of the sensor; no event may be outside of them. A reader of files that may
        have such events sets the size afterwards, so that they are reported with the source.

    Raises
    ------
    BadRecording
        The events have another form; arrays are missing, empty, not numbers or of different
        lengths; coordinates are not whole numbers from 0, or not below the size; times are NaN or
        negative; polarities have three values; the size is not two whole numbers.
    """
    named, unit = _split_columns(events)
    arrays = {name: _convert_to_array(values, repr(name)) for name, values in named.items()}
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
    t = _convert_times(t)
    for name, coordinates in (("x", x), ("y", y)):
        outside = ~(
            (coordinates >= 0) & (coordinates <= MAX_PLACE) & (coordinates == np.floor(coordinates))
        )
        if outside.any():
            event = int(np.argmax(outside))
            raise BadRecording(
                f"has {name} {coordinates[event]:g}, not a whole number from 0 to {MAX_PLACE}",
                event,
            )
    if size is not None:
        _require_size(size)
        _require_inside(x, y, size)
    order = np.argsort(t, kind="stable")
    polarity = _convert_polarities(p)
    lowest = int(p.min())
    return EventRecording(
        np.asarray(x, np.int64)[order],
        np.asarray(y, np.int64)[order],
        time=t[order],
        polarity=polarity[order],
        unit=unit,
        size=None if size is None else (int(size[0]), int(size[1])),
        off=lowest if lowest < 1 else None,
    )


def _convert_to_array(values, name):
    """Convert values of a file, of any type, to an array."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError, OverflowError) as error:
        raise BadRecording(f"{name} is not an array of numbers") from error


def _require_size(size):
    """Refuse a size that is not two positive whole numbers."""
    sides = _convert_to_array(size, "the size")
    is_two_numbers = sides.shape == (2,) and sides.dtype.kind in "fiu"
    if not is_two_numbers or not (np.isfinite(sides) & (sides >= 1) & (sides % 1 == 0)).all():
        raise BadRecording(f"has the size {size!r}, not two whole numbers (rows, columns)")


def _require_inside(x, y, size):
    """Refuse an event outside of the sensor's rows and columns."""
    rows, columns = size
    outside = (y >= rows) | (x >= columns)
    if outside.any():
        event = int(np.argmax(outside))
        raise BadRecording(
            f"has an event at x = {x[event]:g}, y = {y[event]:g}, outside of its sensor of {rows} "
            f"rows and {columns} columns",
            event,
        )


def _convert_times(t):
    """Convert values to integers if all are whole numbers, else to floating point."""
    for is_wrong, reason in (
        (~np.isfinite(t), "has a time that is NaN or infinite"),
        (t >= 2.0**62, "has a time that no clock can have"),
        (t < 0, "has a negative time"),
    ):
        if is_wrong.any():
            raise BadRecording(reason, int(np.argmax(is_wrong)))
    is_whole = t.dtype.kind in "iub" or ((t == np.rint(t)).all() and t.max() > 0)
    return t.astype(np.int64 if is_whole else float)


def _convert_polarities(p):
    values, first = np.unique(p, return_index=True)
    if p.dtype.kind == "b" or np.isin(values, (0, 1)).all():
        return np.where(p > 0, 1, -1).astype(np.int8)
    if np.isin(values, (-1, 1)).all():
        return p.astype(np.int8)
    is_wrong = ~np.isin(values, (-1, 0, 1))
    event = int(first[is_wrong].min() if is_wrong.any() else first.max())
    which = f"{p[event]:g}" if is_wrong.any() else "-1, 0 and 1 together"
    raise BadRecording(f"has p {which}, not 1 (ON) and -1 (OFF), 1 and 0, or true and false", event)


def _split_columns(events):
    """The four arrays by name, from any form of events; and the unit of time if a name has it."""
    if isinstance(events, np.ndarray) and events.dtype.names:
        if events.ndim != 1:
            raise BadRecording(f"is a structured array of {events.ndim} dimensions, not one")
        events = {name: events[name] for name in events.dtype.names}
    if isinstance(events, dict):
        chosen = find_columns(events)
        unit = _split_unit(chosen["t"])[1]
        return {name: events[key] for name, key in chosen.items()}, unit
    is_four = isinstance(events, (tuple, list)) and len(events) == 4
    if is_four and all(isinstance(row, (list, tuple)) and len(row) == 4 for row in events):
        raise BadRecording("is four lists of four: rows or columns? give a dict of x, y, t and p")
    if is_four:
        arrays = [_convert_to_array(values, "a part of the events") for values in events]
        if all(array.ndim == 1 for array in arrays):
            return dict(zip(ARRAYS, arrays, strict=True)), ""
    rows = _convert_to_array(events, "the list of events")
    is_three = isinstance(events, (tuple, list)) and len(events) == 3
    if is_three and all(isinstance(array, np.ndarray) for array in events):
        raise BadRecording(f"is three arrays; if these are x, y and t, {NO_POLARITY}")
    if rows.ndim == 2 and rows.shape[1] == 3:
        raise BadRecording(f"has rows of three numbers; if these are x, y and t, {NO_POLARITY}")
    if rows.ndim == 2 and rows.shape[1] == 4:
        return dict(zip(ARRAYS, rows.T, strict=True)), ""
    raise BadRecording(
        f"is an array of shape {rows.shape}, not four arrays x, y, t, p, a structured array, "
        "rows of four numbers, or counts (taxels, channels, bins); in text, name more columns than "
        "these in the first line, such as t,x,y,p"
    )


def find_columns(names) -> dict:
    """The names of the columns x, y, t and p among others, by :data:`COLUMN_NAMES`.

    Raises
    ------
    BadRecording
        One is missing.
    """
    chosen = {}
    for axis, known_names in COLUMN_NAMES.items():
        candidates = [name for name in names if find_column(name) == axis]
        if not candidates:
            listed = ", ".join(str(name) for name in list(names)[:6])
            remedy = "expected x, y, t and p"
            if axis == "p":
                remedy = f"name the column of the polarity p, or {NO_POLARITY}"
            raise BadRecording(f"has no {axis!r} among {listed or 'no names'}; {remedy}")

        def rank(name, known_names=known_names):
            plain, unit = _split_unit(name)
            return not unit, known_names.index(plain)

        chosen[axis] = min(candidates, key=rank)
    return chosen


def find_column(name) -> str:
    """Which of x, y, t and p a column is, by its name; empty for none of them."""
    plain = _split_unit(name)[0]
    return next((axis for axis, known_names in COLUMN_NAMES.items() if plain in known_names), "")


def _split_unit(name):
    """A name in lower case without the unit of time at its end, and this unit."""
    lower = str(name).strip().lower()
    match = _NAME_WITH_UNIT.fullmatch(lower)
    if match is None:
        return lower, ""
    return match[1], match[2].replace("\u00b5", "u").replace("\u03bc", "u")
