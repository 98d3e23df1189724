"""Events in the time steps of a chip: the spikes of each taxel and polarity in each step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from deploy.network.stimulus import apply_refractory_period, limit_spikes
from pipeline.recordings.cache import make_empty_array, release_pages
from pipeline.recordings.columns import EventColumns
from pipeline.recordings.events import EVENT_DTYPES, Events
from pipeline.recordings.sensor import TaxelMap
from pipeline.settings import Input

if TYPE_CHECKING:
    from pipeline.recordings.recordings import Recordings

# Recordings whose events are in memory at a time.
RECORDINGS_AT_ONCE = 2000


@dataclass(frozen=True)
class SpikeLimits:
    """Limits of the spikes of each taxel and polarity in a sample.

    Attributes
    ----------
    refractory_steps : int
        Refractory period: events in it after a spike are ignored, as in an event camera's pixel.
    max_spikes : int
        Maximum number of spikes; later events are ignored.  0: no limit.
    """

    refractory_steps: int = 0
    max_spikes: int = 0

    @classmethod
    def from_settings(cls, inputs: Input) -> SpikeLimits:
        """The limits of settings."""
        return cls(inputs.refractory_steps, inputs.max_spikes)


NO_LIMITS = SpikeLimits()


@dataclass(frozen=True)
class EventTable:
    """Physical events of recordings, each recording's time counted from its first event.

    Times and places are computed for the recordings that are selected: the columns of large sources
    are memory-mapped, and a table of their own would not fit into memory.

    Attributes
    ----------
    events : Events
    offsets : ndarray of int64, shape (n_samples + 1,)
        Events of recording i are those from ``offsets[i]`` to ``offsets[i + 1]``.
    taxels : TaxelMap
        Places in the tactile image.
    size : (int, int)
        Rows and columns of the tactile image.
    """

    events: Events
    offsets: np.ndarray
    taxels: TaxelMap
    size: tuple = (10, 10)

    @classmethod
    def from_recordings(cls, recordings: Recordings) -> EventTable:
        """The physical events of recordings, independently of their numbers of columns."""
        size = (recordings.sensor.rows, recordings.sensor.columns)
        return cls(recordings.events, recordings.offsets, recordings.taxels, size)

    def __len__(self):
        return len(self.offsets) - 1

    @cached_property
    def duration_ms(self) -> np.ndarray:
        """Time from a recording's first event to its last, float32, shape (n_samples,)."""
        if not len(self.events):
            return np.zeros(len(self), np.float32)
        last_ns = self.events.time_ns[np.maximum(self.offsets[1:] - 1, 0)]
        has_events = np.diff(self.offsets) > 0
        return np.where(has_events, (last_ns - self._first_ns) / 1e6, 0).astype("f4")

    @cached_property
    def _first_ns(self):
        """Time of each recording's first event; any time for a recording without events."""
        if not len(self.events):
            return np.zeros(len(self), np.int64)
        return self.events.time_ns[np.minimum(self.offsets[:-1], len(self.events) - 1)]

    @property
    def typical_duration_ms(self) -> float:
        """The time that nine recordings in ten do not exceed, in ms; at least 1."""
        return self.measure_typical_duration(np.arange(len(self)))

    def measure_typical_duration(self, indices) -> float:
        """The time that nine of ten of some recordings do not exceed, in ms; at least 1."""
        durations_ms = self.duration_ms[indices]
        return max(float(np.quantile(durations_ms, 0.9)), 1.0) if len(durations_ms) else 1.0

    def select_in_batches(self, indices=None) -> Iterator[tuple]:
        """Pick the events of all or some recordings, a few recordings at a time.

        Yields
        ------
        slice, EventColumns
            Which of the recordings, and their events; see :meth:`select`.
        """
        indices = np.arange(len(self)) if indices is None else np.asarray(indices, int)
        for start in range(0, len(indices), RECORDINGS_AT_ONCE):
            span = slice(start, min(start + RECORDINGS_AT_ONCE, len(indices)))
            yield span, self.select(indices[span])
        self.release()

    def release(self):
        """Release the memory of mapped columns, after all recordings were used."""
        for name in EVENT_DTYPES:
            release_pages(getattr(self.events, name))

    def count_in_slices(self, n_slices: int, duration_ms: float, indices=None) -> np.ndarray:
        """Count the events of each taxel and polarity in equal slices of time.

        Parameters
        ----------
        n_slices : int
        duration_ms : float
            Time from a recording's first event that is divided into slices.  Later events are
            counted in the last one.
        indices : ndarray of int, optional
            Recordings; default: all.

        Returns
        -------
        ndarray of float32, shape (n_samples, slices, rows, columns, 2)
            First ON, then OFF.
        """
        indices = np.arange(len(self)) if indices is None else np.asarray(indices)
        counts = make_empty_array((len(indices), n_slices, *self.size, 2), np.float32)
        for span, events in self.select_in_batches(indices):
            counts[span] = self.count(events, span.stop - span.start, n_slices, duration_ms)
        return counts

    def count(
        self, events: EventColumns, n_samples: int, n_slices: int, duration_ms: float, weights=None
    ) -> np.ndarray:
        """Count events that were selected; see :meth:`count_in_slices`.

        Parameters
        ----------
        events : EventColumns
        n_samples : int
        n_slices : int
        duration_ms : float
        weights : ndarray, shape (n_events,), optional
            Number that each event counts for; default: 1.
        """
        slice_of_time = (events.time_ms * np.float32(n_slices / duration_ms)).astype(int)
        slice_of_time = np.minimum(slice_of_time, n_slices - 1)
        shape = (n_samples, n_slices, *self.size, 2)
        indices = (events.sample, slice_of_time, events.row, events.column, events.polarity)
        cell = np.ravel_multi_index(indices, shape)
        counts = np.bincount(cell, weights, minlength=math.prod(shape))
        return counts.astype(np.float32).reshape(shape)

    def find_events(self, indices) -> tuple:
        """Find the events of some recordings, one recording after the other.

        Returns
        -------
        sample, event : ndarray of int, shape (n_events,)
            Position of the event's recording in ``indices``, and index of the event.
        """
        indices = np.asarray(indices, int)
        first = self.offsets[indices]
        counts = self.offsets[indices + 1] - first
        sample = np.repeat(np.arange(len(indices)), counts)
        begins = np.cumsum(counts) - counts
        return sample, np.arange(counts.sum()) + np.repeat(first - begins, counts)

    def select(self, indices) -> EventColumns:
        """Events of some recordings, one recording after the other.

        Samples are numbered by their position in ``indices``.
        """
        sample, event = self.find_events(indices)
        time_ns = self.events.time_ns[event] - self._first_ns[indices][sample]
        taxel = self.events.taxel[event]
        return EventColumns(
            sample=sample,
            time_ms=(time_ns / 1e6).astype("f4"),
            row=self.taxels.row[taxel].astype(np.uint8),
            column=self.taxels.column[taxel].astype(np.uint8),
            polarity=(self.events.polarity[event] < 0).astype(np.uint8),
        )

    def make_frames(
        self, indices, step_ms: float, n_steps: int, limits: SpikeLimits = NO_LIMITS
    ) -> np.ndarray:
        """Frames of some recordings; see :func:`make_spike_frames`."""
        events = self.select(np.asarray(indices))
        return make_spike_frames(events, step_ms, len(indices), n_steps, self.size, limits)

    def measure_loss(self, step_ms: float, refractory_steps: int = 0) -> float:
        """Share of the events without a spike of their own; see :func:`make_spike_frames`."""
        spikes = sum(
            self._count_spikes(events, step_ms, refractory_steps)
            for _, events in self.select_in_batches()
        )
        return 1 - spikes / self.offsets[-1] if self.offsets[-1] else 0.0

    def _count_spikes(self, events, step_ms, refractory_steps):
        if not len(events.time_ms):
            return 0
        cell = (events.sample * self.size[0] + events.row) * self.size[1] + events.column
        step = (events.time_ms / step_ms).astype(np.int64)
        # One time axis for all: each taxel and polarity follows the previous one after a gap.
        time = np.sort((2 * cell + events.polarity) * (step.max() + refractory_steps + 1) + step)
        following = np.searchsorted(time, time + refractory_steps + 1).tolist()
        spikes = event = 0
        while event < len(following):
            spikes = spikes + 1
            event = following[event]
        return spikes


def make_spike_frames(
    events: EventColumns,
    step_ms: float,
    n_samples: int,
    n_steps: int,
    size: tuple = (10, 10),
    limits: SpikeLimits = NO_LIMITS,
) -> np.ndarray:
    """Frames that mark the spikes in each step.

    Several events of one taxel and polarity in a step are one spike.  Events after the last step
    are left out.

    Parameters
    ----------
    events : EventColumns
    step_ms : float
        Length of a step; an event belongs to the step in which it is.
    n_samples, n_steps : int
        Numbers of samples and steps.
    size : (int, int)
        Rows and columns.
    limits : SpikeLimits

    Returns
    -------
    ndarray of uint8, shape (steps, samples, rows, columns, 2)
    """
    frames = np.zeros((n_steps, n_samples, *size, 2), np.uint8)
    step = np.floor(events.time_ms / step_ms).astype(np.int64)
    inside = (step >= 0) & (step < n_steps)
    sample, _, row, column, polarity = events.select(inside)
    frames[step[inside], sample, row, column, polarity] = 1
    frames = apply_refractory_period(frames, limits.refractory_steps)
    return limit_spikes(frames, limits.max_spikes)
