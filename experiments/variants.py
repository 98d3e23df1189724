"""Recordings without part of their timing, to measure how much that part contributes.

Each function returns recordings with the same samples, labels and numbers of events, with the
events in order of time.
"""

from dataclasses import replace

import numpy as np

from pipeline.recordings.dataset import Dataset
from pipeline.recordings.events import EVENT_DTYPES, Events
from pipeline.recordings.recordings import Recordings

# Description of the information that remains in the events, by name.
VARIANTS = {
    "as-is": "the events as they were recorded",
    "no-polarity": "all events ON",
    "even": "the order of events kept, their speed made even",
    "shuffled": "times shuffled among a recording's events",
    "counts": "only how many events each taxel has of each polarity",
}


def vary_recordings(recordings: Recordings, variant: str, seed: int, lasts_ns: float) -> Recordings:
    """Apply one of :data:`VARIANTS` to recordings.

    Parameters
    ----------
    recordings : Recordings
    variant : str
    seed : int
        Seed of the shuffling.
    lasts_ns : float
        Duration of each recording, see :func:`keep_only_counts`.
    """
    functions = {
        "as-is": lambda: recordings,
        "no-polarity": lambda: drop_polarity(recordings),
        "even": lambda: space_events_evenly(recordings),
        "shuffled": lambda: shuffle_events(recordings, seed),
        "counts": lambda: keep_only_counts(recordings, lasts_ns),
    }
    return functions[variant]()


def vary_dataset(dataset: Dataset, variant: str, seed: int) -> Dataset:
    """A data set with changed events; see :func:`vary_recordings`.

    Recordings that are reduced to counts last as long as the median training sample.
    """
    lasts = float(np.median(measure_durations_ns(dataset.recordings)[dataset.split.train]))
    recordings = vary_recordings(dataset.recordings, variant, seed, lasts)
    origin = dataset.origin.with_content("variant", variant)
    return Dataset(recordings, dataset.split, origin, dataset.settings)


def measure_durations_ns(recordings: Recordings) -> np.ndarray:
    """Time from each recording's first event to its last, 0 without events, shape (n_samples,)."""
    first, last = _find_ends(recordings)
    return last - first


def drop_polarity(recordings: Recordings) -> Recordings:
    """All events are ON: place and time of changes remain, but not their direction."""
    polarity = np.ones_like(recordings.events.polarity)
    return replace(recordings, events=replace(recordings.events, polarity=polarity))


def space_events_evenly(recordings: Recordings) -> Recordings:
    """Evenly spaced times from the first event to the last, in the original order."""
    sample = recordings.sample_of_event
    first, last = _find_ends(recordings)
    counts = np.diff(recordings.offsets)
    rank = np.arange(len(sample)) - recordings.offsets[sample]
    share = rank / np.maximum(counts - 1, 1)[sample]
    time_ns = np.rint(first[sample] + share * (last - first)[sample])
    return replace(recordings, events=replace(recordings.events, time_ns=time_ns))


def shuffle_events(recordings: Recordings, seed: int) -> Recordings:
    """The times of a recording's events are assigned to the events at random.

    The number of events in each step does not change, but their places are independent of the
    time.
    """
    rng = np.random.default_rng([seed, 0x5B0F])
    events = recordings.events
    sample = recordings.sample_of_event
    order = np.lexsort((rng.random(len(sample)), sample))
    columns = {name: getattr(events, name)[order] for name in EVENT_DTYPES if name != "time_ns"}
    return replace(recordings, events=Events(time_ns=events.time_ns, **columns))


def keep_only_counts(recordings: Recordings, lasts_ns: float) -> Recordings:
    """The n events of a taxel and polarity are evenly spaced over the same time for all recordings.

    Event k is at (k + 1/2)/n of this time.  The times of events and the duration of recordings are
    thus removed, as in a tactile image, whose pixels become evenly spaced spikes.

    Parameters
    ----------
    recordings : Recordings
    lasts_ns : float
        The time in nanoseconds.
    """
    events = recordings.events
    sample = recordings.sample_of_event
    key = (sample * (int(events.taxel.max(initial=0)) + 1) + events.taxel) * 2
    key += events.polarity < 0
    order = np.argsort(key, kind="stable")
    _, start, counts = np.unique(key[order], return_index=True, return_counts=True)
    rank = np.arange(len(key)) - np.repeat(start, counts)
    time_ns = np.empty(len(key), np.int64)
    time_ns[order] = np.rint((rank + 0.5) / np.repeat(counts, counts) * lasts_ns)
    order = np.lexsort(
        (key, time_ns, sample)
    )  # nothing of the order in time is left, ties included
    columns = {name: getattr(events, name)[order] for name in EVENT_DTYPES if name != "time_ns"}
    return replace(recordings, events=Events(time_ns=time_ns[order], **columns))


def _find_ends(recordings):
    """Time of each recording's first and last event, 0 without events."""
    time_ns = recordings.events.time_ns
    offsets = recordings.offsets
    has_events = np.diff(offsets) > 0
    first = np.zeros(len(recordings), np.int64)
    last = np.zeros(len(recordings), np.int64)
    first[has_events] = time_ns[offsets[:-1][has_events]]
    last[has_events] = time_ns[offsets[1:][has_events] - 1]
    return first, last
