"""The times of a sensor's events: conversion, order, and faults of its clock."""

from __future__ import annotations

from typing import List, Optional, Tuple

import numpy as np

from .faults import Faults

_Event = Tuple[int, int]  # time and cell

# Nanoseconds of each unit of time.
UNIT_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

# Time by which an event may be out of order; further back, it has a wrong time, or the sensor's
# clock has jumped.
MAX_DISORDER_NS = 1_000_000_000

# Largest time that is accepted, about 146 years: sums of two fit into 64 bits.
MAX_TIME_NS = 1 << 62


class SensorClock:
    """The time of a stream, which never goes back, from the times of a sensor's events.

    If an event is far from all events before it, its time is wrong, there was silence, or the clock
    has jumped.  It waits until the next event or :meth:`advance` tells which:

    - if the next time is near that of the waiting event, there was silence, or the clock has jumped
      back; after a jump, the stream's time continues without one;
    - if the next time is near those before, the time of the waiting event is wrong, and the event
      is used at the present time.

    Parameters
    ----------
    silence_ns : float
        Time without events after which an event waits.
    faults : Faults

    Attributes
    ----------
    now_ns : int or None
        The latest time of the stream, of an event or of :meth:`advance`; None before both.
    latest_ns : int or None
        Time of the latest event.  It may be before ``now_ns`` without a fault, because events need
        time to arrive.
    """

    def __init__(self, silence_ns: float, faults: Faults):
        self._silence_ns = silence_ns
        self._faults = faults
        self._offset_ns = 0  # from the sensor's time to the stream's
        self._waiting: Optional[_Event] = None  # at the sensor's time
        self._advanced_ns: Optional[int] = None  # the stream's time of the last call of `advance`
        self.now_ns: Optional[int] = None
        self.latest_ns: Optional[int] = None

    def to_sensor_time(self, stream_ns: float) -> float:
        """Convert a time of the stream to the sensor's."""
        return stream_ns - self._offset_ns

    def to_stream_time(self, sensor_ns: int) -> int:
        """Convert a time of the sensor to the stream's, if its clock has not jumped."""
        return sensor_ns + self._offset_ns

    def is_next(self, stream_ns: int) -> bool:
        """True if an event at this time follows the events before it without silence."""
        if self._waiting is not None or self.latest_ns is None or stream_ns < self.latest_ns:
            return False
        assert self.now_ns is not None  # set with the time of the latest event
        return -MAX_DISORDER_NS <= stream_ns - self.now_ns <= self._silence_ns

    def note(self, stream_ns: int):
        """Take the time of an event for which :meth:`is_next` is true."""
        self.latest_ns = stream_ns
        self._move_to(stream_ns)

    def order(self, time_ns, cell):
        """Convert the times of events, whose order is that of their arrival.

        Parameters
        ----------
        time_ns : ndarray of int64, shape (n,)
            Time of each event on the sensor's clock.
        cell : ndarray of int64, shape (n,)
            Any number for each event.

        Returns
        -------
        time_ns, cell : ndarray of int64, shape (m,)
            The events in order of the stream's time, without the one that waits now and with one
            that waited before.
        """
        if self._are_regular(time_ns):
            time_ns = time_ns + self._offset_ns
            self.note(int(time_ns[-1]))
            return time_ns, cell
        released: List[_Event] = []
        for time, number in zip(time_ns.tolist(), cell.tolist()):
            self._take(time, number, released)
        return _sort(released)

    def advance(self, time_ns: int):
        """Say what time it is on the sensor's clock.

        Returns
        -------
        time_ns, cell : ndarray of int64
            The event that waited, unless it waits on.
        """
        released: List[_Event] = []
        if self._waiting is not None:
            self._release(time_ns, released)
        now_ns = time_ns + self._offset_ns
        if self._advanced_ns is not None and now_ns < self._advanced_ns - MAX_DISORDER_NS:
            self._faults.record("jump")
            self._offset_ns += self._advanced_ns - now_ns
            now_ns = self._advanced_ns
        self._advanced_ns = now_ns
        self._move_to(now_ns)
        return _sort(released)

    def advance_quietly(self, stream_ns: int) -> bool:
        """As :meth:`advance`, in a short time, if the clock continues and no event waits.

        Returns
        -------
        bool
            False if it does not; nothing has been done then.
        """
        if self._waiting is not None or self._advanced_ns is None or stream_ns < self._advanced_ns:
            return False
        self._advanced_ns = stream_ns
        self._move_to(stream_ns)
        return True

    def release(self):
        """Return the event that waits, at its own time; no other will follow."""
        released: List[_Event] = []
        if self._waiting is not None:
            self._release(self._waiting[0], released)
        return _sort(released)

    def _move_to(self, stream_ns: int):
        """Set the present time, unless it is later already."""
        self.now_ns = stream_ns if self.now_ns is None else max(self.now_ns, stream_ns)

    def _are_regular(self, time_ns):
        """True if no event is out of order, and none follows silence."""
        if not self.is_next(int(time_ns[0]) + self._offset_ns):
            return False
        steps = np.diff(time_ns)
        return steps.min(initial=0) >= 0 and steps.max(initial=0) <= self._silence_ns

    def _take(self, time_ns, cell, released):
        if self._waiting is not None:
            self._release(time_ns, released)
        if self.now_ns is None:
            self.now_ns = time_ns + self._offset_ns
        ahead_ns = time_ns + self._offset_ns - self.now_ns
        if ahead_ns > self._silence_ns or ahead_ns < -MAX_DISORDER_NS:
            self._waiting = time_ns, cell
            return
        if self.latest_ns is not None and self.now_ns + ahead_ns < self.latest_ns:
            self._faults.record("late")
        self._use(self.now_ns + ahead_ns, cell, released)

    def _release(self, next_ns, released):
        """Use the event that waits, at a time that depends on the next time of the sensor."""
        time_ns, cell = self._waiting
        self._waiting = None
        ahead_ns = time_ns + self._offset_ns - self.now_ns
        is_near_waiting = abs(next_ns - time_ns) <= abs(next_ns + self._offset_ns - self.now_ns)
        if not is_near_waiting:
            self._faults.record("future" if ahead_ns > 0 else "late")
        elif ahead_ns < 0:
            self._faults.record("jump")
            self._offset_ns -= ahead_ns
        else:
            self.now_ns += ahead_ns
        self._use(self.now_ns, cell, released)

    def _use(self, stream_ns, cell, released):
        released.append((stream_ns, cell))
        self.note(stream_ns if self.latest_ns is None else max(stream_ns, self.latest_ns))


def _sort(events):
    """Events as two arrays, in order of time; those of the same time stay in their order."""
    table = np.array(events, np.int64).reshape(-1, 2)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], table[:, 1]
