"""Responses of a network to some of its training samples, with which a readout is refitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np

from .. import limits
from .layer import require


@dataclass(frozen=True)
class Rehearsal:
    """Responses to some training samples, so that a readout can be refitted without forgetting.

    The readout on the host is linear: its scores are ``weights @ x + bias``, where ``x`` is the
    mean of its input while a sample is read, the low-pass filtered spikes of the last layer of
    neurons.  For a readout in sections, ``x`` has the sums of each section, divided by the steps of
    all.

    Attributes
    ----------
    responses : ndarray of float32, shape (n_samples, inputs of the readout)
        ``x`` of each sample.
    labels : ndarray of uint16, shape (n_samples,)
    """

    responses: np.ndarray
    labels: np.ndarray

    def __len__(self):
        return len(self.labels)

    def to_arrays(self) -> dict:
        """The arrays by name, for a file; half precision is sufficient for the responses."""
        responses = self.responses.astype(np.float16)
        return {"rehearsal.responses": responses, "rehearsal.labels": self.labels}

    @classmethod
    def from_arrays(cls, arrays: dict, n_inputs: int, n_classes: int) -> Optional[Rehearsal]:
        """The inverse of :meth:`to_arrays`, for a readout's numbers of inputs and classes.

        Returns None if none of its arrays exists; other arrays are ignored.

        Raises
        ------
        UserError
            An array has another shape, or invalid values.
        KeyError
            An array is missing.
        """
        if not any(name.startswith("rehearsal.") for name in arrays):
            return None
        responses = arrays["rehearsal.responses"]
        labels = arrays["rehearsal.labels"]
        valid = (
            (responses.dtype.kind, labels.ndim) == ("f", 1)
            and labels.dtype.kind in "iu"
            and responses.shape == (len(labels), n_inputs)
            and 1 <= len(labels) <= limits.SAMPLES
            and np.isfinite(responses).all()
            and 0 <= labels.min() <= labels.max() < n_classes
        )
        require(valid, "rehearsal", "its arrays do not fit the readout")
        return cls(responses.astype(np.float32), labels.astype(np.uint16))
