"""Events in the time steps of a chip: the spikes of each taxel and polarity in each step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.network.stimulus import apply_refractory_period, limit_spikes
from pipeline.recordings.columns import EventColumns
from pipeline.recordings.events import Recordings


@dataclass(frozen=True)
class EventTable:
    """Physical events of recordings, each recording's time counted from its first event.

    Attributes
    ----------
    time_ms : ndarray of float32, shape (n_events,)
    row, column : ndarray of uint8, shape (n_events,)
        Position in the tactile image.
    polarity : ndarray of uint8, shape (n_events,)
        0 for ON, 1 for OFF.
    offsets : ndarray of int64, shape (n_samples + 1,)
        Events of recording i are those from ``offsets[i]`` to ``offsets[i + 1]``.
    size : (int, int)
        Rows and columns of the tactile image.
    """

    time_ms: np.ndarray
    row: np.ndarray
    column: np.ndarray
    polarity: np.ndarray
    offsets: np.ndarray
    size: tuple = (10, 10)

    @classmethod
    def of(cls, recordings: Recordings) -> EventTable:
        """The physical events of recordings, independently of their numbers of columns."""
        events, offsets = recordings.events, recordings.offsets
        # A recording without events may use any first event: it has no times to subtract it from.
        nearest = np.minimum(offsets[:-1], max(len(events.time_ns) - 1, 0))
        first = events.time_ns[nearest] if len(events.time_ns) else np.zeros(len(recordings))
        return cls(
            time_ms=((events.time_ns - first[recordings.sample_of_event]) / 1e6).astype("f4"),
            row=recordings.taxels.row[events.taxel].astype(np.uint8),
            column=recordings.taxels.column[events.taxel].astype(np.uint8),
            polarity=(events.polarity < 0).astype(np.uint8),
            offsets=offsets,
            size=(recordings.sensor.rows, recordings.sensor.columns),
        )

    def __len__(self):
        return len(self.offsets) - 1

    @property
    def duration_ms(self) -> np.ndarray:
        """Time from a recording's first event to its last, float32, shape (n_samples,)."""
        last = np.maximum(self.offsets[1:] - 1, 0)
        some = np.diff(self.offsets) > 0
        return np.where(some, self.time_ms[last] if len(self.time_ms) else 0, 0).astype("f4")

    @property
    def typical_duration_ms(self) -> float:
        """The time that nine recordings in ten do not exceed, in ms; at least 1."""
        return max(float(np.quantile(self.duration_ms, 0.9)), 1.0) if len(self) else 1.0

    def sliced_counts(self, slices: int, duration_ms: float, weights=None) -> np.ndarray:
        """Count the events of each taxel and polarity in equal slices of time.

        Parameters
        ----------
        slices : int
        duration_ms : float
            Time from a recording's first event that is divided into slices.  Later events are
            counted in the last one.
        weights : ndarray, shape (n_events,), optional
            Number that each event counts for; default: 1.

        Returns
        -------
        ndarray of float32, shape (n_samples, slices, rows, columns, 2)
            First ON, then OFF.
        """
        sample = np.repeat(np.arange(len(self)), np.diff(self.offsets))
        part = np.minimum((self.time_ms * np.float32(slices / duration_ms)).astype(int), slices - 1)
        shape = (len(self), slices, *self.size, 2)
        cell = np.ravel_multi_index((sample, part, self.row, self.column, self.polarity), shape)
        counts = np.bincount(cell, weights, minlength=np.prod(shape))
        return counts.astype(np.float32).reshape(shape)

    def pick(self, indices) -> EventColumns:
        """Events of some recordings, one recording after the other.

        Samples are numbered by their position in ``indices``.
        """
        first = self.offsets[indices]
        counts = np.diff(self.offsets)[indices]
        sample = np.repeat(np.arange(len(indices)), counts)
        event = np.arange(counts.sum()) + np.repeat(first - (np.cumsum(counts) - counts), counts)
        return EventColumns(
            sample=sample,
            time_ms=self.time_ms[event],
            row=self.row[event],
            column=self.column[event],
            polarity=self.polarity[event],
        )

    def frames(
        self, indices, step_ms: float, steps: int, refractory: int = 0, max_spikes: int = 0
    ) -> np.ndarray:
        """Frames of some recordings; see :func:`spike_frames`."""
        events = self.pick(np.asarray(indices))
        frames = spike_frames(events, step_ms, len(indices), steps, self.size, refractory)
        return limit_spikes(frames, max_spikes)

    def lost(self, step_ms: float, refractory: int = 0) -> float:
        """Share of the events without a spike of their own; see :func:`spike_frames`."""
        if not len(self.time_ms):
            return 0.0
        sample = np.repeat(np.arange(len(self)), np.diff(self.offsets))
        place = (sample * self.size[0] + self.row) * self.size[1] + self.column
        step = (self.time_ms / step_ms).astype(np.int64)
        # One time axis for all: each taxel and polarity follows the previous one after a gap.
        time = np.sort((2 * place + self.polarity) * (step.max() + refractory + 1) + step)
        following = np.searchsorted(time, time + refractory + 1).tolist()
        spikes = event = 0
        while event < len(following):
            spikes = spikes + 1
            event = following[event]
        return 1 - spikes / len(following)


def spike_frames(
    events: EventColumns, step_ms: float, samples: int, steps: int, size=(10, 10), refractory=0
) -> np.ndarray:
    """Frames that mark the spikes in each step.

    Several events of one taxel and polarity in a step are one spike.  Further events in the next
    ``refractory`` steps are ignored, as in an event camera's pixel.  Events after the last step are
    left out.

    Parameters
    ----------
    events : EventColumns
    step_ms : float
        Length of a step; an event belongs to the step in which it is.
    samples, steps : int
        Numbers of samples and steps.
    size : (int, int)
        Rows and columns.
    refractory : int
        Refractory period in steps.

    Returns
    -------
    ndarray of uint8, shape (steps, samples, rows, columns, 2)
    """
    frames = np.zeros((steps, samples, *size, 2), np.uint8)
    step = np.floor(events.time_ms / step_ms).astype(np.int64)
    inside = (step >= 0) & (step < steps)
    sample, _, row, column, polarity = events.select(inside)
    frames[step[inside], sample, row, column, polarity] = 1
    return apply_refractory_period(frames, refractory)
