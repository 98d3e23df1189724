"""Kinds: all that depends on the kind of network, each in one module; see :mod:`.kind`.

:func:`choose_settings` chooses the settings that the user has left open, for the recordings.  The
defaults are the paper's: its network, 200 samples, two seconds.  If recordings of another sensor
need other values and the user has not set them, the kind of the network chooses them.  What is
chosen depends only on the user's settings and the recordings.  A value that the user has set and
that does not fit is an error; all errors are reported together before anything is trained.
"""

from deploy.errors import SeveralErrors, UserError
from pipeline.kinds.events.kind import EventsKind
from pipeline.kinds.image.kind import ImageKind
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.nir.kind import NirKind
from pipeline.recordings.dataset import NO_SPLIT, TOO_SMALL
from pipeline.recordings.events import Recordings, reading_text
from pipeline.recordings.library import recordings_of
from pipeline.recordings.splits import PUBLISHED, WRITERS, kind_of, split_of, split_problem
from pipeline.run.settings import Choice, Settings, apply_choices, list_reasons

# The first of them that the settings describe is the kind of a run.
KINDS = [NirKind, EventsKind, ImageKind]

# Title and note of the reference stages of all kinds.
REFERENCES = {stage: texts for kind in KINDS for stage, texts in kind.references.items()}

# The reference stages whose networks become bundles; later losses are caused by the conversion.
TRAINED_STAGES = tuple(kind.deployed_stage for kind in KINDS)

# The stages that a deployed network is compared with: the first of them that there is.
COMPARED_WITH = ("cnn-matched", "trained", "nir", "cnn", "rate-lif")


def compared_with(stages) -> str:
    """The stage that the deployed network is compared with, and from which losses are stated.

    Parameters
    ----------
    stages : sequence of str
        Stages in the order of the ladder.
    """
    return next((stage for stage in COMPARED_WITH if stage in stages), next(iter(stages)))


def kind_of_network(settings: Settings) -> NetworkKind:
    """The kind of a run's network; the only place that decides it."""
    return next(kind for kind in KINDS if kind.describes(settings))(settings)


def choose_settings(
    settings: Settings, recordings: Recordings | None = None, check: bool = True, say=None
) -> Settings:
    """Choose the settings that the user has not set, for the recordings.

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
    Settings

    Raises
    ------
    SeveralErrors
        With a line for each problem.
    """
    if recordings is None:
        recordings = recordings_of(settings)
    source = settings.data.source
    if len(recordings.sensor.classes) < 2:  # there is no network to choose
        raise SeveralErrors([f"{source}: {split_problem(recordings)}"])
    result = settings
    problems: list[str] = []
    choices: list[Choice] = []
    try:
        choices = kind_of_network(settings).choices(recordings)
        result = apply_choices(settings, choices, source)
        kind = kind_of_network(result)
        kind.require_fit(recordings)
        problems += kind.chip_problems()
    except UserError as error:
        problems.append(str(error))
    n_test = _test_samples(settings, recordings, problems)
    samples = settings.check.samples
    if not settings.is_users("check.samples"):
        samples = settings.check.drawn(n_test)
    if check and 0 < n_test < samples:
        problems.append(
            f"{settings.check.samples} samples requested, the test set has {n_test}; {TOO_SMALL}"
        )
    if problem := split_problem(recordings, settings.split.kind):
        problems.append(problem)
    if problems:
        imported = kind_of_network(settings).imported
        named = (source, imported.file) if imported is not None else source
        raise SeveralErrors(
            line if line.startswith(named) else f"{source}: {line}" for line in problems
        )
    if say is not None:
        for line in list_reasons(settings, choices):
            say(line)
    return result


def new_run_text(path, recordings: Recordings, settings: Settings) -> str:
    """The first message of a new run: source and properties of its recordings, and their split."""
    text = ", ".join(filter(None, [reading_text(recordings), split_text(recordings, settings)]))
    return f"{path}: a new run, on {recordings.source.name}: {text}"


def split_text(recordings: Recordings, settings: Settings) -> str:
    """The kind of the split in a few words, unless it is the usual one."""
    kind = kind_of(settings.split.kind, recordings)
    parts = recordings.parts
    if kind == PUBLISHED:
        return f"published split: {parts.count('train')} train, {parts.count('test')} test"
    if kind == WRITERS:
        return "split by writers"
    return "random split instead of the published one" if recordings.is_split else ""


def _test_samples(settings, recordings, problems):
    """Number of samples in the test set; 0, with a problem, if there can be no split."""
    shares = settings.split
    try:
        fractions = shares.test_fraction, shares.validation_fraction
        split = split_of(recordings, settings.seed, *fractions, shares.kind)
    except ValueError as error:
        problems.append(f"{error}; {NO_SPLIT}")
        return 0
    return len(split.test)
