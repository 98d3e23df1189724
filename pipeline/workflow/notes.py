"""Notes for the user when a run is opened: what was chosen, and what is wrong with recordings."""

from __future__ import annotations

from collections.abc import Iterator

from deploy.tables import format_count, list_names
from deploy.terminal import WARNING
from pipeline.kinds.registry import find_kind, has_networks
from pipeline.recordings.recordings import describe_recordings
from pipeline.recordings.sensor import describe_size, is_st_mnist_sensor
from pipeline.recordings.splits import PUBLISHED, WRITERS, find_classes_without_test, find_copies
from pipeline.settings import SIMULATED, read_settings

# Test recordings below which a user is warned.
MIN_TEST_RECORDINGS = 10

# What is wrong with recordings that are in the source twice; see :func:`find_copies`.
COPY_TEXTS = (
    "test recordings that are also in training (their accuracy says little about others)",
    "recordings that are also in another class",
)


def list_notes(opened, choices) -> Iterator[str]:
    """Yield the notes and warnings on the recordings of a run and on the choices for them.

    Parameters
    ----------
    opened : pipeline.workflow.opening.OpenedRun
    choices : list of str
        Lines on the choices.
    """
    run = opened.run
    kind = opened.kind
    if run.experiment.exists():
        if text := _describe_split(opened.dataset):
            yield f"{run.path}: {text}"
    elif opened.settings.data.source == SIMULATED:
        yield f"{run.path}: a new run, on simulated recordings (others: --data)"
    else:
        yield _describe_new_run(run.path, opened.dataset)
        yield from _describe_unstated_size(opened)
    yield from choices
    if kind.imported is not None:
        yield from kind.imported.list_warnings()
    yield from list_notes_on_recordings(opened)


def _describe_new_run(path, dataset):
    """The first message of a new run: source and properties of its recordings, and their split."""
    recordings = dataset.recordings
    text = ", ".join(filter(None, [describe_recordings(recordings), _describe_split(dataset)]))
    return f"{path}: a new run, on {recordings.source.name}: {text}"


def _describe_unstated_size(opened):
    """Say where the size of a sensor comes from, unless it is known or the user states it."""
    recordings = opened.dataset.recordings
    sensor = recordings.sensor
    is_known = is_st_mnist_sensor(sensor.rows, sensor.columns, sensor.classes)
    is_open = not opened.settings.skin.rows and not opened.settings.skin.columns
    if is_open and not is_known and min(sensor.rows, sensor.columns) > 1:
        yield (
            f"{describe_size(sensor)}: from the files, or from the largest y and x of all events "
            "(another size: --set skin.rows=... --set skin.columns=...)"
        )


def _describe_split(dataset):
    """The kind of the split in a few words, unless it is the usual one."""
    recordings = dataset.recordings
    if dataset.split.kind == PUBLISHED:
        parts = recordings.parts
        return f"published split: {parts.count('train')} train, {parts.count('test')} test"
    if dataset.split.kind == WRITERS:
        return "split by writers"
    return "random split instead of the published one" if recordings.is_split else ""


def list_replacements(opened) -> Iterator[str]:
    """Yield a warning if networks of another kind or of other recordings are going to be replaced.

    Parameters
    ----------
    opened : pipeline.workflow.opening.OpenedRun
        Its settings are not saved yet.
    """
    run = opened.run
    if not run.experiment.exists():
        return
    before = read_settings(run.experiment)
    now = opened.settings
    if (find_kind(before).name, before.input.kind) != (opened.kind.name, now.input.kind):
        change = f"the input {before.input.kind!r} is replaced by {now.input.kind!r}"
        replaced = has_networks(before, run.path)
    else:
        change = f"the recordings {before.data.source} are replaced by {now.data.source}"
        replaced = before.data.source != now.data.source and _has_outdated_networks(opened)
    if replaced:
        yield (
            f"{WARNING}{run.path}: {change}, and its networks, bundle and checks are made again.  "
            "To keep the present ones, stop now (Ctrl-C) and give another RUN"
        )


def _has_outdated_networks(opened):
    """True if a step was made of other recordings or settings than the present ones."""
    artifacts = [opened.find_artifact(step.name) for step in opened.kind.steps]
    return any(artifact.find_state().is_outdated for artifact in artifacts)


def list_notes_on_recordings(opened) -> Iterator[str]:
    """Lines on what is not presented, on sets that are not independent, and on what is missing."""
    recordings = opened.dataset.recordings
    split = opened.dataset.split
    yield from opened.kind.list_notes(recordings)
    if split.kind == PUBLISHED or not recordings.source.simulated:
        for pairs, text in zip(find_copies(recordings, split), COPY_TEXTS, strict=True):
            if pairs:
                text = f"{text}: {len(pairs)}, such as {pairs[0][1]} ({pairs[0][0]})"
                yield f"{WARNING}{recordings.source.name}: {text}"
    n_test = len(split.test)
    samples = opened.settings.check.samples
    if split.kind == PUBLISHED and n_test < samples:
        yield (
            f"{recordings.source.name}: the test set has {n_test} recordings, fewer than the "
            f"{samples} of a check; the check uses all of them"
        )
    if n_test < MIN_TEST_RECORDINGS:
        few = format_count(n_test, "recording")
        yield f"{WARNING}{recordings.source.name}: only {few} for the test; record more"
    if absent := find_classes_without_test(recordings, split):
        yield (
            f"{WARNING}{recordings.source.name}: the test set has no recordings of "
            f"{list_names(absent)}; the accuracy says nothing about them"
        )
    classes = recordings.sensor.classes
    missing = sorted(set(range(len(classes))) - set(recordings.labels.tolist()))
    if missing:
        names = ", ".join(classes[label] for label in missing)
        problem = f"no recordings of {names}; their outputs learn nothing"
        yield f"{WARNING}{recordings.source.name}: {problem}"
