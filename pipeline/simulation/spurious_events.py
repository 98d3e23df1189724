"""Events that no pen has caused: hot taxels of a session, and strays.

In the real recordings some taxels report events, in bouts, through a whole recording: always the
same ones, and not in all sessions.  Other taxels, mostly at the edge, report single events.
"""

import numpy as np


def draw_spurious_events(rng, session: float, span_s: tuple, refractory_s: float, faults, size):
    """Draw the events of a recording that no pen has caused.

    Parameters
    ----------
    rng : numpy.random.Generator
    session : float
        From 0 to 1: the session in which it was recorded.
    span_s : (float, float)
        First and last moment of the recording.
    refractory_s : float
        Shortest interval between two events of a taxel.
    faults : section ``[faults]`` of the parameters
    size : (int, int)
        Rows and columns of the skin.

    Returns
    -------
    time_s : ndarray of float, shape (n,)
    taxel : ndarray of int, shape (n,)
    polarity : ndarray of int, shape (n,)
    """
    rows, columns = size
    times = []
    taxels = []
    for row, column in _draw_hot_taxels(session, faults):
        rate = faults.hot_rate * np.exp(faults.hot_rate_spread * rng.standard_normal())
        if row < rows and column < columns:
            times.append(_draw_bouts(rng, span_s, rate, refractory_s, faults.bout_s))
            taxels.append(np.full(len(times[-1]), rows * column + row))
    hot = sum(map(len, times))
    strays = rng.poisson(faults.strays * np.exp(faults.strays_spread * rng.standard_normal()))
    times.append(rng.uniform(*span_s, strays))
    taxels.append(rng.integers(0, rows * columns, strays))
    time = np.concatenate(times)
    taxel = np.concatenate(taxels).astype(int)
    # A stray is a rise: the taxel does not come back to the threshold of a fall.
    is_rise = (np.arange(len(time)) >= hot) | (rng.random(len(time)) < faults.rise)
    return time, taxel, np.where(is_rise, 1, -1)


def _draw_hot_taxels(session, faults):
    """(row, column) of each hot taxel of a session."""
    for share, taxels in faults.sessions:
        if session < share:
            return taxels
        session -= share
    return ()


def _draw_bouts(rng, span_s, rate, refractory_s, bout_s):
    """Times of a taxel that fires at a rate during bouts, which alternate with equal pauses."""
    start_s, end_s = span_s
    count = int(2 * rate * (end_s - start_s)) + 10
    time = start_s + np.cumsum(refractory_s + rng.exponential(1 / rate, count))
    edges = start_s + np.cumsum(rng.exponential(bout_s, int(4 * (end_s - start_s) / bout_s) + 10))
    active = (np.searchsorted(edges, time) + rng.integers(2)) % 2 == 0
    return time[active & (time < end_s)]
