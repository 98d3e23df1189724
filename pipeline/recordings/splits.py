"""Splits of samples into training, validation and test samples."""

from dataclasses import dataclass, replace

import numpy as np

from deploy.tables import list_names
from pipeline.recordings.recordings import Recordings

# How recordings are split: at random, as in the paper; as the source says; by writers, of whom none
# has samples in both sets.
RANDOM = "random"
PUBLISHED = "published"
WRITERS = "writers"

# Names of the parts of a split.
PARTS = ("train", "validation", "test")

# Share of the training samples that is held out if there are no validation samples.
HELD_OUT = 0.1


@dataclass(frozen=True)
class Split:
    """Indices of samples in three disjoint parts, which together are all samples.

    Attributes
    ----------
    train : ndarray of int
        Indices of the recordings, in increasing order.
    validation, test : ndarray of int
        In random order: recordings are sorted by digit, and a network whose state is not reset
        between samples has a higher accuracy if both have the same label.  Settings are chosen
        on ``validation``, never on ``test``.
    kind : str
        ``"random"``, ``"published"`` or ``"writers"``.
    """

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    kind: str = RANDOM

    def get_indices(self, part: str) -> np.ndarray:
        """The indices of the samples of one of the `PARTS`."""
        if part not in PARTS:
            raise ValueError(f"no part {part!r}; the parts are {', '.join(PARTS)}")
        return getattr(self, part)

    def hold_out(self, seed: int) -> tuple:
        """Samples to train on, and held-out ones: the validation samples, or some of the others.

        Parameters
        ----------
        seed : int
            Seed of :func:`hold_out_samples`.
        """
        if len(self.validation):
            return self.train, self.validation
        return hold_out_samples(self.train, seed)

    def draw_check_samples(self, n_samples: int, seed: int) -> np.ndarray:
        """Draw the samples of the check; see :func:`draw_check_samples`.

        Those of a published split are the same for every seed, which changes the training only.
        """
        return draw_check_samples(self.test, n_samples, 0 if self.kind == PUBLISHED else seed)


def resolve_split(requested: str, recordings: Recordings) -> str:
    """The split to make: the requested one, or for ``"auto"`` the published one if there is one."""
    if requested != "auto":
        return requested
    return PUBLISHED if recordings.is_split else RANDOM


def make_split(
    recordings: Recordings,
    seed: int,
    test_fraction: float,
    validation_fraction: float = 0.0,
    requested: str = RANDOM,
) -> Split:
    """Split recordings into training, validation and test samples.

    Parameters
    ----------
    recordings : Recordings
    seed : int
    test_fraction, validation_fraction : float
        See :func:`split_at_random`; in splits by writers, validation samples have own writers too.
    requested : str
        Value of ``split.kind``: ``"auto"``, or one of those of :class:`Split`.

    Raises
    ------
    ValueError
        There are too few samples, the writers are not known, or the source has no published split.
    """
    resolved = resolve_split(requested, recordings)
    if resolved == WRITERS:
        split = split_by_writers(recordings.writers, seed, test_fraction)
        if not validation_fraction:
            return split
        inner = split_by_writers(recordings.writers[split.train], seed, validation_fraction)
        return replace(split, train=split.train[inner.train], validation=split.train[inner.test])
    if resolved == PUBLISHED:
        return split_as_published(recordings.parts, seed, validation_fraction)
    split = split_at_random(len(recordings), seed, test_fraction, validation_fraction)
    return _add_missing_classes(split, recordings.labels)


