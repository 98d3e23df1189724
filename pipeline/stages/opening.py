"""Open a run: load and split its recordings, and check that there are enough."""

from __future__ import annotations

from deploy.check.bundle import require_replaceable, require_room
from deploy.errors import UserError
from deploy.terminal import WARNING
from pipeline.artifacts import Artifact, Origin
from pipeline.data.dataset import (
    TOO_SMALL,
    Dataset,
    event_warnings,
    require_images_fit,
    require_recordings_fit,
)
from pipeline.data.splits import PUBLISHED, in_both_parts
from pipeline.data.statistics import facts_of
from pipeline.roads.given_networks import changed_note
from pipeline.roads.nir_import import graph_for
from pipeline.roads.own_model import take_over
from pipeline.run import RunFolder
from pipeline.settings import SIMULATED, Settings
from pipeline.stages.training import network_artifact


def open_dataset(
    run: RunFolder,
    settings: Settings,
    jobs: int = 2,
    warn=None,
    check: bool = True,
    dataset: Dataset | None = None,
) -> Dataset:
    """Load and split the recordings of a run, save its settings, and write ``dataset.json``.

    The settings are only saved after the recordings and a user's Keras model have been found
    sufficient, so that a mistaken path, number of samples or model is not stored in the run.

    Parameters
    ----------
    run, settings
    jobs : int
        Number of processes.
    warn : callable, optional
        Called with each warning.
    check : bool
        Check that there are enough samples for the check; a training needs none.
    dataset : Dataset, optional
        Dataset of the same settings, used instead of their recordings; see
        :meth:`Dataset.of_arrays`.

    Raises
    ------
    UserError
        The source cannot be read, is too small for the split or the check, or cannot be presented;
        the check's samples are too large for a bundle; the bundle's folder has other files; or the
        user's model cannot be used.
    """
    if dataset is None:
        dataset = Dataset.of(settings, jobs, warn)
    elif dataset.is_of_arrays and dataset.recordings.source.name != settings.data.source:
        raise UserError(
            f"{settings.data.source}: differs from the settings of the arrays; use "
            f"'data.source' {dataset.recordings.source.name!r}"
        )
    require_recordings_fit(dataset.recordings, settings)
    recordings, split = dataset.recordings, dataset.split
    if check:
        require_replaceable(run.bundle)
        try:
            n_check = settings.check.drawn(len(split.test))
            split.check_samples(n_check, settings.seed)
        except ValueError as error:
            remedy = TOO_SMALL
            if settings.data != run.resolve_settings(None, {}).data:
                remedy += "; no settings were saved: repeat --data in the next command"
            raise UserError(f"{settings.data.source}: {error}; {remedy}") from error
        rows, columns = recordings.sensor.rows, recordings.sensor.columns
        stimulus, channels = settings.stimulus, 2 if settings.on_events else 1
        shape = stimulus.sample_shape((rows, columns, channels), settings.steps)
        require_room(n_check, shape, stimulus)
        if not settings.on_events:
            require_images_fit(dataset.inputs, settings)
    _refuse_useless_network(run, settings, dataset)
    if warn is not None:
        for line in _notes(run, settings, dataset):
            warn(line)
    run.save_settings(settings)
    artifact = dataset_artifact(run, dataset.origin)
    if not artifact.state().is_current:
        sizes = {part: len(getattr(split, part)) for part in ("train", "validation", "test")}
        hashes = recordings.hashes()
        trained_on = [hashes[i] for i in (*split.train, *split.validation)]
        record = {**facts_of(recordings), **sizes, "split": split.kind}
        artifact.write({**record, "training_recordings": sorted(trained_on)})
    return dataset


def _refuse_useless_network(run, settings, dataset):
    """Examine a user's graph or Keras model now, unless the run has taken it over already."""
    name = "nir" if settings.nir.file else "cnn"
    if name == "cnn" and (settings.network != "image" or not settings.cnn.model):
        return
    artifact = network_artifact(name, run, settings, dataset.origin)
    if artifact.state().is_current:
        return
    if name == "nir":
        graph_for(artifact.folder, settings, dataset)
    else:
        take_over(artifact.folder, settings, dataset)


def dataset_artifact(run: RunFolder, origin: Origin) -> Artifact:
    """The description of a run's recordings."""
    return Artifact("dataset", run.dataset, origin)


def _notes(run, settings, dataset):
    """Warnings, for example about simulated data that the user did not ask for."""
    recordings = dataset.recordings
    if settings.on_events:
        yield from event_warnings(settings, recordings)
    if (note := changed_note(settings)) is not None:
        yield note
    if not run.experiment.exists():
        if settings.data.source == SIMULATED:
            yield f"{run.path}: a new run, on simulated recordings (others: --data)"
    elif (before := run.resolve_settings(None, {}).input.kind) != settings.input.kind:
        yield (
            f"{WARNING}{run.path}: was a run of input.kind {before!r}; its network and bundle are "
            "replaced (name another folder to keep both)"
        )
    if dataset.split.kind == PUBLISHED:
        yield from _notes_on_published(settings, recordings, len(dataset.split.test))
    classes = recordings.sensor.classes
    missing = sorted(set(range(len(classes))) - set(recordings.labels.tolist()))
    if missing:
        names = ", ".join(classes[label] for label in missing)
        problem = f"no recordings of {names}; their outputs learn nothing"
        yield f"{WARNING}{settings.data.source}: {problem}"


def _notes_on_published(settings, recordings, n_test):
    """Lines on a published split whose parts are not independent, or which is small."""
    source = settings.data.source
    if pairs := in_both_parts(recordings):
        train, test = pairs[0]
        yield (
            f"{WARNING}{source}: {len(pairs)} of {n_test} recordings of the test part are also in "
            f"the training part, such as {test} ({train}); the accuracy on them says little about "
            "others"
        )
    if n_test < settings.check.samples:
        yield (
            f"{source}: the test part has {n_test} recordings, fewer than the "
            f"{settings.check.samples} of a check; the check uses all of them"
        )
