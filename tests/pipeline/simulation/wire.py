"""The wire of ACES with all pulses on it, for which :func:`.bursts` stands."""

import functools

import numpy as np

from pipeline.recordings.events import TICK_NS, Events
from pipeline.recordings.sensor import N_TAXELS
from pipeline.simulation.aces import find_ticks, queue_bursts

# Seed of the random search for signatures: a property of the hardware, not of a data set.
SIGNATURE_SEED = 2020

# Ticks after which a taxel's reports can no longer belong to the same event.
LONGEST_BURST = 6

# The wire, for which nothing is published: pulses of a signature, its duration, pulses that may
# coincide in two signatures, pulses from which the decoder reports an event, ticks below which a
# burst is noise, and the noise of the wire in heights of a pulse.
WIRE = {
    "pulses": 10,
    "signature_s": 1.0e-3,
    "most_shared": 2,
    "level": 7.5,
    "shortest": 2,
    "noise": 0.1,
}

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


def encode(time_ns, taxel, polarity, p, start_ns, n_ticks) -> np.ndarray:
    """The sum of all signatures on the wire, sampled on the grid, without noise.

    Parameters
    ----------
    time_ns, taxel, polarity
        As in :func:`pipeline.simulation.aces.make_bursts`.
    p : section ``[aces]`` of the parameters, and :data:`WIRE`
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
    for first, columns, delay in zip(*find_ticks(time_ns, polarity, p), delays, strict=True):
        ticks = (first + delay - start_ns // TICK_NS)[:, None] + np.arange(columns)
        wire[ticks[(ticks >= 0) & (ticks < n_ticks)]] += 1  # its pulses do not overlap
    return wire


def decode(wire, p, start_ns) -> Events:
    """Decode which taxel fired at which time from the samples of the wire.

    Each sample is limited to a pulse's height, so that overlapping signatures do not cause false
    events; then the wire is correlated with every signature at every tick.  Consecutive
    ticks with at least ``p.level`` pulses are one event, whose length determines rise or fall.

    Parameters
    ----------
    wire : ndarray of float32, shape (n_ticks,)
    p : section ``[aces]`` of the parameters, and :data:`WIRE`
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
        return queue_bursts(*(np.empty(0, int),) * 4)
    begin, taxel, length = (np.concatenate(column) for column in zip(*found, strict=True))
    polarity = np.where(length * TICK_NS < (p.rise_ns + p.fall_ns) / 2, 1, -1)
    return queue_bursts(begin + start_ns // TICK_NS, taxel, polarity, length)