def _add_missing_classes(split, labels):
    """The split with a recording of each class in training and test, where there are two.

    Nothing changes where no class is missing.  Otherwise single recordings move: first into the
    training set, from validation before test; then into the test set, in exchange for a recording
    of the class with most test recordings, as long as that has more than one.
    """
    train, validation, test = (split.get_indices(part).tolist() for part in PARTS)

    def find_first(pool, label):
        return next((i for i in pool if labels[i] == label), None)

    for label in np.setdiff1d(labels, labels[train]):
        source = validation if find_first(validation, label) is not None else test
        moved = find_first(source, label)
        source.remove(moved)
        train.append(moved)
    missing = np.setdiff1d(labels, labels[test])
    for label in missing:
        is_spare = np.count_nonzero(labels[train] == label) > 1
        source = train if is_spare else validation
        moved = find_first(source, label)
        if moved is None:
            continue  # the only recording is in the training set
        source.remove(moved)
        counts = np.bincount(labels[test])
        if counts.max(initial=0) > 1:
            exchanged = find_first(test, int(counts.argmax()))
            test.remove(exchanged)
            source.append(exchanged)
        test.append(moved)
    if len(missing):  # recordings of a class must not follow each other
        test = np.random.default_rng([len(labels), 0xC1A5]).permutation(test)
    arrays = (np.array(indices, np.int64) for indices in (sorted(train), validation, test))
    return Split(*arrays, split.kind)


def find_classes_without_test(recordings: Recordings, split: Split) -> list:
    """Names of the classes that have recordings, but none in the test set."""
    missing = np.setdiff1d(recordings.labels, recordings.labels[split.test])
    return [recordings.sensor.classes[label] for label in missing]


def find_split_problem(recordings: Recordings, requested: str = "auto") -> str | None:
    """Find a class with too few recordings for a training.

    A class with one recording can be used for training or for testing, but not for both.  A
    published split may lack a class in its test set: see :func:`find_classes_without_test`.

    Parameters
    ----------
    recordings : Recordings
    requested : str
        As in :func:`make_split`.
    """
    classes = recordings.sensor.classes
    labels = recordings.labels
    counts = np.bincount(labels, minlength=len(classes))
    if np.count_nonzero(counts) < 2:
        return "recordings of one class only; at least two are needed"
    if resolve_split(requested, recordings) != PUBLISHED or not recordings.is_split:
        if single := [repr(classes[i]) for i in np.flatnonzero(counts == 1)]:
            return f"only one recording of {list_names(single)}; record more, or remove the folder"
        return None
    in_train = np.array([part == "train" for part in recordings.parts])
    counts_in_train = np.bincount(labels[in_train], minlength=len(classes))
    few = [repr(classes[i]) for i in np.flatnonzero((counts_in_train < 2) & (counts > 0))]
    if few:
        return (
            f"fewer than two recordings of {list_names(few)} in its folder train; add some, or use "
            "--set split.kind=random"
        )
    return None


def find_copies(recordings: Recordings, split: Split) -> tuple:
    """Recordings with the same events, where an accuracy is therefore not what it seems.

    Returns
    -------
    in_training, in_classes : list of (str, str)
        Ids of a recording and of its copy: in the training and the test set; in two classes.
        Recordings without events have no copies.
    """
    ids = recordings.ids
    labels = recordings.labels
    contents: list = list(recordings.hashes)
    is_empty = np.diff(recordings.offsets) == 0
    for index in np.flatnonzero(is_empty).tolist():
        contents[index] = index  # no copy of another recording without events
    first_in_training: dict = {}
    for index in (*split.train, *split.validation):
        first_in_training.setdefault(contents[index], index)
    in_training = []
    for index in split.test:
        trained = first_in_training.get(contents[index])
        if trained is not None:
            in_training.append((ids[trained], ids[index]))
    first: dict = {}
    in_classes = []
    for index, content in enumerate(contents):
        original = first.setdefault(content, index)
        if labels[original] != labels[index]:
            in_classes.append((ids[original], ids[index]))
    return in_training, in_classes


def split_as_published(parts, seed: int, validation_fraction: float = 0.0) -> Split:
    """The split of the source; validation samples are drawn from its training set.

    Parameters
    ----------
    parts : sequence of str
        ``"train"`` or ``"test"`` for each recording.
    seed : int
        Seed of the draw of validation samples.
    validation_fraction : float
        Share of the training set that is used for validation.

    Raises
    ------
    ValueError
        The source has no published split.
    """
    parts = np.array(parts, dtype=str)
    train, test = (np.flatnonzero(parts == part) for part in ("train", "test"))
    if not len(train) or not len(test):
        raise ValueError("has no folders train and test, of a published split")
    order = np.random.default_rng([seed, 0x9B71]).permutation(train)
    n_validation = round(len(train) * validation_fraction)
    test = np.random.default_rng(0x7E57).permutation(test)
    return Split(np.sort(order[n_validation:]), order[:n_validation], test, PUBLISHED)


