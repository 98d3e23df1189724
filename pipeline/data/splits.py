"""Splits of samples into training, validation and test samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

HELD_OUT = 0.1
"""Share of the training samples that is held out if there are no validation samples."""


@dataclass(frozen=True)
class Split:
    """Indices of samples in three disjoint parts, which together are all samples.

    Attributes
    ----------
    train : ndarray of int
        In increasing order.
    validation, test : ndarray of int
        In random order: recordings are sorted by digit, and a network whose state is not reset
        between samples has a higher accuracy if both have the same label.  Settings are chosen
        on ``validation``, never on ``test``.
    """

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray

    def held_out(self, seed: int) -> tuple:
        """Samples to train on, and held-out samples: for validation or else of the training.

        Parameters
        ----------
        seed : int
            Seed of :func:`hold_out`.
        """
        if len(self.validation):
            return self.train, self.validation
        return hold_out(self.train, seed)


def random_split(
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
        Training or test part would be empty.
    """
    order = np.random.default_rng([seed, 0x5711]).permutation(n_samples)
    n_test = round(n_samples * test_fraction)
    n_validation = round((n_samples - n_test) * validation_fraction)
    test, validation, train = np.split(order, [n_test, n_test + n_validation])
    if len(test) == 0 or len(train) == 0:
        raise ValueError(f"{n_samples} samples are too few for a split with {test_fraction} test")
    return Split(np.sort(train), validation, test)


def writer_split(writers: np.ndarray, seed: int, test_fraction: float = 0.2) -> Split:
    """Split samples so that no writer has both training and test samples.

    In random splits the training samples include each test writer's handwriting; in an application
    the writers are new.  Writers are drawn at random for the test part as long as each brings its
    size closer to the requested fraction.

    Parameters
    ----------
    writers : ndarray of int, shape (n_samples,)
        See :class:`pipeline.data.events.Recordings`.
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
    wanted, chosen, size = len(writers) * test_fraction, [], 0
    rng = np.random.default_rng([seed, 0x3217])
    for index in rng.permutation(len(names)):
        nearer = abs(size + sizes[index] - wanted) < abs(size - wanted)
        if (nearer or not chosen) and len(chosen) < len(names) - 1:
            chosen.append(names[index])
            size += sizes[index]
    in_test = np.isin(writers, chosen)
    test = rng.permutation(np.flatnonzero(in_test))
    return Split(np.flatnonzero(~in_test), np.empty(0, np.int64), test)


def hold_out(train: np.ndarray, seed: int):
    """Hold out some of the training samples, at least one, to select something on them.

    Parameters
    ----------
    train : ndarray of int
    seed : int

    Returns
    -------
    train, held_out : ndarray of int
        In increasing order.
    """
    order = np.random.default_rng([seed, 0x4E1D]).permutation(train)
    count = max(1, round(HELD_OUT * len(order)))
    return np.sort(order[count:]), np.sort(order[:count])


def draw_check_samples(test: np.ndarray, n_samples: int, seed: int) -> np.ndarray:
    """Draw the samples of the check from the test split (paper, Section 3.2.2: 200 at random).

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
        raise ValueError(f"{n_samples} samples requested, the test split has {len(test)}")
    return np.random.default_rng([seed, 0xC4EC]).choice(np.sort(test), n_samples, replace=False)
