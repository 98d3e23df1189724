"""Recordings as networks see them: what they are shown of each, its label, and who is for what."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deploy.errors import UserError
from pipeline.inputs.images import tactile_images
from pipeline.inputs.library import recordings_of
from pipeline.inputs.splits import Split, random_split, writer_split
from pipeline.recordings.events import Recordings
from pipeline.settings import Settings

KINDS = ("random", "writers")
"""Of splits: over samples, as in the paper; or nobody writes both training and test samples."""

TOO_SMALL = "ask for fewer (SAMPLES, or check.samples) or give more data"
"""What to do where there are too few samples."""


@dataclass(frozen=True)
class Dataset:
    """Recordings with what networks are shown of them, loaded, divided and made in one place.

    Attributes
    ----------
    recordings : Recordings
    inputs : ndarray, shape (n_samples, ...)
        See :func:`inputs_of`.
    split : Split
    """

    recordings: Recordings
    inputs: np.ndarray
    split: Split

    @classmethod
    def of(cls, settings: Settings, jobs: int = 1, warn=None) -> Dataset:
        """The recordings that settings ask for, divided by the settings' own seed.

        Parameters
        ----------
        settings : Settings
        jobs : int
            Processes for recordings that are not in the cache.
        warn : callable, optional
            Called with one line for each file that was left out.

        Raises
        ------
        UserError
            The source cannot be read, or is too small for the split.
        """
        parts = settings.split
        recordings = recordings_of(settings.data, jobs, warn)
        try:
            split = split_of(
                recordings, settings.seed, parts.test_fraction, parts.validation_fraction
            )
        except ValueError as error:
            raise UserError(f"{settings.data.source}: {error}; {TOO_SMALL}") from error
        return cls(recordings, inputs_of(recordings, settings), split)

    def __len__(self):
        return len(self.recordings)

    @property
    def labels(self) -> np.ndarray:
        """The digit of each sample, shape (n_samples,)."""
        return self.recordings.labels

    def part(self, name: str):
        """(inputs, labels) of ``"train"``, ``"validation"`` (None if empty) or ``"test"``."""
        index = getattr(self.split, name)
        return (self.inputs[index], self.labels[index]) if len(index) else None

    def divided(self, seed: int, test_fraction: float, kind: str = "random") -> Dataset:
        """The same samples with another split, without a validation part; see :func:`split_of`."""
        return replace(self, split=split_of(self.recordings, seed, test_fraction, kind=kind))


def inputs_of(recordings: Recordings, settings: Settings) -> np.ndarray:
    """What networks are shown of each recording.

    Returns
    -------
    ndarray of float32, shape (n_samples, 10, 10, 1)
        Tactile images.
    """
    image = settings.image
    return tactile_images(recordings, image.aggregation, image.normalisation)


def split_of(
    recordings: Recordings,
    seed: int,
    test_fraction: float,
    validation_fraction: float = 0.0,
    kind: str = "random",
) -> Split:
    """Divide recordings.

    Parameters
    ----------
    recordings : Recordings
    seed : int
    test_fraction, validation_fraction : float
        See :func:`pipeline.inputs.splits.random_split`; splits by writers have no validation part.
    kind : str
        One of :data:`KINDS`.

    Raises
    ------
    ValueError
        Too few samples, or writers that are not known.
    """
    if kind == "writers":
        return writer_split(recordings.writers, seed, test_fraction)
    return random_split(len(recordings), seed, test_fraction, validation_fraction)
