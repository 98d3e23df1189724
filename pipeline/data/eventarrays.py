"""Events of one recording as arrays, in the conventions of event cameras: x, y, t, p.

``x`` is the column from the left and ``y`` the row from the top, whole numbers from 0; ``p`` is the
polarity, as truth values, 0 and 1, or -1 and 1; ``t`` is the time in seconds, milliseconds,
microseconds or nanoseconds.  If the unit is not specified, :mod:`pipeline.data.timeunits`
infers it.  Events may be four arrays, one structured array with fields of these names (as in
Tonic), or rows of four numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.data.events import Events
from pipeline.data.matfile import BadRecording
from pipeline.data.timeunits import UNITS

ARRAYS = ("x", "y", "t", "p")

NAMES = {
    "x": ("x", "column", "col"),
    "y": ("y", "row"),
    "t": (*(f"t_{unit}" for unit in UNITS), "t", "time", "timestamp", "ts"),
    "p": ("p", "polarity", "pol", "on"),
}
"""Names of fields and columns, in upper or lower case, the preferred one first; some include the
unit."""

MAX_EVENTS = 5_000_000
"""Events of one recording."""

MAX_PLACE = 16_383
"""Highest coordinate of any sensor; the input of a network is smaller."""

ROW_ORDERS = ("xytp", "xypt", "txyp")
"""Orders of columns in rows of four numbers: Tonic's, that of Tonic's DVS Gesture, DV's."""


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
        One of :data:`pipeline.data.timeunits.UNITS`; empty if it is not known.
    size : (int, int) or None
        Rows and columns of the sensor, if the file has them.
    simulated : bool
        True if the file states that it is simulated.
    writer : int
        Number of the person who made the recording, from 0; -1 if the file does not have it.
    from_start : bool
        True if times are known to be relative to the recording's start, as in a part of a file.
    """

    x: np.ndarray
    y: np.ndarray
    time: np.ndarray
    polarity: np.ndarray
    unit: str = ""
    size: tuple | None = None
    simulated: bool = False
    writer: int = -1
    from_start: bool = False

    def events(self, rows: int, time_ns: np.ndarray) -> Events:
        """The events with taxels numbered as by :meth:`pipeline.data.events.TaxelMap.grid`.

        Parameters
        ----------
        rows : int
            Number of rows of the sensor.
        time_ns : ndarray of int64, shape (n,)
            From :func:`pipeline.data.timeunits.to_ns`.
        """
        taxel = self.y + rows * self.x
        return Events(time_ns, taxel, self.polarity, np.ones(len(taxel)))


def recording_of(events, unit: str = "", most: int = MAX_EVENTS) -> EventRecording:
    """Check events and bring them into order of time.

    Parameters
    ----------
    events : structured array, array_like of shape (n, 4), dict, or sequence of four arrays
        A dict has the arrays by name, a sequence in the order x, y, t, p.  The
        order of rows of four numbers is inferred from the values, see :data:`ROW_ORDERS`.
    unit : str
        Unit of the times; empty if it is not known.
    most : int
        Maximum number of events.

    Raises
    ------
    BadRecording
        The events have another form; arrays are missing, empty, not numbers or of different
        lengths; coordinates are not whole numbers from 0; times are NaN or negative; polarities
        have three values.
    """
    named, said = _named(events)
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
    if max(lengths) > most:
        raise BadRecording(f"has {max(lengths)} events, more than {most}")
    x, y, t, p = (arrays[name] for name in ARRAYS)
    t = _times(t)
    for name, places in (("x", x), ("y", y)):
        outside = ~(places >= 0) | ~(places <= MAX_PLACE) | (places != np.floor(places))
        if outside.any():
            raise BadRecording(
                f"{name} has {places[outside][0]:g}, not whole numbers from 0 to {MAX_PLACE}"
            )
    order = np.argsort(t, kind="stable")
    return EventRecording(
        *(np.asarray(places, np.int64)[order] for places in (x, y)),
        time=t[order],
        polarity=_polarity(p)[order],
        unit=said or unit,
    )


def _times(t):
    """Convert values to integers if all are whole numbers, else to floating point."""
    if t.dtype.kind == "u" and t.dtype.itemsize == 8 and (t > np.uint64(2**63 - 1)).any():
        raise BadRecording("has a time past every clock's")
    if t.dtype.kind in "iub":
        t = t.astype(np.int64)
    else:
        t = t.astype(float)
        if not np.isfinite(t).all():
            raise BadRecording("has a time that is NaN or infinite")
        if np.abs(t).max() >= 2.0**62:
            raise BadRecording("has a time past every clock's")
        if (t == np.rint(t)).all() and t.max() > 0:
            t = t.astype(np.int64)
    if t.min() < 0:
        raise BadRecording("has a negative time")
    return t


def _polarity(p):
    values = np.unique(p).tolist()
    if p.dtype.kind == "b" or set(values) <= {0, 1}:
        return np.where(p > 0, 1, -1).astype(np.int8)
    if set(values) <= {-1, 1}:
        return p.astype(np.int8)
    wrong = next((value for value in values if value not in (-1, 0, 1)), None)
    found = "-1, 0 and 1 together" if wrong is None else f"{wrong:g}"
    raise BadRecording(f"p has {found}, not 1 (ON) and -1 (OFF), 1 and 0, or true and false")


def _named(events):
    """The four arrays by name, from any form of events; and the unit of time if it is given."""
    if isinstance(events, np.ndarray) and events.dtype.names:
        if events.ndim != 1:
            raise BadRecording(f"is a structured array of {events.ndim} dimensions, not one")
        events = {name: events[name] for name in events.dtype.names}
    if isinstance(events, dict):
        chosen = by_name(events)
        unit = str(chosen["t"]).strip().lower().partition("t_")[2]
        return {name: events[key] for name, key in chosen.items()}, unit
    is_four = isinstance(events, (tuple, list)) and len(events) == 4
    if is_four and all(np.ndim(part) == 1 for part in events):
        return dict(zip(ARRAYS, events, strict=True)), ""
    rows = np.asarray(events)
    if rows.ndim == 2 and rows.shape[1] == 4:
        return dict(zip(_order_of(rows), rows.T, strict=True)), ""
    raise BadRecording(
        f"is an array of shape {rows.shape}, not four arrays x, y, t, p, a structured array or "
        "rows of four numbers"
    )


def by_name(names) -> dict:
    """The names of the columns x, y, t and p among others; :data:`NAMES` has the alternatives.

    Raises
    ------
    BadRecording
        One is missing.
    """
    lower = {str(name).strip().lower(): name for name in names}
    chosen = {}
    for name, others in NAMES.items():
        key = next((other for other in others if other in lower), None)
        if key is None:
            raise BadRecording(f"has no array {name!r}; expected x, y, t and p")
        chosen[name] = lower[key]
    return chosen


def _order_of(rows):
    """Determine the order of the columns: the first one that the numbers allow."""
    if rows.dtype.kind not in "fiub" or rows.dtype.itemsize > 8 or not len(rows):
        return "xytp"
    flags = [set(np.unique(column[:1000]).tolist()) <= {-1, 0, 1} for column in rows.T]
    rising = [bool((np.diff(column.astype(float)) >= 0).all()) for column in rows.T]
    for order in ROW_ORDERS:
        if flags[order.index("p")] and rising[order.index("t")]:
            return order
    return "xytp"
