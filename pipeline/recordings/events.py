"""Physical events as columns, one row per event, and the columns of the published files.

The published files hold one column per decoder tick.  The ACES decoder reports one physical event
in several consecutive ticks (16 ns apart), so :func:`merge_bursts` merges these and stores the
number of columns with each event; :func:`expand_bursts` is its inverse.
"""

from dataclasses import dataclass

import numpy as np

# Period of the decoder's time grid in nanoseconds: 62.5 MHz, which the paper rounds to 63 MHz.
TICK_NS = 16


@dataclass(frozen=True)
class Events:
    """Physical events of one recording, in order of time.

    Attributes
    ----------
    time_ns : ndarray of int64, shape (n,)
        Time of the first tick of each event, in nanoseconds from the start of the recording.
    taxel : ndarray of uint16, shape (n,)
        Row index in ``spiketrain``, which is the taxel address minus one, 0 to 99.
    polarity : ndarray of int8, shape (n,)
        1 for ON (pressure rises), -1 for OFF (pressure falls); ST-MNIST's files have the opposite
        signs, see :mod:`pipeline.recordings.formats.mat`.
    columns : ndarray of uint16, shape (n,)
        Number of columns of ``spiketrain`` of the event, at least 1.
    """

    time_ns: np.ndarray
    taxel: np.ndarray
    polarity: np.ndarray
    columns: np.ndarray

    def __post_init__(self):
        for name, dtype in EVENT_DTYPES.items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype))
        if len({getattr(self, name).shape for name in EVENT_DTYPES}) != 1 or self.time_ns.ndim != 1:
            raise ValueError("Events: the four columns must be one-dimensional and equally long")

    def __len__(self):
        return len(self.time_ns)


EVENT_DTYPES = {"time_ns": np.int64, "taxel": np.uint16, "polarity": np.int8, "columns": np.uint16}


def join_events(by_recording) -> Events:
    """Join a list of events, in this order."""
    if not by_recording:
        return Events(*(np.empty(0, dtype) for dtype in EVENT_DTYPES.values()))
    return Events(
        time_ns=np.concatenate([events.time_ns for events in by_recording]),
        taxel=np.concatenate([events.taxel for events in by_recording]),
        polarity=np.concatenate([events.polarity for events in by_recording]),
        columns=np.concatenate([events.columns for events in by_recording]),
    )


def merge_bursts(time_ns, taxel, polarity) -> Events:
    """Join decoder ticks that report the same physical event.

    Columns belong to one event if they are adjacent in the file, exactly one tick
    (16 ns) apart, with the same taxel and polarity.

    Parameters
    ----------
    time_ns, taxel, polarity : array_like, shape (n_columns,)
        In increasing order of time.

    Returns
    -------
    Events
    """
    time_ns, taxel, polarity = (np.asarray(a) for a in (time_ns, taxel, polarity))
    if len(time_ns) == 0:
        return Events(time_ns, taxel, polarity, np.empty(0, np.uint16))
    new = np.ones(len(time_ns), bool)
    new[1:] = (
        (np.diff(time_ns) != TICK_NS) | (taxel[1:] != taxel[:-1]) | (polarity[1:] != polarity[:-1])
    )
    first = np.flatnonzero(new)
    columns = np.diff(np.append(first, len(time_ns)))
    return Events(time_ns[first], taxel[first], polarity[first], columns)


def expand_bursts(events: Events):
    """The inverse of :func:`merge_bursts`: one row per decoder tick.

    Returns
    -------
    time_ns, taxel, polarity : ndarrays, shape (n_columns,)
    """
    repeats = events.columns.astype(np.int64)
    start = np.repeat(np.cumsum(repeats) - repeats, repeats)
    tick = np.arange(repeats.sum()) - start
    return (
        np.repeat(events.time_ns, repeats) + TICK_NS * tick,
        np.repeat(events.taxel, repeats),
        np.repeat(events.polarity, repeats),
    )
