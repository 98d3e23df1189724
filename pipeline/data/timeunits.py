"""The time unit of recordings: set by the user, defined by the file, or inferred."""

from __future__ import annotations

import numpy as np

from pipeline.data.matfile import LATEST_S

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Duration of each unit in seconds."""

UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

SHORTEST_S = 0.02
"""Minimum duration of a recording of a gesture or a saccade, in seconds; a unit with which most
recordings would be shorter is excluded."""

MIXED = 100
"""Factor between durations above which their units differ; units differ by a factor of 1,000."""


def span_of(time) -> float:
    """The time from the first event to the last."""
    return float(time[-1] - time[0])


def recognised(times) -> str:
    """The unit of recordings, inferred from their duration.

    Times with fractions are seconds if they are as short as recordings are.  Whole numbers are
    taken for the longest unit in which the recordings last at most a minute.

    Parameters
    ----------
    times : sequence of ndarray
        Times of each recording, in order.

    Returns
    -------
    str
        One of :data:`UNITS`, or empty if none fits.
    """
    spans = np.array([span_of(time) for time in times])
    spans = spans[spans > 0]
    if not len(spans):
        return "s" if all(time[-1] <= LATEST_S for time in times) else ""
    typical = float(np.median(spans))
    whole = all(time.dtype.kind == "i" for time in times)
    for unit, seconds in UNITS.items():
        if unit == "s" and whole:
            continue  # no sensor has times in whole seconds
        if SHORTEST_S <= typical * seconds <= LATEST_S:
            return unit
    return "s" if not whole and typical <= LATEST_S else ""


def of_other_units(times) -> list:
    """Indices of recordings whose times cannot be in the unit of the others.

    Recordings with a single event have no duration, and fit any unit.
    """
    spans = np.array([span_of(time) for time in times])
    some = np.flatnonzero(spans > 0)
    if len(some) < 2:
        return []
    typical = np.median(spans[some])
    ratio = spans[some] / typical
    return some[(ratio > MIXED) | (ratio < 1 / MIXED)].tolist()


def of_a_clock(times, unit: str) -> bool:
    """True if the times of recordings are a running clock's, not relative to their start.

    A camera's clock starts when it is switched on, or in 1970.  One recording that starts later
    than the longest one lasts, or that ends later than any can last, shows that the recordings
    were cut from a longer one, also those from its first minute.

    Parameters
    ----------
    times : sequence of ndarray
        Times of each recording, in order.
    unit : str
    """
    first, last = (max((float(time[i]) for time in times), default=0) for i in (0, -1))
    longest = max(map(span_of, times), default=0)
    return last * UNITS[unit] > LATEST_S or first > longest > 0


def to_ns(time: np.ndarray, unit: str, from_first: bool = False) -> np.ndarray:
    """Times in nanoseconds.

    Parameters
    ----------
    time : ndarray
        In order.
    unit : str
    from_first : bool
        True for times relative to the first event; see :func:`of_a_clock`.
    """
    if from_first:
        time = time - time[0]
    if time.dtype.kind == "i":
        return time * round(UNITS[unit] * 1e9)
    return np.rint(time * UNITS[unit] * 1e9).astype(np.int64)