def split_at_random(
    n_samples: int, seed: int, test_fraction: float = 0.2, validation_fraction: float = 0.0
) -> Split:
    """Split samples at random, as the paper does: 80-20, over samples and not over writers.

    Parameters
    ----------
    n_samples : int
    seed : int
    test_fraction : float
        Share of all samples that is used for testing.
    validation_fraction : float
        Share of the other samples that is used for validation.  The test samples do not depend on
        it.

    Returns
    -------
    Split

    Raises
    ------
    ValueError
        Training or test set would be empty.
    """
    order = np.random.default_rng([seed, 0x5711]).permutation(n_samples)
    n_test = round(n_samples * test_fraction)
    n_validation = round((n_samples - n_test) * validation_fraction)
    test, validation, train = np.split(order, [n_test, n_test + n_validation])
    if len(test) == 0 or len(train) == 0:
        raise ValueError(f"{n_samples} samples are too few for a split with {test_fraction} test")
    return Split(np.sort(train), validation, test)


def split_by_writers(writers: np.ndarray, seed: int, test_fraction: float = 0.2) -> Split:
    """Split samples so that no writer has both training and test samples.

    In random splits the training samples include each test writer's handwriting; in an application
    the writers are new.  Writers are drawn at random for the test set as long as each brings its
    size closer to the requested fraction.

    Parameters
    ----------
    writers : ndarray of int, shape (n_samples,)
        See :class:`pipeline.recordings.recordings.Recordings`.
    seed : int
    test_fraction : float
        Share of all samples that is used for testing, as closely as possible with whole writers.

    Returns
    -------
    Split
        Without validation samples.

    Raises
    ------
    ValueError
        Writers are not known, or there is only one.
    """
    writers = np.asarray(writers)
    if len(writers) == 0 or writers.min() < 0:
        raise ValueError("the writers of these recordings are not known")
    names, sizes = np.unique(writers, return_counts=True)
    if len(names) < 2:
        raise ValueError("all recordings are of one writer")
    n_test = len(writers) * test_fraction
    chosen: list = []
    size = 0
    rng = np.random.default_rng([seed, 0x3217])
    for index in rng.permutation(len(names)):
        nearer = abs(size + sizes[index] - n_test) < abs(size - n_test)
        if (nearer or not chosen) and len(chosen) < len(names) - 1:
            chosen.append(names[index])
            size += sizes[index]
    is_in_test = np.isin(writers, chosen)
    test = rng.permutation(np.flatnonzero(is_in_test))
    return Split(np.flatnonzero(~is_in_test), np.empty(0, np.int64), test, WRITERS)


def hold_out_samples(train: np.ndarray, seed: int):
    """Hold out some of the training samples, at least one, to select something on them.

    Parameters
    ----------
    train : ndarray of int
    seed : int

    Returns
    -------
    train, held_out : ndarray of int
        Indices of the recordings, in increasing order.
    """
    order = np.random.default_rng([seed, 0x4E1D]).permutation(train)
    count = max(1, round(HELD_OUT * len(order)))
    return np.sort(order[count:]), np.sort(order[:count])


def draw_check_samples(test: np.ndarray, n_samples: int, seed: int) -> np.ndarray:
    """Draw the samples of the check from the test set (paper, Section 3.2.2: 200 at random).

    Parameters
    ----------
    test : ndarray of int
        Indices of the test samples.
    n_samples, seed : int

    Returns
    -------
    ndarray of int, shape (n_samples,)
        Indices of samples, in the order in which they are presented.

    Raises
    ------
    ValueError
        There are fewer test samples than requested.
    """
    if n_samples > len(test):
        raise ValueError(f"{n_samples} samples requested, the test set has {len(test)}")
    return np.random.default_rng([seed, 0xC4EC]).choice(np.sort(test), n_samples, replace=False)
