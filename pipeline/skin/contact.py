"""From a moving pen to the signal of every taxel: contact, film, gain, vibration, noise."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from pipeline.recordings.events import GRID, TaxelMap


def press(motion, gain, least, rng, p, size=(GRID, GRID)):
    """The signal of the taxels that a pen reaches.

    The force of the tip (0.5 mm, half a taxel) spreads in the film and its cover; over the taxels
    it falls off as a Gaussian of standard deviation ``p.spread``.  The piezoresistive film follows
    at once with one part of its answer and lags behind with the rest, so it comes back from a
    pressure later than it took it up (hysteresis).  A sliding tip scrapes: each taxel's pressure
    vibrates in proportion to itself and to the speed, up to ``p.scrape_speed``.  Each taxel has a
    little noise of its own besides.

    Parameters
    ----------
    motion : pipeline.skin.handwriting.Motion
    gain : ndarray of float, shape (n_taxels,)
        Of each taxel.
    least : float
        Taxels whose signal stays below are left out.
    rng : numpy.random.Generator
    p : pipeline.skin.parameters.Skin
    size : (int, int)
        Rows and columns of taxels.

    Returns
    -------
    taxels : ndarray of int, shape (n,)
    signal : ndarray of float32, shape (n_times, n)
    """
    step = motion.time_s[1] - motion.time_s[0]
    places, (down, right) = TaxelMap.grid(*size), map(np.arange, size)
    rows = np.exp(-0.5 * ((motion.down[:, None] - down) / p.spread) ** 2).astype(np.float32)
    columns = np.exp(-0.5 * ((motion.right[:, None] - right) / p.spread) ** 2).astype(np.float32)
    rows *= motion.force[:, None].astype(np.float32)
    jolts, landings = _jolts(motion, rng, p, len(places))
    reach = (
        rows.max(axis=0)[places.x] * columns.max(axis=0)[places.y] + jolts.max(axis=0, initial=0.0)
    ) * gain
    taxels = np.flatnonzero(reach > least)
    signal = rows[:, places.x[taxels]] * columns[:, places.y[taxels]]
    for row, jolt in zip(landings, jolts, strict=True):
        decay = np.exp(-np.arange(len(signal) - row) * step / p.jolt_s)
        signal[row:] += np.outer(decay, jolt[taxels])
    signal *= gain[taxels].astype(np.float32)
    speed = np.hypot(np.gradient(motion.down, step), np.gradient(motion.right, step))
    scrape = p.scrape * np.minimum(speed / p.scrape_speed, 1)
    lag = np.float32(np.exp(-step / p.creep_s))
    late = lfilter(np.array([1 - lag]), np.array([1, -lag], np.float32), signal, axis=0)
    signal += np.float32(p.creep) * (late - signal)
    # Two independent noises are one with the root of the sum of their squares.
    restless = np.hypot(scrape[:, None].astype(np.float32) * signal, np.float32(p.noise))
    signal += restless * rng.standard_normal(signal.shape, np.float32)
    return taxels, signal


def _jolts(motion, rng, p, n_taxels):
    """What each taxel feels of the shaking whenever the pen comes down or lifts.

    Returns
    -------
    jolts : ndarray of float, shape (n_landings, n_taxels)
    rows : ndarray of int, shape (n_landings,)
    """
    rows = np.flatnonzero(np.diff((motion.force > 0.1 * motion.force.max()).astype(int))) + 1
    strength = p.jolt * np.exp(p.jolt_spread * rng.standard_normal())
    return strength * rng.standard_exponential((len(rows), n_taxels)), rows
