"""Early decisions of a network: a confidence at every step, and a threshold for it.

The output of a network on events is a sum over the steps from a sample's start, trained as logits.
The confidence is an estimate of the probability that the current answer is right: the largest value
of the outputs' softmax or, better, the output of a trained confidence estimator (`Estimator`).  The
network decides in the first step in which the confidence reaches a threshold, or else at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Optional, Tuple

import numpy as np

# Units of the hidden layers of a confidence estimator.
HIDDEN_NEURONS = (32, 32)

# Number of the largest softmax values that are inputs of an estimator, in sorted order.
RANKS = 4

# Numbers of steps over which changes of the outputs are inputs of an estimator. They indicate
# whether writing continues, and which class gains evidence.
LAGS = (2, 5)

# Upper bound of the confidence. It is below 1, the threshold for deciding at the end only, which
# floating-point confidences could otherwise reach.
MAX_CONFIDENCE = np.nextafter(1.0, 0.0)


@dataclass(frozen=True)
class Estimator:
    """A confidence estimator: a small network on the host that reads the outputs.

    With p the softmax of the outputs at a step, the inputs x are the logarithms of p, its largest
    values in sorted order, the index of the largest class, the number of the step, and the changes
    of the outputs over the last steps (``LAGS``):

        h = relu(relu(x A + a) B + b),    confidence = 1 / (1 + exp(-h C - c)).

    The softmax alone ignores that an apparent 1 often becomes a 7, and that even a clear lead means
    little at the beginning.

    Attributes
    ----------
    kernels, biases : tuple of ndarray
        A, B, C and a, b, c; see :meth:`list_shapes`.
    """

    kernels: Tuple[np.ndarray, ...]
    biases: Tuple[np.ndarray, ...]

    @staticmethod
    def list_shapes(n_classes: int) -> dict:
        """Shape of each array by name, for networks with some number of classes."""
        features = min(RANKS, n_classes) + 2 * n_classes + 1 + len(LAGS) * n_classes
        sizes = (features, *HIDDEN_NEURONS, 1)
        shapes: dict = {}
        for index, (before, after) in enumerate(zip(sizes, sizes[1:]), 1):
            shapes[f"estimator.kernel{index}"] = (before, after)
            shapes[f"estimator.bias{index}"] = (after,)
        return shapes

    def to_arrays(self) -> dict:
        """The arrays by name, for a file."""
        names = Estimator.list_shapes(2)  # the names are the same for any number of classes
        arrays = [array for pair in zip(self.kernels, self.biases) for array in pair]
        return dict(zip(names, arrays))

    @classmethod
    def from_arrays(cls, arrays: dict, n_classes: int):
        """Make an estimator from arrays by name; other arrays are ignored.

        Returns
        -------
        Estimator or None
            None if none of its arrays exists.

        Raises
        ------
        ValueError
            Some arrays are missing, have another shape, or contain NaN or infinite values.
        """
        shapes = cls.list_shapes(n_classes)
        if not any(name in arrays for name in shapes):
            return None
        checked = []
        for name, shape in shapes.items():
            array = np.asarray(arrays[name], float) if name in arrays else None
            if array is None or array.shape != shape or not np.isfinite(array).all():
                raise ValueError(f"no array {name!r} of shape {shape} with finite values")
            checked.append(array)
        return cls(tuple(checked[::2]), tuple(checked[1::2]))

    def __call__(self, outputs, first: int = 0) -> np.ndarray:
        """Confidence at each step, from 0 to 1; see :func:`compute_confidence`."""
        signal = make_estimator_inputs(outputs, first)
        for kernel, bias in zip(self.kernels[:-1], self.biases[:-1]):
            signal = np.maximum(signal @ kernel + bias, 0)
        log_odds = np.clip((signal @ self.kernels[-1] + self.biases[-1])[..., 0], -50, 50)
        return 1 / (1 + np.exp(-log_odds))


def make_estimator_inputs(outputs, first: int = 0) -> np.ndarray:
    """Compute the inputs of a confidence estimator.

    Parameters
    ----------
    outputs : ndarray, shape (..., steps, classes)
        Accumulated readout from a sample's start; before that it is 0.
    first : int
        Index in the sample of the first of these steps.

    Returns
    -------
    ndarray, shape (..., steps, features)
    """
    outputs = np.asarray(outputs, float)
    steps, classes = outputs.shape[-2:]
    ahead = outputs - outputs.max(-1, keepdims=True)
    log_p = ahead - np.log(np.exp(ahead).sum(-1, keepdims=True))
    ranked = np.flip(np.sort(log_p, -1), -1)[..., :RANKS]
    is_largest = np.eye(classes)[outputs.argmax(-1)]
    step = np.broadcast_to(
        (first + np.arange(steps, dtype=float))[:, None], (*ranked.shape[:-1], 1)
    )
    changes = (outputs - delay_outputs(outputs, lag) for lag in LAGS)
    return np.concatenate([ranked, is_largest, log_p, step, *changes], -1)


def delay_outputs(outputs, n_steps: int) -> np.ndarray:
    """The values some steps earlier; 0 before the first step.

    Parameters
    ----------
    outputs : ndarray, shape (..., steps, classes)
    n_steps : int

    Returns
    -------
    ndarray of the same shape
    """
    outputs = np.asarray(outputs)
    silence = np.zeros_like(outputs[..., :n_steps, :])
    return np.concatenate([silence, outputs], -2)[..., : outputs.shape[-2], :]


class Threshold(NamedTuple):
    """A threshold of the confidence, and its results on the samples on which it was chosen.

    Attributes
    ----------
    value : float
        Confidence at which the network decides, from 0 to 1; no confidence reaches 1, which means a
        decision at the end.
    accuracy : float
        Share of right decisions.
    share : float
        Mean share of a sample's duration until the decision.
    """

    value: float
    accuracy: float
    share: float

    def to_json(self) -> dict:
        """The values by their names in files."""
        return {"confidence": self.value, "accuracy": self.accuracy, "share": self.share}


def compute_confidence(
    outputs, estimator: Optional[Estimator] = None, first: int = 0
) -> np.ndarray:
    """Confidence in the outputs at each step, to `MAX_CONFIDENCE`; 0 where all outputs are zero.

    An estimator is trained from the start of a recording to its last event.  Where outputs stay the
    same, in silence, its confidence stays, too.

    Parameters
    ----------
    outputs : ndarray, shape (..., steps, classes)
        Accumulated readout from a sample's start.  Before a spike has reached the readout they are
        zero, which is no answer.
    estimator : Estimator, optional
        Default: the largest share of the softmax.
    first : int
        Index in the sample of the first of these steps; only used by an estimator.

    Returns
    -------
    ndarray, shape (..., steps)
    """
    outputs = np.asarray(outputs, float)
    if estimator is not None:
        changed = (outputs != delay_outputs(outputs, 1)).any(-1)
        since = np.maximum.accumulate(np.where(changed, np.arange(changed.shape[-1]), 0), -1)
        confidence = np.take_along_axis(estimator(outputs, first), since, -1)
    else:
        confidence = 1 / np.exp(outputs - outputs.max(-1, keepdims=True)).sum(-1)
    return np.where(outputs.any(-1), np.minimum(confidence, MAX_CONFIDENCE), 0.0)


def continue_confidence(
    outputs, known, estimator: Optional[Estimator] = None, first: int = 0
) -> np.ndarray:
    """The confidence at the steps that follow those whose confidence is known.

    Parameters
    ----------
    outputs : ndarray, shape (steps, classes)
        Accumulated readout at all steps.
    known : ndarray, shape (n,)
        Confidence at the first steps.
    estimator, first
        As in :func:`compute_confidence`.

    Returns
    -------
    ndarray, shape (steps - n,)
        The last values of :func:`compute_confidence` of all outputs.
    """
    n = len(known)
    if n == 0 or estimator is None:
        return compute_confidence(outputs[n:], estimator, first + n)
    start = max(0, n - max(LAGS) - 1)
    confidence = compute_confidence(outputs[start:], estimator, first + start)[n - start :]
    changed = (outputs[n:] != outputs[n - 1 : -1]).any(axis=1)
    unchanged = len(changed) if not changed.any() else int(changed.argmax())
    confidence[:unchanged] = known[-1]
    return confidence


def compute_probabilities(outputs, confidence) -> np.ndarray:
    """Probabilities of the classes, of which the largest is the confidence in the answer.

    They are the softmax of the outputs at the temperature that gives this largest value, so that
    one number says how sure the network is (C. Guo et al., "On calibration of modern neural
    networks", ICML 2017, have one temperature for all samples).

    Parameters
    ----------
    outputs : ndarray, shape (..., n_classes)
    confidence : ndarray, shape (...)
        Below 1 / n_classes, all classes get 1 / n_classes.  If several outputs are the largest,
        each has less.

    Returns
    -------
    ndarray, shape (..., n_classes)
    """
    ahead = outputs - outputs.max(-1, keepdims=True)
    lowest = np.full(np.shape(confidence), -5.0)
    highest = np.full(np.shape(confidence), 3.0)
    for _ in range(20):  # bisection of the logarithm of the inverse temperature
        middle = (lowest + highest) / 2
        powers = np.exp(10 ** middle[..., None] * ahead)
        shares = powers / powers.sum(-1, keepdims=True)
        above = shares.max(axis=-1) > confidence
        lowest = np.where(above, lowest, middle)
        highest = np.where(above, middle, highest)
    return shares


def decide(outputs, threshold: float, estimator: Optional[Estimator] = None, first: int = 0):
    """Step and class of each sample's decision.

    Parameters
    ----------
    outputs : ndarray, shape (n_samples, steps, classes)
    threshold : float
        Threshold of the confidence.
    estimator, first
        As in :func:`compute_confidence`.

    Returns
    -------
    steps : ndarray of int, shape (n_samples,)
        Index in ``outputs``; the last one if the confidence never reaches the threshold.
    classes : ndarray of int, shape (n_samples,)
    """
    return find_decisions(
        np.asarray(outputs), compute_confidence(outputs, estimator, first), threshold
    )


def find_decisions(outputs, confidence, threshold: float):
    """As :func:`decide`, for outputs whose ``confidence`` at each step is known."""
    reached = confidence >= threshold
    reached[:, -1] = True
    steps = reached.argmax(1)
    return steps, outputs[np.arange(len(steps)), steps].argmax(-1)


def compute_share_of_time(steps, last_step) -> np.ndarray:
    """Share of a sample's duration until its decision, at most 1.

    Parameters
    ----------
    steps, last_step : ndarray of int, shape (n_samples,)
        Steps of the decision and of the sample's last event, from 0.
    """
    return np.minimum((np.asarray(steps) + 1) / (np.asarray(last_step) + 1), 1)


def choose_threshold(
    outputs,
    labels,
    last_step,
    loss: float = 0.005,
    estimator: Optional[Estimator] = None,
    weights=None,
) -> Threshold:
    """Choose the threshold of the earliest decisions with a bounded loss, on validation samples.

    Parameters
    ----------
    outputs : ndarray, shape (n_samples, steps, classes)
    labels, last_step : ndarray of int, shape (n_samples,)
    loss : float
        Maximum difference to the accuracy at the last step.
    estimator : Estimator, optional
        As in :func:`compute_confidence`.
    weights : ndarray, shape (n_samples,), optional
        Weight of each sample; default: equal weights.

    Returns
    -------
    Threshold
    """
    labels = np.asarray(labels)
    outputs = np.asarray(outputs)

    def compute_mean(values):
        return float(np.average(values, weights=weights))

    at_the_end = compute_mean(outputs[:, -1].argmax(-1) == labels)
    confidence = compute_confidence(outputs, estimator)
    best = Threshold(1.0, at_the_end, 1.0)
    for candidate in 1 - np.geomspace(0.5, 1e-4, 200):
        steps, classes = find_decisions(outputs, confidence, candidate)
        threshold = Threshold(
            float(candidate),
            compute_mean(classes == labels),
            compute_mean(compute_share_of_time(steps, last_step)),
        )
        if threshold.accuracy >= at_the_end - loss and threshold.share < best.share:
            best = threshold
    return best
