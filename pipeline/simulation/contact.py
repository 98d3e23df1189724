"""The signal of each taxel under a moving pen (contact, film, gain, vibration, noise), its events.

:func:`press` computes a complete recording at once.  For a pen that is being used, the same
equations are computed step by step (:func:`pressure`, :func:`landings`, :class:`Shaking`).
:class:`Creep` and :func:`scrape` follow in both cases.

:class:`Receptors` are fast-adapting: a taxel fires only when its pressure has changed.  After an
event it is inactive while its pulse signature is sent (the refractory period).  Then it compares
its signal with that of its last event at the ticks of its own clock, and fires as soon as they
differ by more than a threshold: ON for a rise and OFF for a fall.
"""

import numpy as np

from pipeline.recordings.events import GRID, TaxelMap

# Share of the greatest force at which the pen counts as on the skin.
LANDED = 0.1

# Half of float32's smallest number, which has no effect when it is added.
NOTHING = 2.0**-150


def press(motion, gain, least, rng, p, size=(GRID, GRID)):
    """The pressure of a pen on the taxels that it reaches, before the film creeps.

    The force of the tip (0.5 mm, half a taxel) spreads in the film and its cover; over the taxels
    it falls off as a Gaussian of standard deviation ``p.spread``.  When the pen lands or lifts,
    the whole skin shakes.  The next steps are :class:`Creep` and then :func:`scrape`.

    Parameters
    ----------
    motion : pipeline.simulation.handwriting.Motion
    gain : ndarray of float, shape (n_taxels,)
        Gain of each taxel.
    least : float
        Taxels whose pressure is always lower are left out.
    rng : numpy.random.Generator
    p : section ``[skin]`` of ``parameters.toml``
    size : (int, int)
        Rows and columns of taxels.

    Returns
    -------
    taxels : ndarray of int, shape (n,)
    felt : ndarray of float32, shape (n_times, n)
    speed : ndarray of float, shape (n_times,)
        Speed of the tip, in taxels per second.
    """
    step = motion.time_s[1] - motion.time_s[0]
    places = TaxelMap.grid(*size)
    rows, columns = _spread(motion.down, motion.right, motion.force, p, size)
    lands = landings(motion.force, LANDED * motion.force.max())
    jolts = strength(rng, p) * jolt(rng, len(lands), len(places))
    reach = (
        rows.max(axis=0)[places.row] * columns.max(axis=0)[places.column]
        + jolts.max(axis=0, initial=0.0)
    ) * gain
    taxels = np.flatnonzero(reach > least)
    felt = rows[:, places.row[taxels]] * columns[:, places.column[taxels]]
    Shaking(gain[taxels], step, p).advance(felt, zip(lands, jolts[:, taxels], strict=True))
    speed = np.hypot(np.gradient(motion.down, step), np.gradient(motion.right, step))
    return taxels, felt, speed


class Shaking:
    """The jolts that have not decayed yet, and the gain of the taxels.

    Parameters
    ----------
    gain : ndarray of float, shape (n_taxels,)
    step_s : float
    p : section ``[skin]`` of ``parameters.toml``
    """

    def __init__(self, gain, step_s, p):
        self._gain, self._step_s, self._p = gain.astype(np.float32), step_s, p
        self._jolts = []  # (rows since the landing, signal of each taxel)

    def advance(self, pressure, jolts):
        """Convert the pressure of some steps to the signal of the taxels, in place.

        Parameters
        ----------
        pressure : ndarray of float32, shape (n_times, n_taxels)
            See :func:`pressure`.
        jolts : iterable of (int, ndarray of float, shape (n_taxels,))
            Row at which the pen lands or lifts, and the signal of each taxel.
        """
        p = self._p
        shaking = [(0, age, felt) for age, felt in self._jolts]
        shaking += [(row, 0, felt) for row, felt in jolts]
        for row, age, felt in shaking:
            # Values below half of float32's smallest number do not change a sum.
            lasts = p.jolt_s / self._step_s * np.log(max(felt.max(), NOTHING) / NOTHING)
            rows = slice(row, row + max(int(lasts) + 1 - age, 0))
            decay = np.exp(-np.arange(age, age + len(pressure[rows])) * self._step_s / p.jolt_s)
            pressure[rows] += np.outer(decay, felt)
        # After 20 time constants a jolt is too small to change a float32 pressure.
        ages = [(age + len(pressure) - row, felt) for row, age, felt in shaking]
        self._jolts = [jolt for jolt in ages if jolt[0] * self._step_s < 20 * p.jolt_s]
        pressure *= self._gain


class Creep:
    """The piezoresistive film for any number of taxels, also of several recordings.

    One part of its response follows the pressure at once, the rest with a delay, so that it
    recovers from a pressure more slowly than it reacts (hysteresis).

    Parameters
    ----------
    n_taxels : int
    step_s : float
    p : section ``[skin]`` of ``parameters.toml``
    """

    def __init__(self, n_taxels, step_s, p):
        self._late = np.zeros(n_taxels, np.float32)
        self._lag, self._share = np.float32(np.exp(-step_s / p.creep_s)), np.float32(p.creep)

    def advance(self, felt):
        """Convert the signal of some steps to the film's response, in place.

        Parameters
        ----------
        felt : ndarray of float32, shape (n_times, n)
            Forces on all taxels, or on the first n if the other recordings have ended.
        """
        late = self._late[: felt.shape[1]]
        change = np.empty_like(late)
        for now in felt:
            late *= self._lag
            late += np.multiply(now, 1 - self._lag, out=change)
            np.subtract(late, now, out=change)
            now += np.multiply(change, self._share, out=change)


