"""Refit a linear readout to one person while keeping its accuracy for other people.

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

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from deploy.network.rehearsal import Rehearsal

PULLS = (3e-4, 3e-3)
# Strengths of regularisation and of rehearsal among which cross-validation chooses.
REHEARSALS = (0.3, 1.0, 3.0)

FOLDS = 5

# Directions of the responses in which the weights may change, those of the largest variance: a
# layer of many neurons would take minutes without a gain.
MOST_DIRECTIONS = 96

# The largest weight in integers: 8 bits with the sign.
LEVELS = 127

# Maximum loss of accuracy on the kept samples in cross-validation, similar to the loss of other
# people.
MOST_LOST = 0.015


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

    def learned(self, indices) -> tuple:
        """Responses and labels for the fit: some samples and their copies."""
        own, copies = self.responses[indices], self.copies[indices]
        every = np.concatenate([own[:, None], copies], axis=1)
        return every.reshape(-1, own.shape[1]), np.repeat(self.labels[indices], every.shape[1])


@dataclass(frozen=True)
class Refit:
    """A refitted readout and how good it is in cross-validation.

    Attributes
    ----------
    weights : ndarray, shape (classes, inputs)
        Weights rounded to 255 levels.
    exact : ndarray, shape (classes, inputs)
        Weights before rounding.
    pull, rehearsal : float
        The chosen values; see the module's description.
    before, after : ndarray of bool, shape (n_samples,)
        For each sample of the person, whether the old readout is right, and whether a readout that
        was refitted without this sample is right.
    kept_before, kept_after : ndarray of bool
        The same for the kept training samples.
    """

    weights: np.ndarray
    exact: np.ndarray
    pull: float
    rehearsal: float
    before: np.ndarray
    after: np.ndarray
    kept_before: np.ndarray
    kept_after: np.ndarray

    @property
    def helps(self) -> bool:
        """True if the accuracy improves for the person and is almost unchanged for other people."""
        lost = self.kept_before.mean() - self.kept_after.mean()
        return bool(self.after.sum() > self.before.sum() and lost <= MOST_LOST)


# In one thread: matrix products of a few hundred rows take 12 times as long in several threads.
@threadpool_limits.wrap(limits=1, user_api="blas")
def refit(weights, bias, person: Person, kept: Rehearsal, seed: int = 0, scale: float = 1.0):
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
    weights, bias = np.asarray(weights, float), np.asarray(bias, float)
    problem = _Problem(weights, bias, person, kept, scale)
    folds = _folds(person.labels, seed)
    kept_folds = np.random.default_rng([seed, 1]).permutation(len(kept)) % (folds.max() + 1)
    before = problem.log_odds(problem.weights, person.responses)
    kept_before = _right(problem.log_odds(problem.weights, kept.responses), kept.labels)
    best, best_worth = None, -np.inf
    for pull, rehearsal in itertools.product(PULLS, REHEARSALS):
        log_p, kept_after = np.empty_like(before), np.empty(len(kept), bool)
        for fold in range(folds.max() + 1):
            inside, out = kept_folds != fold, kept_folds == fold
            learned = person.learned(folds != fold)
            refitted = in_8_bits(problem.solve(*learned, inside, pull, rehearsal))
            log_p[folds == fold] = problem.log_odds(refitted, person.responses[folds == fold])
            log_kept = problem.log_odds(refitted, kept.responses[out])
            kept_after[out] = _right(log_kept, kept.labels[out])
        # The best fit keeps the accuracy for others, if possible, and then is the most likely one.
        after = _right(log_p, person.labels)
        sure = log_p[np.arange(len(person)), person.labels].mean()
        within = kept_before.mean() - kept_after.mean() <= MOST_LOST
        worth = (within, sure)
        if best is None or worth > best_worth:
            best, best_worth = (pull, rehearsal, after, kept_after), worth
    pull, rehearsal, after, kept_after = best
    everything = np.ones(len(kept), bool)
    own = person.learned(np.arange(len(person)))
    exact = problem.solve(*own, everything, pull, rehearsal)
    return Refit(
        weights=in_8_bits(exact),
        exact=exact,
        pull=pull,
        rehearsal=rehearsal,
        before=_right(before, person.labels),
        after=after,
        kept_before=kept_before,
        kept_after=kept_after,
    )


def in_8_bits(weights) -> np.ndarray:
    """Weights rounded to 255 levels; the largest magnitude has the last level."""
    unit = np.abs(weights).max() / LEVELS
    return np.rint(weights / unit) * unit if unit > 0 else np.array(weights)


class _Problem:
    """The regression's constants: old weights, kept samples, units."""

    def __init__(self, weights, bias, person, kept, scale):
        self.weights, self.bias, self._scale = weights, bias, scale
        self._kept = kept.responses.astype(float)
        self._classes = np.eye(len(weights))
        self._kept_labels = self._classes[kept.labels]
        self._kept_logits = self._logits(weights, self._kept)
        self._unit = max(np.sqrt((self._kept**2).sum(axis=1).mean()), 1e-12)
        every = np.concatenate([self._kept, person.learned(np.arange(len(person)))[0]])
        directions = np.linalg.eigh(every.T @ every)[1]
        self._directions = directions[:, -MOST_DIRECTIONS:]

    def _logits(self, weights, responses):
        return self._scale * (responses @ weights.T + self.bias)

    def log_odds(self, weights, responses):
        """Logarithm of the softmax, shape (n_samples, classes)."""
        return _log_softmax(self._logits(weights, responses))

    def solve(self, responses, labels, kept, pull, rehearsal):
        """The refitted weights."""
        units = self._directions / self._unit
        mine, others = responses @ units, self._kept[kept] @ units
        logits = self._logits(self.weights, responses), self._kept_logits[kept]
        targets = self._classes[labels], self._kept_labels[kept]

        def loss(flat):
            change = flat.reshape(len(self.weights), -1)
            value, slope = pull / 2 * (flat**2).sum(), pull * change
            for share, rows, offset, target in zip(
                (1.0, rehearsal), (mine, others), logits, targets, strict=True
            ):
                log_p = _log_softmax(offset + rows @ change.T)
                value = value - share * (log_p * target).sum() / len(rows)
                slope = slope + share * (np.exp(log_p) - target).T @ rows / len(rows)
            return value, slope.ravel()

        found = minimize(
            loss, np.zeros(len(self.weights) * units.shape[1]), jac=True, method="L-BFGS-B",
            options={"maxiter": 100, "ftol": 1e-7},
        )  # fmt: skip
        change = found.x.reshape(len(self.weights), -1) @ units.T / self._scale
        return self.weights + change


def _folds(labels, seed):
    """The fold of each sample; the samples of a class are in as many folds as possible."""
    order = np.random.default_rng([seed, 0]).permutation(len(labels))
    order = order[np.argsort(np.asarray(labels)[order], kind="stable")]
    folds = np.empty(len(labels), int)
    folds[order] = np.arange(len(labels)) % min(FOLDS, len(labels))
    return folds


def _right(log_p, labels):
    return log_p.argmax(axis=1) == labels


def _log_softmax(logits):
    ahead = logits - logits.max(axis=1, keepdims=True)
    return ahead - np.log(np.exp(ahead).sum(axis=1, keepdims=True))
