"""Training, validation and test samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Split:
    """Indices of samples; the three parts have none in common and together are all samples.

    Attributes
    ----------
    train, validation, test : ndarray of int
        In increasing order.  Settings are chosen on ``validation``, never on ``test``.
    """

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray


def random_split(
    n_samples: int, seed: int, test_fraction: float = 0.2, validation_fraction: float = 0.0
) -> Split:
    """Split samples at random, as the paper does: 80-20, over samples and not over writers.

    Parameters
    ----------
    n_samples : int
    seed : int
    test_fraction : float
        Share of all samples that is for testing.
    validation_fraction : float
        Share of the others that is for validation.  The test samples do not depend on it.

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
    return Split(np.sort(train), np.sort(validation), np.sort(test))


def draw_check_samples(test: np.ndarray, n_samples: int, seed: int) -> np.ndarray:
    """Draw the samples of the check from the test split (paper, Section 3.2.2: 200 at random).

    Returns
    -------
    ndarray of int, shape (n_samples,)
        Indices of samples, in the order in which they are shown.

    Raises
    ------
    ValueError
        There are fewer test samples than asked for.
    """
    if n_samples > len(test):
        raise ValueError(f"{n_samples} samples asked for, the test split has {len(test)}")
    return np.random.default_rng([seed, 0xC4EC]).choice(test, n_samples, replace=False)
