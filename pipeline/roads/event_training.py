"""Training samples on events, and held-out samples that determine the confidence threshold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deploy.network.decision import Threshold
from pipeline.data.dataset import Dataset
from pipeline.data.steps import EventTable
from pipeline.settings import Settings

FEWEST = 100
"""Minimum number of samples for choosing a confidence; with fewer, the allowed loss, half a
percentage point, is less than half a sample."""


class EventSamples(NamedTuple):
    """Training samples, and held-out samples for choosing the confidence.

    Attributes
    ----------
    table : EventTable
        Events of all samples of the dataset.
    labels : ndarray of int, shape (n_samples,)
    train, held_out : ndarray of int
        Indices.
    """

    table: EventTable
    labels: np.ndarray
    train: np.ndarray
    held_out: np.ndarray


def event_samples(dataset: Dataset, seed: int) -> EventSamples:
    """Hold out the validation samples or, if there are none, some of the training samples.

    Without validation samples, no training samples are held out if these would be too few to choose
    a confidence on: the network learns from all of them and decides at the end.

    Parameters
    ----------
    dataset : Dataset
    seed : int
        Seed of :meth:`pipeline.data.splits.Split.held_out`.
    """
    table, (train, held_out) = EventTable.of(dataset.recordings), dataset.split.held_out(seed)
    if not len(dataset.split.validation) and len(held_out) < FEWEST:
        train, held_out = dataset.split.train, held_out[:0]
    return EventSamples(table, dataset.labels, train, held_out)


def choose(settings: Settings, samples: EventSamples, trained, seed: int) -> Threshold:
    """Choose the confidence for early decisions on the held-out samples; see :func:`trusted`."""
    table, labels, _, held_out = samples
    if not len(held_out):
        return Threshold(1.0, 0.0, 1.0)
    chosen = trained.threshold(table, labels, held_out, settings.steps, seed)
    return trusted(chosen, len(held_out))


def trusted(chosen: Threshold, samples: int) -> Threshold:
    """A confidence for early decisions, or 1 if it was chosen on fewer samples than `FEWEST`.

    With a confidence of 1 the network decides at the end of each recording.
    """
    return chosen if samples >= FEWEST else chosen._replace(confidence=1.0, share=1.0)
