"""Responses to some training samples, so that a readout can be refitted without forgetting them.

The readout on the host is linear: its scores are ``weights @ x + bias``, where ``x`` is the mean of
its input while a sample is read, the low-pass filtered spikes of the last layer of neurons.  For a
readout in parts, ``x`` has the sums of each part, divided by the steps of all of them.
The bundle has ``x`` for some training samples, with their labels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import limits


@dataclass(frozen=True)
class Rehearsal:
    """Responses of the last layer of neurons to training samples.

    Attributes
    ----------
    responses : ndarray of float32, shape (n_samples, inputs of the readout)
        Mean input of the readout, see the module's description.
    labels : ndarray of uint16, shape (n_samples,)
    """

    responses: np.ndarray
    labels: np.ndarray

    def __len__(self):
        return len(self.labels)

    def arrays(self) -> dict:
        """The arrays by name, for a file; half precision is sufficient for the responses."""
        responses = self.responses.astype(np.float16)
        return {"rehearsal.responses": responses, "rehearsal.labels": self.labels}

    @classmethod
    def from_arrays(cls, arrays: dict, inputs: int, classes: int):
        """The inverse of :meth:`arrays`; other arrays are ignored.

        Parameters
        ----------
        arrays : dict
        inputs, classes : int
            Numbers of inputs and classes of the readout.

        Returns
        -------
        Rehearsal or None
            None if none of its arrays exists.

        Raises
        ------
        ValueError
            An array is missing, has another shape, or has invalid values.
        """
        names = ("rehearsal.responses", "rehearsal.labels")
        if not any(name in arrays for name in names):
            return None
        if not all(name in arrays for name in names):
            raise ValueError("responses or labels of the rehearsal are missing")
        responses, labels = (np.asarray(arrays[name]) for name in names)
        kinds = responses.dtype.kind, labels.dtype.kind
        if kinds[0] != "f" or kinds[1] not in "iu" or labels.ndim != 1:
            raise ValueError("responses or labels of the rehearsal are of the wrong kind")
        if responses.shape != (len(labels), inputs) or not 1 <= len(labels) <= limits.SAMPLES:
            raise ValueError("responses of the rehearsal do not fit the readout")
        if labels.min() < 0 or labels.max() >= classes:
            raise ValueError(f"labels of the rehearsal are not from 0 to {classes - 1}")
        if not np.isfinite(responses).all():
            raise ValueError("responses of the rehearsal have NaN or infinite values")
        return cls(responses.astype(np.float32), labels.astype(np.uint16))
