"""The signal of each taxel under a moving pen (contact, film, gain, vibration, noise).

:func:`press_skin` computes the pressure of a complete recording, :func:`spread_force` that of a
pen that is being used.  :class:`Creep` and :func:`add_vibration` follow in both cases.

:class:`Receptors` are fast-adapting: a taxel fires only when its pressure has changed.  After an
event it is inactive while its pulse signature is sent (the refractory period).  Then it compares
its signal with that of its last event at the ticks of its own clock, and fires as soon as they
differ by more than a threshold: ON for a rise and OFF for a fall.
"""

import numpy as np

from pipeline.recordings.sensor import GRID, TaxelMap


def press_skin(motion, gain, least, skin, size=(GRID, GRID)):
    """The pressure of a pen on the taxels that it reaches, before the film creeps.

    The force of the tip (0.5 mm, half a taxel) spreads in the film and its cover; over the taxels
    it falls off as a Gaussian of standard deviation ``skin.spread``.  The next steps are
    :class:`Creep` and then :func:`add_vibration`.

    Parameters
    ----------
    motion : pipeline.simulation.handwriting.Motion
    gain : ndarray of float, shape (n_taxels,)
        Gain of each taxel.
    least : float
        Taxels whose pressure is always lower are left out.
    skin : section ``[skin]`` of the parameters
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
    taxel_map = TaxelMap.grid(*size)
    rows, columns = _compute_profiles(motion.down, motion.right, motion.force, skin, size)
    reach = rows.max(axis=0)[taxel_map.row] * columns.max(axis=0)[taxel_map.column] * gain
    taxels = np.flatnonzero(reach > least)
    felt = rows[:, taxel_map.row[taxels]] * columns[:, taxel_map.column[taxels]]
    felt *= gain[taxels].astype(np.float32)
    speed = np.hypot(np.gradient(motion.down, step), np.gradient(motion.right, step))
    return taxels, felt, speed


class Creep:
    """The piezoresistive film for any number of taxels, also of several recordings.

    One part of its response follows the pressure at once, the rest with a delay, so that it
    recovers from a pressure more slowly than it reacts (hysteresis).

    Parameters
    ----------
    n_taxels : int
    step_s : float
    skin : section ``[skin]`` of the parameters
    """

    def __init__(self, n_taxels, step_s, skin):
        self._late = np.zeros(n_taxels, np.float32)
        self._lag = np.float32(np.exp(-step_s / skin.creep_s))
        self._share = np.float32(skin.creep)

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


def add_vibration(signal, speed, rng, skin):
    """Add vibration and noise to the film's response, in place.

    A sliding tip scrapes: each taxel's pressure vibrates in proportion to itself and to the speed,
    up to ``skin.scrape_speed``.  In addition each taxel has a small independent noise.

    Parameters
    ----------
    signal : ndarray of float32, shape (n_times, n_taxels)
    speed : ndarray of float, shape (n_times,)
        Speed of the tip, in taxels per second.
    rng : numpy.random.Generator
    skin : section ``[skin]`` of the parameters
    """
    rough = (skin.scrape * np.minimum(speed / skin.scrape_speed, 1)).astype(np.float32)
    # Two independent noises are one with the root of the sum of their squares.
    deviation = rough[:, None] * signal
    deviation *= deviation
    deviation += np.float32(skin.noise**2)
    np.sqrt(deviation, out=deviation)
    deviation *= rng.standard_normal(signal.shape, np.float32)
    signal += deviation


def spread_force(down, right, force, skin, size=(GRID, GRID)) -> np.ndarray:
    """Force of the tip, spread over all taxels.

    Parameters
    ----------
    down, right, force : ndarrays of float, shape (n_times,)
        As in :class:`pipeline.simulation.handwriting.Motion`.
    skin : section ``[skin]`` of the parameters
    size : (int, int)
        Rows and columns of taxels.

    Returns
    -------
    ndarray of float32, shape (n_times, n_taxels)
    """
    rows, columns = _compute_profiles(down, right, force, skin, size)
    taxel_map = TaxelMap.grid(*size)
    return rows[:, taxel_map.row] * columns[:, taxel_map.column]


def _compute_profiles(down, right, force, skin, size):
    """The two factors of the pressure: over the rows, with the force, and over the columns."""
    rows, columns = (
        np.exp(-0.5 * (np.abs(along[:, None] - np.arange(n)) / skin.spread) ** skin.falloff)
        for along, n in zip((down, right), size, strict=True)
    )
    rows *= force[:, None]
    return rows.astype(np.float32), columns.astype(np.float32)


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
        self._on = on
        self._off = off
        self._step_s = step_s
        self._refractory_s = np.broadcast_to(refractory_s, n_channels)
        self._poll_s = np.broadcast_to(poll_s, n_channels)
        self._before = adapted
        self._upper = adapted + on
        self._lower = adapted - off
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
        step_s = self._step_s
        present = slice(signal.shape[1])
        upper = self._upper[present]
        lower = self._lower[present]
        ready = self._ready[present]
        times = []
        channels = []
        polarities = []
        last = self._before
        for now in signal:
            self._row += 1
            earlier = last
            last = now
            crossed = ((now > upper) | (now < lower)).nonzero()[0]
            if len(crossed) == 0:
                continue
            end = self._row * step_s
            crossed = crossed[ready[crossed] < end]
            if len(crossed) == 0:
                continue
            value = now[crossed]
            before = earlier[crossed]
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
