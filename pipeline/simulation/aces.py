"""ACES: all taxels share one wire, each event is a pulse signature, and a decoder separates them.

Asynchronously Coded Electronic Skin (W. W. Lee et al., "A neuro-inspired artificial peripheral
nervous system for scalable electronic skins", Science Robotics 4, 2019; paper, Section 2.1).  A
taxel sends a few short pulses at delays that identify it, without synchronisation.  Signatures may
overlap on the wire.  The decoder samples the wire on a 16 ns grid and correlates it with each
taxel's signature at every tick.

Unpublished properties are inferred from one real recording: its events come as bursts of 2 or 3
ticks when the pressure rises (-1 in the files) and of 4 or 5 when it falls (+1), with nearly equal
frequencies.  A correlator reports such bursts if the pulses of a rise are about 39 ns wide and
those of a fall about 71 ns.  The width thus encodes the polarity, and the length of a burst depends
on the time of the event relative to the grid.
"""

import numpy as np

from pipeline.recordings.events import TICK_NS, Events


def make_bursts(time_ns, taxel, polarity, parameters) -> Events:
    """The decoder's reports without losses on the wire, computed directly.

    An event at ``t`` with pulses of width ``w`` is reported at every tick from ``t`` to just before
    ``t + w``.

    Parameters
    ----------
    time_ns : ndarray of float, shape (n,)
        Times, not rounded to the grid.
    taxel, polarity : ndarrays of int, shape (n,)
    parameters : section ``[aces]`` of ``parameters.toml``

    Returns
    -------
    Events
        In order of time, no two in the same tick.
    """
    first, columns = find_ticks(time_ns, polarity, parameters)
    return queue_bursts(first, taxel, polarity, columns)


class Decoder:
    """:func:`make_bursts` for events that arrive in parts.

    Parameters
    ----------
    parameters : section ``[aces]`` of ``parameters.toml``
    """

    def __init__(self, parameters):
        self._parameters = parameters
        self._free = 0
        self._waiting = np.empty(0), np.empty(0, int), np.empty(0, int)

    def advance(self, time_ns, taxel, polarity, until_ns) -> Events:
        """Reports of the events up to a time; later events wait for the next call.

        Parameters
        ----------
        time_ns, taxel, polarity
            As in :func:`make_bursts`; not before ``until_ns`` of the previous call.
        until_ns : float
        """
        every = [
            np.concatenate([old, new])
            for old, new in zip(self._waiting, (time_ns, taxel, polarity), strict=True)
        ]
        first, columns = find_ticks(every[0], every[2], self._parameters)
        due = first < np.ceil(until_ns / TICK_NS)
        self._waiting = tuple(values[~due] for values in every)
        events = queue_bursts(first[due], every[1][due], every[2][due], columns[due], self._free)
        if len(events):
            self._free = int(events.time_ns[-1]) // TICK_NS + int(events.columns[-1])
        return events


def find_ticks(time_ns, polarity, parameters):
    """First tick and number of ticks at which a pulse sent at ``time_ns`` is high."""
    width = np.where(np.asarray(polarity) > 0, parameters.rise_ns, parameters.fall_ns)
    first = np.ceil(np.asarray(time_ns) / TICK_NS).astype(np.int64)
    return first, np.ceil((time_ns + width) / TICK_NS).astype(np.int64) - first


def queue_bursts(tick, taxel, polarity, columns, free=0) -> Events:
    """Events in order of time; one that would start within another's burst waits for its end.

    In the published arrays no two taxels report in the same tick.  ``free`` is the first tick after
    all earlier bursts.
    """
    order = np.lexsort((taxel, tick))
    tick = np.asarray(tick)[order]
    columns = np.asarray(columns)[order]
    before = np.cumsum(columns) - columns
    tick = before + np.maximum(np.maximum.accumulate(tick - before), free)
    return Events(tick * TICK_NS, np.asarray(taxel)[order], np.asarray(polarity)[order], columns)
