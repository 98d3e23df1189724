"""Events that alone decide how large a sensor is: a hot pixel, or a damaged line of one file.

A size that no file states is that of the events' places, so one wrong coordinate makes the sensor
of all recordings larger.
"""

from dataclasses import dataclass

import numpy as np

# A size is decided by few recordings if no others have events as far out as this share of them,
# and by few events if this share lies further out.
MAX_STRAY_RECORDING_SHARE = 0.01
MAX_STRAY_EVENT_SHARE = 0.001

# Factor by which strays enlarge a sensor, at least, unless a row or column before them is empty.
MIN_STRAY_FACTOR = 1.25

# Recordings from which on one of them can differ from all others.
MIN_RECORDINGS = 3


@dataclass(frozen=True)
class Strays:
    """Events far from all others along one axis.

    Attributes
    ----------
    recordings : tuple of int
        Indices of the recordings that have them.
    n_events : int
        Number of these events.
    size : int
        Rows or columns of the sensor without them.
    highest : int
        Highest of their coordinates.
    """

    recordings: tuple
    n_events: int
    size: int
    highest: int


def find_strays(coordinates, stated_size: int = 0) -> Strays | None:
    """Find few events, or those of few recordings, that alone make a sensor larger.

    Parameters
    ----------
    coordinates : list of ndarray of int
        Rows or columns of the events of each recording.
    stated_size : int
        Rows or columns that files state; 0 if none does.

    Returns
    -------
    Strays or None
        None if the others make the sensor about as large.
    """
    if len(coordinates) < MIN_RECORDINGS:
        return None
    counts = np.bincount(np.concatenate(coordinates))
    reach = np.array([each.max() + 1 for each in coordinates])
    size = max(len(counts), stated_size)
    typical_size = max(
        min(_find_size_of_most_events(counts), _find_size_of_most_recordings(reach)), stated_size
    )
    if typical_size >= size:
        return None
    is_filled = (counts[counts.nonzero()[0][0] : typical_size] > 0).all()
    is_apart = is_filled and counts[typical_size] == 0
    if size < MIN_STRAY_FACTOR * typical_size and not is_apart:
        return None
    return Strays(
        recordings=tuple(np.flatnonzero(reach > typical_size).tolist()),
        n_events=int(counts[typical_size:].sum()),
        size=typical_size,
        highest=size - 1,
    )


def _find_size_of_most_events(counts):
    """The smallest size that leaves out only few events, by the number of events at each place."""
    beyond = counts.sum() - np.cumsum(counts)
    return int(np.argmax(beyond <= max(MAX_STRAY_EVENT_SHARE * counts.sum(), 1))) + 1


def _find_size_of_most_recordings(reach):
    """The smallest size that leaves out only few recordings, by the size that each needs."""
    few = max(int(MAX_STRAY_RECORDING_SHARE * len(reach)), 1)
    return int(np.sort(reach)[-1 - few])
