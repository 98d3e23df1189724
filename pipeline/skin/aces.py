"""ACES: all taxels share one wire, each event is a pulse signature, and a decoder separates them.

Asynchronously Coded Electronic Skin (W. W. Lee et al., "A neuro-inspired artificial peripheral
nervous system for scalable electronic skins", Science Robotics 4, 2019; paper, Section 2.1).  A
taxel sends a few short pulses at delays that identify it, without synchronisation.  Signatures may
overlap on the wire.  The decoder samples the wire on a 16 ns grid and correlates it with each
taxel's signature at every tick.

Unpublished properties are inferred from the one available recording: its events come as bursts of 4
or 5 ticks (ON) or 2 or 3 (OFF), with nearly equal frequencies.  A correlator reports such bursts if
the pulses of an ON event are about 71 ns wide and those of an OFF event about 39 ns.  The width
thus encodes the polarity, and the length of a burst depends on the time of the event relative to
the grid.
"""

from __future__ import annotations

import functools

import numpy as np

from pipeline.data.events import N_TAXELS, TICK_NS, Events

# Seed of the random search for signatures: a property of the hardware, not of a data set.
SIGNATURE_SEED = 2020

# Ticks after which a taxel's reports can no longer belong to the same event.
LONGEST_BURST = 6

# Number of pulses that are correlated at every tick; the others only where these are found.
FIRST_LOOK = 4


@functools.cache
def signatures(pulses: int, length_s: float, most_shared: int) -> np.ndarray:
    """Draw a signature for each taxel.

    Random delays are accepted if at most ``most_shared`` pulses coincide with those of each
    accepted signature, at any offset.

    Parameters
    ----------
    pulses : int
        Number of pulses of a signature.
    length_s : float
        Maximum time from the first pulse to the end of the last one.
    most_shared : int

    Returns
    -------
    ndarray of int64, shape (100, pulses)
        Delays in ticks, the first 0, increasing.
    """
    rng = np.random.default_rng(SIGNATURE_SEED)
    ticks = round(length_s * 1e9 / TICK_NS)
    kept = []
    while len(kept) < N_TAXELS:
        rest = np.sort(rng.choice(np.arange(2 * LONGEST_BURST, ticks), pulses - 1, replace=False))
        new = np.concatenate([[0], rest])
        if np.diff(new).min() > 2 * LONGEST_BURST and all(
            _most_shared(new, other) <= most_shared for other in [*kept, new]
        ):
            kept.append(new)
    return np.array(kept)


def _most_shared(one, other):
    """Number of coinciding pulses of two signatures at the worst offset within a burst's length."""
    gaps = np.subtract.outer(one, other).ravel()
    gaps = np.sort(gaps[gaps != 0] if one is other else gaps)
    return int((np.searchsorted(gaps, gaps + LONGEST_BURST) - np.arange(len(gaps))).max())


def bursts(time_ns, taxel, polarity, p) -> Events:
    """The decoder's reports without losses on the wire, computed directly.

    An event at ``t`` with pulses of width ``w`` is reported at every tick from ``t`` to just before
    ``t + w``.

    Parameters
    ----------
    time_ns : ndarray of float, shape (n,)
        Times, not rounded to the grid.
    taxel, polarity : ndarrays of int, shape (n,)
    p : pipeline.skin.parameters.Aces

    Returns
    -------
    Events
        In order of time, no two in the same tick.
    """
    first, columns = _ticks(time_ns, polarity, p)
    return in_turn(first, taxel, polarity, columns)


class Decoder:
    """:func:`bursts` for events that arrive in parts.

    Parameters
    ----------
    p : pipeline.skin.parameters.Aces
    """

    def __init__(self, p):
        self._p, self._free = p, 0
        self._waiting = np.empty(0), np.empty(0, int), np.empty(0, int)

    def advance(self, time_ns, taxel, polarity, until_ns) -> Events:
        """Reports of the events up to a time; later events wait for the next call.

        Parameters
        ----------
        time_ns, taxel, polarity
            As in :func:`bursts`; not before ``until_ns`` of the previous call.
        until_ns : float
        """
        every = [
            np.concatenate([old, new])
            for old, new in zip(self._waiting, (time_ns, taxel, polarity), strict=True)
        ]
        first, columns = _ticks(every[0], every[2], self._p)
        due = first < np.ceil(until_ns / TICK_NS)
        self._waiting = tuple(values[~due] for values in every)
        events = in_turn(first[due], every[1][due], every[2][due], columns[due], self._free)
        if len(events):
            self._free = int(events.time_ns[-1]) // TICK_NS + int(events.columns[-1])
        return events


