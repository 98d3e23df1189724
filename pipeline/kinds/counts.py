"""The simplest classifier of every kind: multinomial logistic regression on event counts.

Its features are the square roots of the numbers of events of each taxel and polarity in a few
equal slices of time, standardised on the training samples.  The number of slices and the strength
of the regularisation are chosen by cross-validation within the training samples.  A network that is
less accurate than this classifier is not trained well for its recordings.
"""

import importlib.metadata
import time
import warnings
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from deploy.files import read_arrays, write_arrays
from pipeline.kinds.kind import Reference, accuracies, accuracy_text
from pipeline.kinds.steps import Step
from pipeline.recordings.steps import EventTable
from pipeline.run.folder import DELETE_ITS_FOLDER

# Event counts of a sample, at most; a sensor with more has them in one slice of time.
MOST_FEATURES = 20_000

# Scores of the test samples, by their ids.
SCORES = "scores.npz"

# Numbers of slices of time among which cross-validation chooses.
SLICES = (1, 4, 8)

# Inverse strengths of the regularisation (scikit-learn's ``C``) among which it chooses.
STRENGTHS = (0.003, 0.02, 0.1)

FOLDS = 3

# Maximum number of samples of the cross-validation, so that it takes a few seconds.
MOST_SAMPLES = 2400


@dataclass(frozen=True)
class Baseline:
    """The fitted classifier's scores and what was chosen for it.

    Attributes
    ----------
    scores : ndarray of float, shape (n_samples, classes)
        Logits of all samples.
    slices : int
        Number of slices of time.
    strength : float
        Inverse strength of the regularisation.
    cross_validated : float
        Accuracy of these choices in the cross-validation.
    """

    scores: np.ndarray
    slices: int
    strength: float
    cross_validated: float


# In one thread: the matrix products of a fit are too small for several.
@threadpool_limits.wrap(limits=1, user_api="blas")
def fit_baseline(counts, labels, training, classes: int, seed: int = 0) -> Baseline:
    """Fit the classifier to the training samples, and compute the scores of all samples.

    Parameters
    ----------
    counts : ndarray, shape (n_samples, slices, ...)
        Numbers of events in slices of time: one, or as many as the largest of :data:`SLICES`.
    labels : ndarray of int, shape (n_samples,)
    training : ndarray of int
        Indices of the training samples.
    classes : int
    seed : int
        Seed of the folds.

    Returns
    -------
    Baseline
    """
    some = np.random.default_rng(seed).permutation(training)[:MOST_SAMPLES]
    some = some[np.argsort(labels[some], kind="stable")]
    folds = np.arange(len(some)) % FOLDS  # each class is in every fold, if it can be
    best, chosen = -1.0, None
    for slices in (n for n in SLICES if counts.shape[1] % n == 0):
        parts = counts.reshape(len(labels), slices, -1, *counts.shape[2:]).sum(axis=2)
        rows = (np.sign(parts) * np.sqrt(np.abs(parts))).reshape(len(labels), -1)
        for strength in STRENGTHS:
            right = [
                labels[out] == _scores(rows, labels, inside, out, classes, strength).argmax(1)
                for inside, out in ((some[folds != k], some[folds == k]) for k in range(FOLDS))
            ]
            if (accuracy := float(np.concatenate(right).mean())) > best:
                best, chosen = accuracy, (slices, strength, rows)
    slices, strength, rows = chosen
    scores = _scores(rows, labels, training, np.arange(len(labels)), classes, strength)
    return Baseline(scores, slices, strength, best)


def _scores(rows, labels, inside, out, classes, strength):
    """Scores of some samples by a classifier fitted to others, shape (len(out), classes).

    A class that is not among the samples of the fit has a score below all others.  If nothing
    distinguishes these samples, the answer is their most frequent class.
    """
    from sklearn.linear_model import LogisticRegression  # the import takes a second

    known = np.unique(labels[inside])
    active = np.ptp(rows[inside], axis=0) > 0 if len(known) > 1 else np.zeros(1, bool)
    if not active.any():
        most = np.bincount(labels[inside], minlength=classes).argmax()
        return np.eye(classes)[np.full(len(out), most)]
    mean, spread = rows[inside].mean(0), rows[inside].std(0)
    x, y = ((rows[some][:, active] - mean[active]) / spread[active] for some in (inside, out))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it need not converge to the last digit
        # A gradient this small is enough: a more exact fit is not more accurate.
        model = LogisticRegression(C=strength, tol=2e-3, max_iter=100).fit(x, labels[inside])
    logits = model.decision_function(y)
    if len(known) == 2:
        logits = np.stack([-logits, logits], axis=1) / 2
    scores = np.full((len(out), classes), logits.min(initial=0) - 1.0)
    scores[:, known] = logits
    return scores


def _versions():
    return {"scikit_learn": importlib.metadata.version("scikit-learn")}


def _fit(inputs, artifact):
    """Fit the classifier; keep its scores of the test samples."""
    dataset, seed = inputs.dataset, inputs.settings.seed
    recordings, split = dataset.recordings, dataset.split
    begun = time.perf_counter()
    duration = EventTable.of(recordings.part(split.train)).typical_duration_ms
    features = 2 * recordings.sensor.rows * recordings.sensor.columns
    slices = max(SLICES) if features * max(SLICES) <= MOST_FEATURES else 1
    counts = EventTable.of(recordings).sliced_counts(slices, duration)
    classes = len(recordings.sensor.classes)
    baseline = fit_baseline(counts, dataset.labels, split.train, classes, seed)
    seconds = time.perf_counter() - begun
    ids = np.array([recordings.ids[index] for index in split.test], dtype=str)
    write_arrays(artifact.folder / SCORES, ids=ids, scores=baseline.scores[split.test])
    metrics = {
        **accuracies(baseline.scores.argmax(1) == dataset.labels, dataset),
        "slices": baseline.slices,
        "strength": baseline.strength,
        "cross_validated_accuracy": baseline.cross_validated,
        "seconds": seconds,
        "versions": _versions(),
    }
    inputs.say(f"{accuracy_text('counts', metrics)}, slices of time: {baseline.slices}")
    return metrics


def _read_logits(stage, inputs, samples, advance):
    """The stored scores of the samples."""
    stored = read_arrays(inputs.artifact("counts").folder / SCORES, DELETE_ITS_FOLDER)
    scores = dict(zip(stored["ids"].tolist(), stored["scores"], strict=True))
    return np.stack([scores[name] for name in samples.ids])[:, None]


# The classifier has no settings of its own.
STEP = Step("counts", "counts", ("metrics.json", SCORES), (), _fit, action="fitting")

REFERENCE = Reference(
    "Logistic regression on event counts",
    "logistic regression on the numbers of events in up to eight slices of time",
    "counts",
    _read_logits,
    _versions,
)
