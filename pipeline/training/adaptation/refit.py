"""Refit a readout to one person, while it stays accurate for other people.

With x the responses at the input of the readout, W its weights and p = softmax(W x), the change D
of the weights minimises

    mean over the person's samples of -log p_c + rehearsal * mean over kept samples of -log p_c
        + pull / 2 * |D|^2

with the responses in units of their usual length, so that ``pull`` has the same meaning for all
networks.  This is a multinomial logistic regression with a regularisation towards the old weights
(a Gaussian prior around them; C. Chelba and A. Acero, "Adaptation of maximum entropy capitalizer:
little data can help a lot", EMNLP 2004).  The kept training samples prevent forgetting (rehearsal;
A. Robins, Connection Science 7, 1995).  ``rehearsal`` and ``pull`` are chosen by cross-validation
on the person's own samples.
"""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_softmax
from threadpoolctl import threadpool_limits

from deploy.network.chip import LOIHI
from deploy.network.rehearsal import Rehearsal

# Strengths of regularisation and of rehearsal among which cross-validation chooses.
PULLS = (3e-4, 3e-3)
REHEARSALS = (0.3, 1.0, 3.0)

FOLDS = 5

# Directions of the responses in which the weights may change, those of the largest variance: a
# layer of many neurons would take minutes for nothing.
MAX_DIRECTIONS = 96

# Maximum loss of accuracy on the kept samples in cross-validation, similar to the loss of other
# people.
MAX_KEPT_LOSS = 0.015


@dataclass(frozen=True)
class Person:
    """Responses to a person's samples and to augmented copies of them.

    Attributes
    ----------
    responses : ndarray, shape (n, inputs)
        Responses to the original samples.
    labels : ndarray of int, shape (n,)
    copies : ndarray, shape (n, n_copies, inputs)
        Responses to augmented copies, which are used for training only.
    """

    responses: np.ndarray
    labels: np.ndarray
    copies: np.ndarray

    def __len__(self):
        return len(self.labels)

    def select_with_copies(self, indices) -> tuple:
        """Responses and labels for the fit: some samples and their copies."""
        originals = self.responses[indices, None]
        responses = np.concatenate([originals, self.copies[indices]], axis=1)
        n_copies, n_inputs = responses.shape[1:]
        return responses.reshape(-1, n_inputs), np.repeat(self.labels[indices], n_copies)


@dataclass(frozen=True)
class Refit:
    """A refitted readout and how good it is in cross-validation.

    Attributes
    ----------
    weights : ndarray, shape (classes, inputs)
        Weights rounded to 255 levels.
    pull, rehearsal : float
        The chosen values; see the module's description.
    before, after : ndarray of bool, shape (n_samples,)
        For each sample of the person, whether the old readout is right, and whether a readout that
        was refitted without this sample is right.
    kept_before, kept_after : ndarray of bool
        The same for the kept training samples.
    """

    weights: np.ndarray
    pull: float
    rehearsal: float
    before: np.ndarray
    after: np.ndarray
    kept_before: np.ndarray
    kept_after: np.ndarray

    @property
    def helps(self) -> bool:
        """True if the accuracy improves for the person and is almost unchanged for other people."""
        kept_loss = self.kept_before.mean() - self.kept_after.mean()
        return bool(self.after.sum() > self.before.sum() and kept_loss <= MAX_KEPT_LOSS)


# In one thread: matrix products of a few hundred rows take 12 times as long in several threads.
@threadpool_limits.wrap(limits=1, user_api="blas")
def fit_readout(weights, bias, person: Person, kept: Rehearsal, seed: int = 0, scale: float = 1.0):
    """Refit a readout, with ``pull`` and ``rehearsal`` chosen by cross-validation.

    Parameters
    ----------
    weights : ndarray, shape (classes, inputs)
    bias : ndarray, shape (classes,)
        Bias of the readout, which is not changed.
    person : Person
    kept : Rehearsal
    seed : int
        Seed of the folds.
    scale : float
        Factor that converts scores to the logits of the training.

    Returns
    -------
    Refit
        The best fit; see :attr:`Refit.helps` for its use.
    """
    weights = np.asarray(weights, float)
    bias = np.asarray(bias, float)
    problem = _Regression(weights, bias, person, kept, scale)
    folds = _Folds.draw(person, kept, seed)
    before = problem.compute_log_probabilities(problem.weights, person.responses)
    kept_before = _find_right(
        problem.compute_log_probabilities(problem.weights, kept.responses), kept.labels
    )

    def rank_trial(trial):
        """Keeping the accuracy for others comes first, then the likelihood for the person."""
        kept_loss = kept_before.mean() - trial.kept_after.mean()
        return kept_loss <= MAX_KEPT_LOSS, trial.likelihood

    trials = [
        _cross_validate(problem, person, kept, folds, pull, rehearsal)
        for pull, rehearsal in itertools.product(PULLS, REHEARSALS)
    ]
    best = max(trials, key=rank_trial)
    samples, labels = person.select_with_copies(np.arange(len(person)))
    all_kept = np.ones(len(kept), bool)
    refitted = problem.solve(samples, labels, all_kept, best.pull, best.rehearsal)
    return Refit(
        weights=round_to_8_bits(refitted),
        pull=best.pull,
        rehearsal=best.rehearsal,
        before=_find_right(before, person.labels),
        after=best.after,
        kept_before=kept_before,
        kept_after=best.kept_after,
    )


