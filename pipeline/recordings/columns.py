"""Events of several samples as columns of equal length."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class EventColumns(NamedTuple):
    """Events of several samples, in any order.

    Attributes
    ----------
    sample : ndarray of int, shape (n_events,)
        The sample of each event, from 0.
    time_ms : ndarray of float, shape (n_events,)
        Time from the beginning of the sample in milliseconds.
    row, column : ndarray, shape (n_events,)
        Position in the tactile image.
    polarity : ndarray, shape (n_events,)
        0 for ON, 1 for OFF.
    """

    sample: np.ndarray
    time_ms: np.ndarray
    row: np.ndarray
    column: np.ndarray
    polarity: np.ndarray

    def select(self, kept) -> EventColumns:
        """Some of the events, by a mask or by their indices."""
        return EventColumns(*(values[kept] for values in self))

    def join(self, other: EventColumns) -> EventColumns:
        """These events, followed by others; the types of the columns stay."""
        pairs = zip(self, other, strict=True)
        return EventColumns(*(np.concatenate([a, b.astype(a.dtype)]) for a, b in pairs))

    def measure_durations_ms(self, n_samples: int) -> np.ndarray:
        """Time of each sample's last event in milliseconds, shape (samples,); 0 without events."""
        durations = np.zeros(n_samples)
        np.maximum.at(durations, self.sample, self.time_ms)
        return durations