def _ticks(time_ns, polarity, p):
    """First tick and number of ticks at which a pulse sent at ``time_ns`` is high."""
    width = np.where(np.asarray(polarity) > 0, p.on_ns, p.off_ns)
    first = np.ceil(np.asarray(time_ns) / TICK_NS).astype(np.int64)
    return first, np.ceil((time_ns + width) / TICK_NS).astype(np.int64) - first


def in_turn(tick, taxel, polarity, columns, free=0) -> Events:
    """Events in order of time; one that would start within another's burst waits for its end.

    In the published arrays no two taxels report in the same tick.  ``free`` is the first tick after
    all earlier bursts.
    """
    order = np.lexsort((taxel, tick))
    tick, columns = np.asarray(tick)[order], np.asarray(columns)[order]
    before = np.cumsum(columns) - columns
    tick = before + np.maximum(np.maximum.accumulate(tick - before), free)
    return Events(tick * TICK_NS, np.asarray(taxel)[order], np.asarray(polarity)[order], columns)


def encode(time_ns, taxel, polarity, p, start_ns, n_ticks) -> np.ndarray:
    """The sum of all signatures on the wire, sampled on the grid, without noise.

    Parameters
    ----------
    time_ns, taxel, polarity
        As in :func:`bursts`.
    p : pipeline.skin.parameters.Aces
    start_ns : int
        Time of the first sample, on the grid.
    n_ticks : int
        Pulses outside these samples are lost.

    Returns
    -------
    ndarray of float32, shape (n_ticks,)
        In heights of a pulse.
    """
    delays = signatures(p.pulses, p.signature_s, p.most_shared)[np.asarray(taxel, int)]
    wire = np.zeros(n_ticks, np.float32)
    for first, columns, delay in zip(*_ticks(time_ns, polarity, p), delays, strict=True):
        ticks = (first + delay - start_ns // TICK_NS)[:, None] + np.arange(columns)
        wire[ticks[(ticks >= 0) & (ticks < n_ticks)]] += 1  # its pulses do not overlap
    return wire


def decode(wire, p, start_ns) -> Events:
    """Decode which taxel fired at which time from the samples of the wire.

    Each sample is limited to a pulse's height, so that overlapping signatures do not cause false
    events; then the wire is correlated with every signature at every tick.  Consecutive
    ticks with at least ``p.level`` pulses are one event, whose length determines ON or OFF.

    Parameters
    ----------
    wire : ndarray of float32, shape (n_ticks,)
    p : pipeline.skin.parameters.Aces
    start_ns : int
        Time of the first sample, on the grid.

    Returns
    -------
    Events
        Those whose whole signature lies within the samples.
    """
    wire = np.clip(wire, 0, 1)
    found = []
    for taxel, delays in enumerate(signatures(p.pulses, p.signature_s, p.most_shared)):
        n = len(wire) - delays[-1]
        # The first pulses alone rule out nearly every tick, as each adds at most 1.
        first = sum(wire[delay : delay + n] for delay in delays[:FIRST_LOOK])
        ticks = np.flatnonzero(first >= p.level - (p.pulses - FIRST_LOOK))
        ticks = ticks[wire[ticks[:, None] + delays].sum(axis=1) >= p.level]
        if len(ticks) == 0:
            continue
        bounds = np.flatnonzero(np.diff(ticks) > 2) + 1
        begin = ticks[np.concatenate([[0], bounds])]
        length = ticks[np.concatenate([bounds, [len(ticks)]]) - 1] - begin + 1
        whole = length >= p.shortest
        found.append((begin[whole], np.full(whole.sum(), taxel), length[whole]))
    if not found:
        return in_turn(*(np.empty(0, int),) * 4)
    begin, taxel, length = (np.concatenate(column) for column in zip(*found, strict=True))
    polarity = np.where(length * TICK_NS > (p.on_ns + p.off_ns) / 2, 1, -1)
    return in_turn(begin + start_ns // TICK_NS, taxel, polarity, length)
