"""The readout during a sample: its sections, and its means and sums from step to step.

The score of a class at a step is the mean of its output from ``readout_start`` up to that step
(plus the readout's bias).
"""

from __future__ import annotations

import numpy as np

from .decision import continue_confidence
from .spec import NetworkSpec


def select_readout(spec: NetworkSpec, output: np.ndarray, first: int = 0) -> np.ndarray:
    """The readout of the section of the presentation that each step belongs to.

    Parameters
    ----------
    spec : NetworkSpec
    output : ndarray, shape (..., steps, sections * n_classes)
        The probe of the readout.
    first : int
        Number in the sample, from 0, of the first of these steps.

    Returns
    -------
    ndarray, shape (..., steps, n_classes)
    """
    readout = spec.layers[-1]
    if readout.n_sections == 1:
        return output
    steps = np.arange(output.shape[-2])
    by_section = output.reshape(*output.shape[:-1], readout.n_sections, readout.size)
    return by_section[..., steps, readout.find_section(first + steps), :]


def compute_running_sums(spec: NetworkSpec, output: np.ndarray) -> np.ndarray:
    """Accumulated readout during a sample, from which early decisions are made.

    Parameters
    ----------
    spec, output
        As in :func:`deploy.network.responses.compute_responses`.

    Returns
    -------
    ndarray, shape (n_samples, steps - readout_start, n_classes)
        Sums of the readout from ``readout_start`` on.
    """
    return sum_running_means(spec, compute_running_means(spec, output))


def sum_running_means(spec, means):
    """Sums, computed from the running means."""
    return round_scores(means * np.arange(1, means.shape[1] + 1)[:, None], find_score_unit(spec))


def compute_running_means(spec, output):
    """Running means of the readout from ``readout_start`` on."""
    window = output[:, spec.presentation.readout_start :]
    totals = np.cumsum(window, axis=1)
    counts = np.arange(1, window.shape[1] + 1)
    return _compute_mean(spec, totals, counts[:, None])


def _compute_mean(spec, total, count):
    """The mean of a readout, with its bias, from a total over some steps."""
    readout = spec.layers[-1]
    bias = readout.bias if readout.neurons is None else 0.0
    return total / count + bias


class RunningReadout:
    """The accumulated readout of one sample, some steps at a time.

    It is as :func:`deploy.network.responses.compute_responses` has it.

    Parameters
    ----------
    spec : NetworkSpec
    steps : int
        Maximum number of steps.

    Attributes
    ----------
    n_steps : int
        Number of steps so far.
    """

    def __init__(self, spec: NetworkSpec, steps: int):
        self._spec = spec
        self._unit = find_score_unit(spec)
        self._start = spec.presentation.readout_start
        classes = spec.layers[-1].size
        self._total = np.zeros((1, classes))
        self._means = np.zeros((max(steps - self._start, 0), classes))
        self._sums = np.zeros_like(self._means)
        self._confidences = np.zeros(len(self._sums))
        self._spoke = np.zeros(len(self._sums), bool)
        self.n_steps = 0

    @property
    def sums(self) -> np.ndarray:
        """Sums from ``readout_start`` on, shape (n, classes); see :func:`compute_running_sums`."""
        return self._sums[: self._n_read]

    @property
    def confidences(self) -> np.ndarray:
        """The confidence at each step from ``readout_start`` on, shape (n,)."""
        return self._confidences[: self._n_read]

    @property
    def spoke(self) -> np.ndarray:
        """False as long as the output is empty, at each step from ``readout_start`` on."""
        return self._spoke[: self._n_read]

    @property
    def _n_read(self):
        return max(self.n_steps - self._start, 0)

    def compute_scores(self, step: int) -> np.ndarray:
        """Scores of the classes after some number of steps, above ``readout_start``."""
        return round_scores(self._means[step - self._start - 1], self._unit)

    def append(self, output: np.ndarray):
        """Add the readout of the next steps.

        Parameters
        ----------
        output : ndarray, shape (steps, sections * n_classes)
        """
        n_done = self._n_read
        values = select_readout(self._spec, output, self.n_steps)
        window = values[max(self._start - self.n_steps, 0) :]
        self.n_steps += len(values)
        if not len(window):
            return
        added = slice(n_done, n_done + len(window))
        # A cumulative sum adds in the same order, whether it is interrupted or not.
        totals = np.cumsum(np.concatenate([self._total, window]), axis=0)[1:]
        counts = np.arange(added.start + 1, added.stop + 1)[:, None]
        self._total = totals[-1:]
        self._means[added] = _compute_mean(self._spec, totals, counts)
        self._sums[added] = round_scores(self._means[added] * counts, self._unit)
        before = self._spoke[n_done - 1] if n_done else False
        self._spoke[added] = np.logical_or.accumulate((window != 0).any(axis=1)) | before
        estimator = self._spec.estimator
        known = self._confidences[:n_done]
        sums = self._sums[: added.stop]
        self._confidences[added] = continue_confidence(sums, known, estimator, self._start)


def find_score_unit(spec: NetworkSpec) -> float:
    """Unit to which scores are rounded: 1, or a power of ten for a readout of unusual scale.

    Scaling all weights and biases of the readout, even by 1e-25, does not change the decisions.
    """
    readout = spec.layers[-1]
    largest = max(np.abs(readout.weights).max(initial=0), np.abs(readout.bias).max(initial=0))
    if readout.neurons is not None or largest == 0 or 1e-3 <= largest <= 1e3:
        return 1.0
    return 10.0 ** float(np.floor(np.log10(largest)))


def round_scores(scores: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """Round away the last bits, so that the same spikes give the same scores on every target.

    Targets add the same spikes in different orders, which must not resolve a tie.

    Parameters
    ----------
    scores : ndarray
    unit : float
        See :func:`find_score_unit`.

    Returns
    -------
    ndarray
        Scores rounded to 1e-9 of the unit.
    """
    return np.round(scores / unit, 9) * unit
