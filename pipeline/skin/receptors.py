"""Fast-adapting receptors: a taxel fires only when its pressure has changed.

After an event the taxel is inactive while its pulse signature is sent (the refractory period).
Then it compares its signal with that of its last event at the ticks of its own clock, and fires as
soon as they differ by more than a threshold: ON for a rise and OFF for a fall.
"""

from __future__ import annotations

import numpy as np


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
