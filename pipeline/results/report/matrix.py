"""Values for drawing a confusion matrix, independent of the drawing library."""

from __future__ import annotations

import numpy as np

from pipeline.data.words import shortened_apart

LONGEST_NAME = 24
"""Characters of a class's name that a drawing of a confusion matrix has room for."""


def confusion_shares(matrix) -> np.ndarray:
    """A confusion matrix as shares of each label's samples; 0 where a label has none."""
    matrix = np.asarray(matrix)
    return matrix / np.maximum(matrix.sum(axis=1, keepdims=True), 1)


def names_beside(names, classes: int) -> list:
    """The labels of the rows and columns of a confusion matrix.

    Parameters
    ----------
    names : sequence of str or None
        Names of the classes; None for numbers from 0.
    classes : int

    Returns
    -------
    list of str
    """
    return shortened_apart(list(names or map(str, range(classes))), LONGEST_NAME)