def scrape(signal, speed, rng, p):
    """Add vibration and noise to the film's response, in place.

    A sliding tip scrapes: each taxel's pressure vibrates in proportion to itself and to the speed,
    up to ``p.scrape_speed``.  In addition each taxel has a small independent noise.

    Parameters
    ----------
    signal : ndarray of float32, shape (n_times, n_taxels)
    speed : ndarray of float, shape (n_times,)
        Speed of the tip, in taxels per second.
    rng : numpy.random.Generator
    p : section ``[skin]`` of ``parameters.toml``
    """
    rough = (p.scrape * np.minimum(speed / p.scrape_speed, 1)).astype(np.float32)
    # Two independent noises are one with the root of the sum of their squares: np.hypot to the last
    # bit, in half its time.
    restless = np.square(rough[:, None] * signal, dtype=np.float64)
    restless += np.float64(np.float32(p.noise)) ** 2
    restless = np.sqrt(restless, out=restless).astype(np.float32)
    restless *= rng.standard_normal(signal.shape, np.float32)
    signal += restless


def pressure(down, right, force, p, size=(GRID, GRID)) -> np.ndarray:
    """Force of the tip, spread over all taxels.

    Parameters
    ----------
    down, right, force : ndarrays of float, shape (n_times,)
        As in :class:`pipeline.simulation.handwriting.Motion`.
    p : section ``[skin]`` of ``parameters.toml``
    size : (int, int)
        Rows and columns of taxels.

    Returns
    -------
    ndarray of float32, shape (n_times, n_taxels)
    """
    rows, columns = _spread(down, right, force, p, size)
    places = TaxelMap.grid(*size)
    return rows[:, places.row] * columns[:, places.column]


def _spread(down, right, force, p, size):
    """The two factors of the pressure: over the rows, with the force, and over the columns."""
    high, wide = map(np.arange, size)
    rows = np.exp(-0.5 * ((down[:, None] - high) / p.spread) ** 2).astype(np.float32)
    columns = np.exp(-0.5 * ((right[:, None] - wide) / p.spread) ** 2).astype(np.float32)
    rows *= force[:, None].astype(np.float32)
    return rows, columns


def landings(force, least) -> np.ndarray:
    """Rows, from 1, at which a force crosses ``least`` upwards or downwards."""
    return np.flatnonzero(np.diff((force > least).astype(int))) + 1


def strength(rng, p) -> float:
    """Strength of the transients when the pen lands or lifts, in one recording."""
    return p.jolt * np.exp(p.jolt_spread * rng.standard_normal())


def jolt(rng, n, n_taxels) -> np.ndarray:
    """The signal of each taxel for ``n`` landings of unit strength, shape (n, n_taxels)."""
    return rng.standard_exponential((n, n_taxels))


class Receptors:
    """The state of the taxels between two calls.

    Between two samples the signal is interpolated linearly.  The time of an event is the first tick
    of the taxel's clock at which the threshold has been crossed.

    Parameters
    ----------
    adapted : ndarray of float, shape (n_channels,)
        The signal to which the receptors are adapted at the start.
    on, off : ndarrays of float, shape (n_channels,)
        Thresholds, above 0, for a rise and a fall.
    step_s : float
        Time between rows of a signal; at most the refractory period.
    refractory_s, poll_s : float or ndarray, shape (n_channels,)
        Refractory period, and interval of the taxel's clock.
    """

    def __init__(self, adapted, on, off, step_s, refractory_s, poll_s):
        n_channels = len(adapted)
        self._on, self._off, self._step_s = on, off, step_s
        self._refractory_s = np.broadcast_to(refractory_s, n_channels)
        self._poll_s = np.broadcast_to(poll_s, n_channels)
        self._before = adapted
        self._upper, self._lower = adapted + on, adapted - off
        self._ready = np.zeros(n_channels)
        self._row = 0

    def advance(self, signal):
        """Events of the next steps.

        An event may be up to ``poll_s`` after the last step, at the next tick of the taxel's clock.

        Parameters
        ----------
        signal : ndarray of float, shape (n_times, n)
            Signals of all channels, or of the first n if the others have ended.

        Returns
        -------
        time_s : ndarray of float, shape (n_events,)
            Times from the start.
        channel : ndarray of int, shape (n_events,)
        polarity : ndarray of int8, shape (n_events,)
            1 for ON, -1 for OFF.  In no particular order.
        """
        step_s, own = self._step_s, slice(signal.shape[1])
        upper, lower, ready = self._upper[own], self._lower[own], self._ready[own]
        times, channels, polarities = [], [], []
        last = self._before
        for now in signal:
            self._row += 1
            earlier, last = last, now
            crossed = ((now > upper) | (now < lower)).nonzero()[0]
            if len(crossed) == 0:
                continue
            end = self._row * step_s
            crossed = crossed[ready[crossed] < end]
            if len(crossed) == 0:
                continue
            value, before = now[crossed], earlier[crossed]
            rises = value > upper[crossed]
            limit = np.where(rises, upper[crossed], lower[crossed])
            move = value - before
            share = np.where(move != 0, (limit - before) / np.where(move != 0, move, 1), 0)
            at = end - step_s + step_s * np.minimum(np.maximum(share, 0), 1)  # np.clip is slower
            looks = np.ceil(np.maximum(at - ready[crossed], 0) / self._poll_s[crossed])
            at = ready[crossed] + looks * self._poll_s[crossed]
            times.append(at)
            channels.append(crossed)
            polarities.append(np.where(rises, 1, -1).astype(np.int8))
            ready[crossed] = at + self._refractory_s[crossed]
            upper[crossed] = value + self._on[crossed]
            lower[crossed] = value - self._off[crossed]
        self._before = last.copy()
        if not times:
            return np.empty(0), np.empty(0, int), np.empty(0, np.int8)
        return np.concatenate(times), np.concatenate(channels), np.concatenate(polarities)
