"""The columns of a sensor's events, converted to nanoseconds and cells of a frame."""

from __future__ import annotations

import numpy as np

from ..errors import UserError
from .clock import MAX_TIME_NS
from .faults import Faults


class EventReader:
    """Reads events, and counts those that cannot be presented to the network.

    Parameters
    ----------
    shape : tuple of int
        (rows, columns, 2) of a frame.
    has_off : bool
        True if the network has OFF events.
    tick_ns : int
        Nanoseconds of the unit of times.
    faults : Faults
    """

    def __init__(self, shape, has_off: bool, tick_ns: int, faults: Faults):
        self._rows, self._columns = shape[:2]
        self._has_off = has_off
        self._tick_ns = tick_ns
        self._faults = faults

    def read(self, t, x, y, p):
        """Times and cells of those events that can be presented to the network.

        Parameters
        ----------
        t, x, y, p
            As for :meth:`deploy.stream.stream.Stream.push`.

        Returns
        -------
        time_ns, cell : ndarray of int64, shape (n,)
            On the sensor's clock; index of the cell of the frame.

        Raises
        ------
        UserError
            The columns differ in length.
        """
        columns = [np.atleast_1d(np.asarray(values)) for values in (t, x, y, p)]
        if len({values.shape for values in columns}) != 1 or columns[0].ndim != 1:
            shapes = ", ".join(str(values.shape) for values in columns)
            raise UserError(f"events: t, x, y and p have the shapes {shapes}; give equal lengths")
        time_ns, is_valid = self.convert_to_ns(columns[0])
        x, y, p = map(_convert_to_numbers, columns[1:])
        readable = is_valid & np.isfinite(x) & np.isfinite(y) & np.isfinite(p)
        inside = (x >= 0) & (x < self._columns) & (y >= 0) & (y < self._rows)
        is_on = p == 1
        has_polarity = is_on | (((p == 0) | (p == -1)) & self._has_off)
        can_present = readable & inside & has_polarity
        if not can_present.all():
            self._faults.record("unreadable", int(np.sum(~readable)))
            self._faults.record("outside", int(np.sum(readable & ~inside)))
            self._faults.record("polarity", int(np.sum(readable & inside & ~has_polarity)))
            time_ns = time_ns[can_present]
            x = x[can_present]
            y = y[can_present]
            is_on = is_on[can_present]
        pixel = y.astype(np.int64) * self._columns + x.astype(np.int64)
        return time_ns, 2 * pixel + ~is_on

    def find_cell(self, x, y, p):
        """The cell of one event with the rules of :meth:`read`, in the shortest time.

        Returns
        -------
        int or None
            None if the event is outside the sensor, or of another polarity.
        """
        inside = 0 <= x < self._columns and 0 <= y < self._rows
        is_on = p == 1
        if not inside or not (is_on or (self._has_off and p in (0, -1))):
            return None
        return 2 * (int(y) * self._columns + int(x)) + (not is_on)

    def convert_to_ns(self, t):
        """Times as int64 nanoseconds, and which of them are numbers in the range."""
        t = np.asarray(t)
        if t.dtype.kind in "iu":
            is_valid = np.abs(t.astype(float)) < MAX_TIME_NS / self._tick_ns
            return np.where(is_valid, t, 0).astype(np.int64) * self._tick_ns, is_valid
        with np.errstate(over="ignore"):  # an infinite time is not in the range
            time_ns = self._tick_ns * _convert_to_floats(t)
        is_valid = np.abs(time_ns) < MAX_TIME_NS  # False for NaN
        return np.rint(np.where(is_valid, time_ns, 0)).astype(np.int64), is_valid


def _convert_to_numbers(values):
    """Numbers as they are, and all others as floats."""
    return values if values.dtype.kind in "iub" else _convert_to_floats(values)


def _convert_to_floats(values):
    """Numbers as floats; NaN for what is no number."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError, OverflowError):
        return np.array([_convert_to_float(value) for value in np.ravel(values)])


def _convert_to_float(value):
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return np.nan
