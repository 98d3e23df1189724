"""The samples of a training on events."""

from typing import NamedTuple

import numpy as np

from pipeline.recordings.spike_frames import EventTable


class EventSamples(NamedTuple):
    """Training samples, and held-out samples, on which no weight is trained.

    Attributes
    ----------
    table : EventTable
        Events of all samples of the dataset.
    labels : ndarray of int, shape (n_samples,)
    train, held_out : ndarray of int
        Indices of the recordings of each of the two sets.
    """

    table: EventTable
    labels: np.ndarray
    train: np.ndarray
    held_out: np.ndarray
