"""Train a network on events, and choose the confidence for its early decisions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deploy.network.decision import Threshold
from pipeline.inputs.dataset import Dataset
from pipeline.recordings.steps import EventTable
from pipeline.settings import Settings
from pipeline.training.checkpoint import Checkpoint
from pipeline.training.events import EventRecipe, TrainedOnEvents, train_events

FEWEST_HELD = 100
"""Minimum number of samples for choosing a confidence; with fewer, half a percentage point is less
than one sample."""


class Apart(NamedTuple):
    """Training samples, and held-out samples for choosing the confidence.

    Attributes
    ----------
    table : EventTable
        Events of all samples of the dataset.
    labels : ndarray of int, shape (n_samples,)
    learn, held : ndarray of int
        Indices.
    """

    table: EventTable
    labels: np.ndarray
    learn: np.ndarray
    held: np.ndarray


def set_apart(dataset: Dataset, seed: int) -> Apart:
    """Hold out the validation samples or, if there are none, some of the training samples.

    Parameters
    ----------
    dataset : Dataset
    seed : int
        Seed of :meth:`pipeline.inputs.splits.Split.held_out`.
    """
    table = EventTable.of(dataset.recordings)
    return Apart(table, dataset.labels, *dataset.split.held_out(seed))


def train(
    settings: Settings,
    samples: Apart,
    seed: int,
    checkpoint: Checkpoint | None = None,
    advance=None,
    start: dict | None = None,
) -> TrainedOnEvents:
    """Train a network on events.

    Parameters
    ----------
    settings : Settings
        With ``input.kind = "events"``.
    samples : Apart
    seed, checkpoint, advance, start
        As in :func:`pipeline.training.events.train_events`.
    """
    recipe, (table, labels, learn, _) = EventRecipe.of(settings), samples
    return train_events(
        recipe, table, labels, learn, seed, checkpoint=checkpoint, advance=advance, start=start
    )


def choose(settings: Settings, samples: Apart, trained: TrainedOnEvents, seed: int) -> Threshold:
    """Choose the confidence for early decisions on the held-out samples.

    With fewer than :data:`FEWEST_HELD` samples none is chosen, and the network decides at the end
    of each recording (a confidence of 1).
    """
    table, labels, _, held = samples
    chosen = trained.threshold(table, labels, held, settings.steps, seed)
    return chosen if len(held) >= FEWEST_HELD else chosen._replace(confidence=1.0, share=1.0)
