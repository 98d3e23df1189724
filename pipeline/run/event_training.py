"""Training on events and choosing when to decide: of a run, or of a split of an experiment."""

from __future__ import annotations

from pipeline.inputs.dataset import Dataset
from pipeline.inputs.splits import hold_out
from pipeline.recordings.steps import EventTable
from pipeline.run.event_conversion import deployed_on_events
from pipeline.settings import Settings
from pipeline.training.events import EventRecipe, TrainedOnEvents, train_events


def train(
    settings: Settings, dataset: Dataset, seed: int, checkpoint=None, advance=None
) -> TrainedOnEvents:
    """Train on the training samples but those that :func:`choose` needs.

    Parameters
    ----------
    settings : Settings
        With ``input.kind = "events"``.
    dataset : Dataset
        Of them.
    seed : int
        Of the training, and of which samples are held out.
    checkpoint, advance
        As in :func:`pipeline.training.events.train_events`.
    """
    learn, _ = _apart(dataset, seed)
    table = EventTable.of(dataset.recordings)
    recipe, labels = EventRecipe.of(settings), dataset.labels
    return train_events(recipe, table, labels, learn, seed, checkpoint=checkpoint, advance=advance)


def choose(settings: Settings, dataset: Dataset, trained: TrainedOnEvents, seed: int) -> tuple:
    """Choose the confidence at which the network decides by itself.

    Parameters
    ----------
    settings, dataset, seed
        As in :func:`train`.
    trained : TrainedOnEvents

    Returns
    -------
    deploy.network.decision.Threshold
    int
        Number of samples that it was chosen on: the validation samples, or, where none are set
        apart, some of the training samples (:func:`pipeline.inputs.splits.hold_out`).
    """
    _, held = _apart(dataset, seed)
    table = EventTable.of(dataset.recordings)
    return trained.threshold(table, dataset.labels, held, settings.steps, seed), len(held)


def train_for_chip(settings: Settings, dataset: Dataset, seed: int, checkpoint=None) -> tuple:
    """Train on events as a run does, and describe the network that is deployed.

    Parameters
    ----------
    settings, dataset, seed, checkpoint
        As in :func:`train`.

    Returns
    -------
    TrainedOnEvents
    deploy.network.spec.NetworkSpec
    """
    trained = train(settings, dataset, seed, checkpoint)
    chosen, _ = choose(settings, dataset, trained, seed)
    return trained, deployed_on_events(settings, trained.weights, chosen.confidence, {})


def _apart(dataset, seed):
    """Samples to learn from, and samples to choose the confidence on."""
    if len(dataset.split.validation):
        return dataset.split.train, dataset.split.validation
    return hold_out(dataset.split.train, seed)
