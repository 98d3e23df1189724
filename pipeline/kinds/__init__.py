"""The kinds of networks, a folder each; :mod:`.kind` says what depends on the kind.

:func:`prepare_dataset` chooses the settings that the user has left open, for the recordings.  The
defaults are the paper's: its network, 200 samples, two seconds.  If recordings of another sensor
need other values and the user has not set them, the kind of the network chooses them.  What is
chosen depends only on the user's settings and the recordings.  A value that the user has set and
that does not fit is an error; all errors are reported together before anything is trained.
"""

from pathlib import Path

import numpy as np

from deploy.errors import SeveralErrors, UserError
from pipeline.kinds.events.kind import EventsKind
from pipeline.kinds.image.kind import ImageKind
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.nir.kind import NirKind
from pipeline.recordings.dataset import TOO_SMALL, Dataset, split_recordings
from pipeline.recordings.events import Recordings, describe_recordings
from pipeline.recordings.splits import PUBLISHED, WRITERS, find_split_problem
from pipeline.run.settings import INPUTS, Choice, Settings, apply_choices, list_reasons
from pipeline.sources import load_named_recordings

# The first of them that describes the settings is the kind of a run.
KINDS: list[type[NetworkKind]] = [NirKind, EventsKind, ImageKind]


def register_kind(kind: type[NetworkKind], samples: str = "images"):
    """Add a kind of network, which ``--input`` selects by its :attr:`NetworkKind.input_kinds`.

    Parameters
    ----------
    kind : type
    samples : str
        What its network gets of each recording: ``"images"`` or ``"frames"`` of events.
    """
    KINDS.insert(0, kind)
    INPUTS.update(dict.fromkeys(kind.input_kinds, samples))


def list_references() -> dict:
    """The :class:`pipeline.kinds.reference.Reference` stages of all kinds by their names."""
    return {name: stage for kind in KINDS for name, stage in kind.references.items()}


def list_trained_stages() -> tuple:
    """The reference stages whose networks become bundles; conversion causes all later losses."""
    return tuple(kind.deployed_stage for kind in KINDS)


def list_compared_stages() -> tuple:
    """The stages that a deployed network is compared with: the first of them that there is."""
    return tuple(stage for kind in KINDS for stage in (*kind.compared_stages, kind.deployed_stage))


def find_compared_stage(stages) -> str:
    """The stage that the deployed network is compared with, and from which losses are stated.

    Parameters
    ----------
    stages : sequence of str
        Stages in the order of the ladder.
    """
    return next((stage for stage in list_compared_stages() if stage in stages), next(iter(stages)))


def find_kind(settings: Settings) -> NetworkKind:
    """The kind of a run's network; the only place that decides it."""
    return next(kind for kind in KINDS if kind.describes(settings))(settings)


def has_networks(settings: Settings, folder: Path) -> bool:
    """True if the folder of a run with these settings has a network for the bundle."""
    kind = find_kind(settings)
    steps = [step for step in kind.steps if kind.is_deployed(step.name)]
    return any((folder / step.folder / "metrics.json").exists() for step in steps)


def choose_settings(
    settings: Settings, recordings: Recordings | None = None, check: bool = True, say=None
) -> Settings:
    """The settings of :func:`prepare_dataset`."""
    return prepare_dataset(settings, recordings, check, say).settings


def prepare_dataset(
    settings: Settings, recordings: Recordings | None = None, check: bool = True, say=None
) -> Dataset:
    """Split recordings, and choose the settings that the user has not set, for them.

    Parameters
    ----------
    settings : Settings
        What the user has set.
    recordings : Recordings, optional
        The recordings that the settings name, if they were loaded before.
    check : bool
        True if samples of a check will be drawn.
    say : callable, optional
        Called with a message about each choice.

    Returns
    -------
    Dataset
        With the complete settings.

    Raises
    ------
    SeveralErrors
        With a line for each problem.
    """
    if recordings is None:
        recordings = load_named_recordings(settings)
    if len(recordings.sensor.classes) < 2:  # there is no network to choose
        raise SeveralErrors([f"{settings.data.source}: {find_split_problem(recordings)}"])
    split, problems_of_split = _try_to_split(recordings, settings, check)
    train = np.empty(0, int) if split is None else split.train
    choices, complete, problems = _try_to_choose(settings, recordings, train)
    problems += problems_of_split
    if problems or split is None:
        raise SeveralErrors(_name_the_file(line, settings) for line in problems)
    if say is not None:
        for line in list_reasons(settings, choices):
            say(line)
    return Dataset.of(complete, recordings, split)


def _try_to_choose(settings, recordings, train):
    """The choices for recordings, the settings with them, and the problems of the network."""
    choices: list[Choice] = []
    complete = settings
    try:
        choices = find_kind(settings).make_choices(recordings, train)
        complete = apply_choices(settings, choices, settings.data.source)
        kind = find_kind(complete)
        kind.require_fit(recordings)
        problems = list(kind.list_chip_problems())
    except UserError as error:
        problems = [str(error)]
    return choices, complete, problems


def _try_to_split(recordings, settings, check):
    """The split of recordings or None, and its problems: none, too few samples, missing classes."""
    problems = []
    split = None
    try:
        split = split_recordings(recordings, settings)
    except UserError as error:
        problems.append(str(error))
    if check and split is not None:
        problems += _find_too_small_test_set(settings, len(split.test))
    if problem := find_split_problem(recordings, settings.split.kind):
        problems.append(problem)
    return split, problems


def _find_too_small_test_set(settings, n_test):
    """A problem if the test set has fewer samples than the user's check."""
    samples = settings.check.count_samples(n_test)
    if settings.is_set_by_user("check.samples"):
        samples = settings.check.samples
    if 0 < n_test < samples:
        yield (
            f"{settings.check.samples} samples requested, the test set has {n_test}; {TOO_SMALL}"
        )


def _name_the_file(line, settings):
    """A problem with the file that it is about: the user's network, or the recordings."""
    source = settings.data.source
    imported = find_kind(settings).imported
    named = source if imported is None else (source, imported.file)
    return line if line.startswith(named) else f"{source}: {line}"


def describe_new_run(path, dataset: Dataset) -> str:
    """The first message of a new run: source and properties of its recordings, and their split."""
    recordings = dataset.recordings
    text = ", ".join(filter(None, [describe_recordings(recordings), describe_split(dataset)]))
    return f"{path}: a new run, on {recordings.source.name}: {text}"


def describe_split(dataset: Dataset) -> str:
    """The kind of the split in a few words, unless it is the usual one."""
    recordings = dataset.recordings
    if dataset.split.kind == PUBLISHED:
        parts = recordings.parts
        return f"published split: {parts.count('train')} train, {parts.count('test')} test"
    if dataset.split.kind == WRITERS:
        return "split by writers"
    return "random split instead of the published one" if recordings.is_split else ""
