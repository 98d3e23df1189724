"""What a run is made from: its recordings, loaded, split and found enough."""

from __future__ import annotations

from deploy.errors import UserError
from pipeline.inputs.dataset import (
    TOO_SMALL,
    Dataset,
    event_warnings,
    images_fit,
    recordings_fit,
)
from pipeline.inputs.splits import draw_check_samples
from pipeline.recordings.facts import facts_of
from pipeline.run.folder import RunFolder
from pipeline.settings import SIMULATED, Settings


def open_dataset(
    run: RunFolder,
    settings: Settings,
    jobs: int = 2,
    warn=None,
    check: bool = True,
    dataset: Dataset | None = None,
) -> Dataset:
    """Load, split and draw the recordings of a run; keep its settings; write ``dataset.json``.

    The settings are kept only now that the recordings are there and enough: a mistaken path or
    number of samples must not stick to the run.

    Parameters
    ----------
    run, settings
    jobs : int
        Processes.
    warn : callable, optional
        Called with a line for each thing that the user should know.
    check : bool
        Whether samples of a check will be drawn and shown; training alone needs none.
    dataset : Dataset, optional
        Of the same settings, in the place of their recordings; see :meth:`Dataset.of_arrays`.

    Raises
    ------
    UserError
        The source cannot be read, is too small for the split or the check, or cannot be shown.
    """
    if dataset is None:
        dataset = Dataset.of(settings, jobs, warn)
    elif dataset.is_of_arrays and dataset.recordings.source.name != settings.data.source:
        raise UserError(
            f"{settings.data.source}: other settings than the arrays were taken with; give "
            f"'data.source' {dataset.recordings.source.name!r}"
        )
    recordings_fit(dataset.recordings, settings)
    recordings, split = dataset.recordings, dataset.split
    if check:
        try:
            draw_check_samples(split.test, settings.check.samples, settings.seed)
        except ValueError as error:
            remedy = TOO_SMALL
            if settings.data != run.resolve_settings(None, {}).data:
                remedy += "; nothing was kept: name the data (--data) in the next command too"
            raise UserError(f"{settings.data.source}: {error}; {remedy}") from error
        if not settings.on_events:
            images_fit(dataset.inputs, settings)
    if warn is not None:
        for line in _notes(run, settings, recordings):
            warn(line)
    run.save_settings(settings)
    artifact = run.artifacts["dataset"]
    if not artifact.state(dataset.origin).is_current:
        sizes = {part: len(getattr(split, part)) for part in ("train", "validation", "test")}
        artifact.write(dataset.origin, {**facts_of(recordings), **sizes})
    return dataset


def _notes(run, settings, recordings):
    """What should not pass without a word, such as simulated data that nobody asked for."""
    if settings.on_events:
        yield from event_warnings(settings, recordings)
    if not run.experiment.exists():
        if settings.data.source == SIMULATED:
            yield f"{run.path}: a new run, on simulated recordings (others: --data)"
    elif (before := run.resolve_settings(None, {}).input.kind) != settings.input.kind:
        yield (
            f"{run.path}: was a run of input.kind {before!r}; its network and bundle are replaced "
            "(name another folder to keep both)"
        )
    classes = recordings.sensor.classes
    missing = sorted(set(range(len(classes))) - set(recordings.labels.tolist()))
    if missing:
        names = ", ".join(classes[label] for label in missing)
        yield f"{settings.data.source}: no recordings of {names}; their outputs learn nothing"
