"""Faulty taxels: hot ones, which send spikes of their own, and dead ones, which send nothing.

A sensor ages after its network was trained.  Training samples therefore have faulty taxels at
random places (:func:`draw_faults`), and a check measures the accuracy with a given number of them
(:func:`place_faults`).  Both make :class:`TaxelFaults`, which :meth:`TaxelFaults.apply` applies to
events; :meth:`TaxelFaults.draw_hot_events` gives the spikes of the hot taxels alone, and
:attr:`TaxelFaults.live` is the mask of the others, for inputs that are made of counts.

A network that has seen no faults trusts every taxel: one hot taxel costs a network on events a
third of its accuracy on ST-MNIST, most of which the training with hot taxels keeps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pipeline.recordings.columns import EventColumns
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Recordings

# Shortest and longest time between two spikes of a hot taxel in training.
HOT_PERIOD_MS = (20.0, 200.0)

# Time between two spikes of each polarity of a hot taxel in a check.
CHECK_PERIOD_MS = 80.0

# Maximum number of hot taxels in a training sample that has some.
MAX_HOT_TAXELS = 3

# Maximum share of the taxels that are dead in a training sample.
MAX_DEAD_SHARE = 0.1

# Probability that a hot taxel of a training sample is hot from the beginning of the sample to its
# end, that a dead one is dead from its beginning, and that a hot one sends both polarities.
WHOLE_SAMPLE_PROBABILITY = 0.5
BOTH_POLARITIES_PROBABILITY = 0.7


class HotSources(NamedTuple):
    """Sources of periodic spikes: a taxel that is hot in both polarities is two sources.

    Attributes
    ----------
    sample, row, column, polarity : ndarray of int, shape (n_sources,)
        As in :class:`pipeline.recordings.columns.EventColumns`.
    period_ms, first_ms : ndarray of float, shape (n_sources,)
        Time between two spikes, and time of the first.
    end_ms : ndarray of float, shape (n_sources,)
        Time after which there is no spike.
    """

    sample: np.ndarray
    row: np.ndarray
    column: np.ndarray
    polarity: np.ndarray
    period_ms: np.ndarray
    first_ms: np.ndarray
    end_ms: np.ndarray


@dataclass(frozen=True)
class TaxelFaults:
    """The faulty taxels of some samples.

    Attributes
    ----------
    hot : HotSources
    silent_from_ms : ndarray of float, shape (samples, rows, columns)
        Time from which each taxel is silent: infinite for one that works.
    """

    hot: HotSources
    silent_from_ms: np.ndarray

    @property
    def live(self) -> np.ndarray:
        """True for taxels that are never silent, shape (samples, rows, columns)."""
        return np.isinf(self.silent_from_ms)

    def draw_hot_events(self) -> EventColumns:
        """The spikes of the hot taxels."""
        hot = self.hot
        counts = np.floor((hot.end_ms - hot.first_ms) / hot.period_ms).astype(np.int64) + 1
        counts = np.maximum(counts, 0)
        source = np.repeat(np.arange(len(counts)), counts)
        number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        time_ms = hot.first_ms[source] + number * hot.period_ms[source]
        return EventColumns(
            hot.sample[source], time_ms, hot.row[source], hot.column[source], hot.polarity[source]
        )

    def is_sent(self, events: EventColumns) -> np.ndarray:
        """True for events that are not of a dead taxel, shape (n_events,)."""
        return events.time_ms < self.silent_from_ms[events.sample, events.row, events.column]

    def apply(self, events: EventColumns) -> EventColumns:
        """Events of the samples without those of dead taxels, followed by those of hot ones."""
        return events.select(self.is_sent(events)).join(self.draw_hot_events())


def draw_faults(hot: float, dead: float, rng, durations_ms, size: tuple) -> TaxelFaults:
    """Draw faulty taxels for training samples.

    Parameters
    ----------
    hot : float
        Probability that a sample has hot taxels: one to `MAX_HOT_TAXELS`, each with a period of
        its own, during all of the sample or a part of it.
    dead : float
        Probability that a sample has dead taxels: up to `MAX_DEAD_SHARE` of them, during all of the
        sample or from a random time on.
    rng : numpy.random.Generator
    durations_ms : ndarray of float, shape (samples,)
        Time of each sample's last event.
    size : (int, int)
        Rows and columns.

    Returns
    -------
    TaxelFaults
    """
    durations_ms = np.asarray(durations_ms, float)
    return TaxelFaults(
        _draw_hot(hot, rng, durations_ms, size), _draw_dead(dead, rng, durations_ms, size)
    )


def _draw_hot(share, rng, durations_ms, size):
    samples = len(durations_ms)
    number = rng.integers(1, MAX_HOT_TAXELS + 1, samples) * (rng.random(samples) < share)
    sample = np.repeat(np.arange(samples), number)
    n = len(sample)
    cell = rng.integers(0, size[0] * size[1], n)
    period_ms = np.exp(rng.uniform(*np.log(HOT_PERIOD_MS), n))
    begin, end = np.sort(rng.random((2, n)), 0)
    whole = rng.random(n) < WHOLE_SAMPLE_PROBABILITY
    begin = np.where(whole, 0.0, begin) * durations_ms[sample]
    end = np.where(whole, 1.0, end) * durations_ms[sample]
    only = np.where(rng.random(n) < BOTH_POLARITIES_PROBABILITY, -1, rng.integers(0, 2, n))
    taxel = np.tile(np.arange(n), 2)
    polarity = np.repeat([0, 1], n)
    sends = (only[taxel] < 0) | (only[taxel] == polarity)
    taxel = taxel[sends]
    polarity = polarity[sends]
    return HotSources(
        sample[taxel],
        cell[taxel] // size[1],
        cell[taxel] % size[1],
        polarity,
        period_ms[taxel],
        begin[taxel] + rng.random(len(taxel)) * period_ms[taxel],
        end[taxel],
    )


def _draw_dead(share, rng, durations_ms, size):
    samples = len(durations_ms)
    dead_share = rng.uniform(0, MAX_DEAD_SHARE, samples) * (rng.random(samples) < share)
    shape = samples, *size
    is_dead = rng.random(shape) < dead_share[:, None, None]
    begin = rng.random(shape) * durations_ms[:, None, None]
    begin = np.where(rng.random(shape) < WHOLE_SAMPLE_PROBABILITY, 0.0, begin)
    return np.where(is_dead, begin, np.inf)


@dataclass(frozen=True)
class FaultCounts:
    """Numbers of faulty taxels in each sample.

    Attributes
    ----------
    hot : int
        Taxels that send a spike of each polarity every `CHECK_PERIOD_MS`, from the beginning of the
        sample to its end.
    dead : int
        Taxels that send nothing.
    """

    hot: int = 0
    dead: int = 0

    def __str__(self):
        return f"hot{self.hot}-dead{self.dead}"


def place_faults(
    counts: FaultCounts, rng, durations_ms, places, size: tuple, n_polarities: int = 2
) -> TaxelFaults:
    """Place a number of faulty taxels in each sample, as a check measures their effect.

    Parameters
    ----------
    counts : FaultCounts
    rng : numpy.random.Generator
    durations_ms : ndarray of float, shape (samples,)
        Time of each sample's last event.
    places : ndarray of int, shape (n_taxels, 2)
        Row and column of each taxel of the sensor.
    size : (int, int)
        Rows and columns.
    n_polarities : int
        2 for ON and OFF events, 1 for ON events only.

    Returns
    -------
    TaxelFaults
        The taxels of each sample are drawn anew; no taxel is both hot and dead.

    Raises
    ------
    ValueError
        The sensor has fewer taxels.
    """
    hot = counts.hot
    faulty = hot + counts.dead
    if faulty > len(places):
        raise ValueError(f"{faulty} faulty taxels, the sensor has {len(places)}")
    durations_ms = np.asarray(durations_ms, float)
    samples = len(durations_ms)
    order = rng.permuted(np.tile(np.arange(len(places)), (samples, 1)), axis=1)
    row, column = np.asarray(places)[order[:, :faulty]].transpose(2, 0, 1)
    silent_from_ms = np.full((samples, *size), np.inf)
    silent_from_ms[np.arange(samples)[:, None], row[:, hot:], column[:, hot:]] = 0.0
    sample = np.repeat(np.arange(samples), hot * n_polarities)
    n = len(sample)
    sources = HotSources(
        sample,
        np.repeat(row[:, :hot].ravel(), n_polarities),
        np.repeat(column[:, :hot].ravel(), n_polarities),
        np.tile(np.arange(n_polarities), samples * hot),
        np.full(n, CHECK_PERIOD_MS),
        rng.uniform(0, CHECK_PERIOD_MS, n),
        durations_ms[sample],
    )
    return TaxelFaults(sources, silent_from_ms)


def add_faults(recordings: Recordings, faults: FaultCounts, seed) -> Recordings:
    """Recordings with faulty taxels, placed anew in each; see :func:`place_faults`.

    Parameters
    ----------
    recordings : Recordings
    faults : FaultCounts
    seed : int or sequence of int

    Returns
    -------
    Recordings

    Raises
    ------
    ValueError
        The sensor has fewer taxels.
    """
    taxels = recordings.taxels
    sensor = recordings.sensor
    old = recordings.events
    size = (sensor.rows, sensor.columns)
    begins_ns = np.zeros(len(recordings), np.int64)
    has_events = np.diff(recordings.offsets) > 0
    begins_ns[has_events] = old.time_ns[recordings.offsets[:-1][has_events]]
    sample = recordings.sample_of_event
    events = EventColumns(
        sample,
        (old.time_ns - begins_ns[sample]) / 1e6,
        taxels.row[old.taxel].astype(np.int64),
        taxels.column[old.taxel].astype(np.int64),
        (old.polarity < 0).astype(np.int64),
    )
    places = np.stack([taxels.row, taxels.column], 1)
    durations_ms = events.measure_durations_ms(len(recordings))
    rng = np.random.default_rng(seed)
    placed = place_faults(faults, rng, durations_ms, places, size, sensor.polarities)
    kept = placed.is_sent(events)
    faulty = placed.apply(events)
    columns = np.ones(len(faulty.sample), np.int64)
    columns[: kept.sum()] = old.columns[kept]
    taxel_at = np.zeros(size, np.int64)
    taxel_at[taxels.row, taxels.column] = np.arange(len(taxels))
    time_ns = begins_ns[faulty.sample] + np.rint(1e6 * faulty.time_ms).astype(np.int64)
    order = np.lexsort((time_ns, faulty.sample))
    counts = np.bincount(faulty.sample, minlength=len(recordings))
    return replace(
        recordings,
        events=Events(
            time_ns[order],
            taxel_at[faulty.row, faulty.column][order],
            np.where(faulty.polarity > 0, -1, 1)[order],
            columns[order],
        ),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
    )