class _Folds(NamedTuple):
    """The folds of a cross-validation.

    Attributes
    ----------
    person, kept : ndarray of int
        The fold of each sample of the person, and of each kept sample.
    """

    person: np.ndarray
    kept: np.ndarray

    @classmethod
    def draw(cls, person, kept, seed):
        """Draw the folds; the samples of a class are in as many folds as possible."""
        folds = _draw_folds(person.labels, seed)
        order = np.random.default_rng([seed, 1]).permutation(len(kept))
        return cls(folds, order % (folds.max() + 1))


class _Trial(NamedTuple):
    """The result of cross-validating a pair of ``pull`` and ``rehearsal``.

    Attributes
    ----------
    pull, rehearsal : float
    after, kept_after : ndarray of bool
        See :class:`Refit`.
    likelihood : float
        Mean logarithm of the probability of the right class.
    """

    pull: float
    rehearsal: float
    after: np.ndarray
    kept_after: np.ndarray
    likelihood: float


def _cross_validate(problem, person, kept, folds, pull, rehearsal) -> _Trial:
    """Predict each sample with a readout that was refitted to the other folds."""
    log_p = np.empty((len(person), len(problem.weights)))
    kept_after = np.empty(len(kept), bool)
    for fold in range(folds.person.max() + 1):
        is_out = folds.person == fold
        is_kept_out = folds.kept == fold
        samples, labels = person.select_with_copies(~is_out)
        solution = problem.solve(samples, labels, ~is_kept_out, pull, rehearsal)
        refitted = round_to_8_bits(solution)
        log_p[is_out] = problem.compute_log_probabilities(refitted, person.responses[is_out])
        log_kept = problem.compute_log_probabilities(refitted, kept.responses[is_kept_out])
        kept_after[is_kept_out] = _find_right(log_kept, kept.labels[is_kept_out])
    likelihood = log_p[np.arange(len(person)), person.labels].mean()
    return _Trial(pull, rehearsal, _find_right(log_p, person.labels), kept_after, likelihood)


def round_to_8_bits(weights) -> np.ndarray:
    """Weights rounded to 255 levels; the largest magnitude has the last level."""
    unit = np.abs(weights).max() / LOIHI.weight_levels
    return np.rint(weights / unit) * unit if unit > 0 else np.array(weights)


class _Regression:
    """The regression's constants: old weights, kept samples, units."""

    def __init__(self, weights, bias, person, kept, scale):
        self.weights = weights
        self.bias = bias
        self._scale = scale
        self._kept = kept.responses.astype(float)
        self._classes = np.eye(len(weights))
        self._kept_labels = self._classes[kept.labels]
        self._kept_logits = self._compute_logits(weights, self._kept)
        self._unit = max(np.sqrt((self._kept**2).sum(axis=1).mean()), 1e-12)
        samples, _ = person.select_with_copies(np.arange(len(person)))
        responses = np.concatenate([self._kept, samples])
        self._directions = np.linalg.eigh(responses.T @ responses)[1][:, -MAX_DIRECTIONS:]

    def _compute_logits(self, weights, responses):
        return self._scale * (responses @ weights.T + self.bias)

    def compute_log_probabilities(self, weights, responses):
        """Logarithm of the softmax, shape (n_samples, classes)."""
        return log_softmax(self._compute_logits(weights, responses), axis=1)

    def solve(self, responses, labels, kept, pull, rehearsal):
        """Refit the weights.

        Parameters
        ----------
        responses : ndarray, shape (n, inputs)
            Responses to samples of the person.
        labels : ndarray of int, shape (n,)
        kept : ndarray of bool
            Which of the kept samples are used.
        pull, rehearsal : float
            See the module's description.

        Returns
        -------
        ndarray, shape (classes, inputs)
        """
        units = self._directions / self._unit
        person_rows = responses @ units
        kept_rows = self._kept[kept] @ units
        logits = self._compute_logits(self.weights, responses), self._kept_logits[kept]
        targets = self._classes[labels], self._kept_labels[kept]

        def compute_loss(flat):
            change = flat.reshape(len(self.weights), -1)
            value = pull / 2 * (flat**2).sum()
            slope = pull * change
            for share, rows, offset, target in zip(
                (1.0, rehearsal), (person_rows, kept_rows), logits, targets, strict=True
            ):
                log_p = log_softmax(offset + rows @ change.T, axis=1)
                value = value - share * (log_p * target).sum() / len(rows)
                slope = slope + share * (np.exp(log_p) - target).T @ rows / len(rows)
            return value, slope.ravel()

        minimum = minimize(
            compute_loss, np.zeros(len(self.weights) * units.shape[1]), jac=True, method="L-BFGS-B",
            options={"maxiter": 100, "ftol": 1e-7},
        )  # fmt: skip
        change = minimum.x.reshape(len(self.weights), -1) @ units.T / self._scale
        return self.weights + change


def _draw_folds(labels, seed):
    """The fold of each sample; the samples of a class are in as many folds as possible."""
    order = np.random.default_rng([seed, 0]).permutation(len(labels))
    order = order[np.argsort(np.asarray(labels)[order], kind="stable")]
    folds = np.empty(len(labels), int)
    folds[order] = np.arange(len(labels)) % min(FOLDS, len(labels))
    return folds


def _find_right(log_p, labels):
    """True for samples whose most probable class is that of their label."""
    return log_p.argmax(axis=1) == labels
