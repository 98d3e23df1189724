"""Prepare the dataset of a run: split its recordings, and choose the settings that are left open.

The defaults are the paper's: its network, 200 samples, two seconds.  If recordings of another
sensor need other values and the user has not set them, the kind of the network chooses them.  What
is chosen depends only on the user's settings and the recordings.  A value that the user has set and
that does not fit is an error; all errors are reported together before anything is trained.
"""

import numpy as np

from deploy.errors import SeveralErrors, UserError
from pipeline.kinds.registry import find_kind
from pipeline.recordings.dataset import TOO_SMALL, Dataset, split_recordings
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.splits import find_split_problem
from pipeline.settings import Choice, Settings, apply_choices, list_reasons
from pipeline.sources import load_named_recordings


def choose_settings(
    settings: Settings, recordings: Recordings | None = None, needs_check: bool = True, say=None
) -> Settings:
    """The settings of :func:`prepare_dataset`."""
    return prepare_dataset(settings, recordings, needs_check, say).settings


def prepare_dataset(
    settings: Settings, recordings: Recordings | None = None, needs_check: bool = True, say=None
) -> Dataset:
    """Split recordings, and choose the settings that the user has not set, for them.

    Parameters
    ----------
    settings : Settings
        What the user has set.
    recordings : Recordings, optional
        The recordings that the settings name, if they were loaded before.
    needs_check : bool
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
    split, problems_of_split = _try_to_split(recordings, settings, needs_check)
    train = np.empty(0, int) if split is None else split.train
    choices, complete, problems = _try_to_choose(settings, recordings, train)
    problems += problems_of_split
    if problems or split is None:
        raise SeveralErrors(_name_the_file(line, settings) for line in problems)
    if say is not None:
        for line in list_reasons(settings, choices):
            say(line)
    return Dataset.from_recordings(complete, recordings, split)


def _try_to_choose(settings, recordings, train):
    """The choices for recordings, the settings with them, and the problems of the network."""
    choices: list[Choice] = []
    complete = settings
    try:
        choices = find_kind(settings).make_choices(recordings, train)
        complete = apply_choices(settings, choices, settings.data.source)
        kind = find_kind(complete)
        kind.require_recordings_fit(recordings)
        problems = list(kind.list_chip_problems())
    except UserError as error:
        problems = [str(error)]
    return choices, complete, problems


def _try_to_split(recordings, settings, needs_check):
    """The split of recordings or None, and its problems: none, too few samples, missing classes."""
    problems = []
    split = None
    try:
        split = split_recordings(recordings, settings)
    except UserError as error:
        problems.append(str(error))
    if needs_check and split is not None:
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
