"""The baseline of every ladder: multinomial logistic regression on event counts.

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
from pipeline.kinds.records import describe_accuracy, measure_accuracies
from pipeline.kinds.reference import Reference
from pipeline.kinds.steps import Step
from pipeline.storage.run_folder import DELETE_ITS_FOLDER

# Maximum number of event counts of a sample; a sensor with more has one slice of time.
MAX_FEATURES = 20_000

# Scores of the test samples, by their ids.
SCORES = "scores.npz"

# Numbers of slices of time among which cross-validation chooses.
SLICES = (1, 4, 8)

# Inverse strengths of the regularisation (scikit-learn's ``C``) among which it chooses.
REGULARISATION_STRENGTHS = (0.003, 0.02, 0.1)

FOLDS = 3

# Maximum number of samples of the cross-validation, so that it takes a few seconds.
MAX_COMPARED_SAMPLES = 2400

# Maximum number of training samples that the classifier is fitted to, so that they fit into memory.
MAX_FITTED_SAMPLES = 20_000

# Samples whose scores are computed at a time.
SAMPLES_AT_ONCE = 2000


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
def fit_baseline(counts, labels, training, n_classes: int, seed: int = 0) -> Baseline:
    """Fit the classifier to the training samples, and compute the scores of all samples.

    Parameters
    ----------
    counts : ndarray, shape (n_samples, slices, ...)
        Numbers of events in slices of time: one, or as many as the largest of :data:`SLICES`.
    labels : ndarray of int, shape (n_samples,)
    training : ndarray of int
        Indices of the training samples.
    n_classes : int
    seed : int
        Seed of the folds.

    Returns
    -------
    Baseline
    """
    order = np.random.default_rng(seed).permutation(training)
    slices, strength, accuracy = _choose_features(
        counts, labels, order[:MAX_COMPARED_SAMPLES], n_classes
    )
    if len(training) > MAX_FITTED_SAMPLES:
        training = order[:MAX_FITTED_SAMPLES]
    features = _compute_features(counts, slices, training)
    model = _Model.fit(features, labels[training], n_classes, strength)
    by_batch = []
    for start in range(0, len(labels), SAMPLES_AT_ONCE):
        batch = np.arange(start, min(start + SAMPLES_AT_ONCE, len(labels)))
        by_batch.append(model.compute_logits(_compute_features(counts, slices, batch)))
    return Baseline(model.complete(np.concatenate(by_batch)), slices, strength, accuracy)


def _choose_features(counts, labels, compared, classes):
    """The slices and the strength of the regularisation with the best cross-validated accuracy.

    Returns
    -------
    slices : int
    strength : float
    accuracy : float
    """
    compared = compared[np.argsort(labels[compared], kind="stable")]
    best_accuracy = -1.0
    best_slices = 0
    best_strength = 0.0
    for slices in (n for n in SLICES if counts.shape[1] % n == 0):
        features = _compute_features(counts, slices, compared)
        for strength in REGULARISATION_STRENGTHS:
            accuracy = _cross_validate(features, labels[compared], classes, strength)
            if accuracy > best_accuracy:
                best_accuracy = accuracy
                best_slices = slices
                best_strength = strength
    return best_slices, best_strength, best_accuracy


def _cross_validate(features, labels, classes, strength):
    """The accuracy on samples that a model was not fitted to; the samples are sorted by class."""
    folds = np.arange(len(labels)) % FOLDS  # each class is in every fold, if it can be
    right = []
    for fold in range(FOLDS):
        is_inside = folds != fold
        is_out = folds == fold
        model = _Model.fit(features[is_inside], labels[is_inside], classes, strength)
        scores = model.complete(model.compute_logits(features[is_out]))
        right.append(labels[is_out] == scores.argmax(1))
    return float(np.concatenate(right).mean())


def _compute_features(counts, slices, samples):
    """Square roots of the counts of some samples in a number of slices, a row for each sample."""
    selected = counts[samples]
    by_slice = selected.reshape(len(selected), slices, -1, *selected.shape[2:]).sum(axis=2)
    return (np.sign(by_slice) * np.sqrt(np.abs(by_slice))).reshape(len(selected), -1)


@dataclass(frozen=True)
class _Model:
    """The classifier fitted to the features of some samples.

    Attributes
    ----------
    classes : int
        Number of all classes.
    fitted_classes : ndarray of int
        Classes of the samples of the fit, each once.
    active : ndarray of bool
        True for features that differ between these samples.
    mean, spread : ndarray
        Their means and standard deviations.
    regression : sklearn.linear_model.LogisticRegression or int
        The most frequent class if nothing distinguishes the samples.
    """

    classes: int
    fitted_classes: np.ndarray
    active: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    regression: object

    @classmethod
    def fit(cls, rows, labels, classes, strength):
        from sklearn.linear_model import LogisticRegression  # the import takes a second

        fitted_classes = np.unique(labels)
        mean = rows.mean(0)
        spread = rows.std(0)
        active = np.ptp(rows, axis=0) > 0 if len(fitted_classes) > 1 else np.zeros(1, bool)
        if not active.any():
            most_frequent = int(np.bincount(labels, minlength=classes).argmax())
            return cls(classes, fitted_classes, active, mean, spread, most_frequent)
        x = (rows[:, active] - mean[active]) / spread[active]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it need not converge to the last digit
            # A gradient this small is enough: a more exact fit is not more accurate.
            regression = LogisticRegression(C=strength, tol=2e-3, max_iter=100).fit(x, labels)
        return cls(classes, fitted_classes, active, mean, spread, regression)

    def compute_logits(self, rows):
        """Logits of the known classes."""
        if isinstance(self.regression, int):
            return np.zeros((len(rows), 0))
        x = (rows[:, self.active] - self.mean[self.active]) / self.spread[self.active]
        logits = self.regression.decision_function(x)
        if len(self.fitted_classes) == 2:
            return np.stack([-logits, logits], axis=1) / 2
        return logits

    def complete(self, logits):
        """Scores of all classes; those of unknown classes are below all others."""
        if isinstance(self.regression, int):
            return np.eye(self.classes)[np.full(len(logits), self.regression)]
        scores = np.full((len(logits), self.classes), logits.min(initial=0) - 1.0)
        scores[:, self.fitted_classes] = logits
        return scores


def _list_versions():
    return {"scikit_learn": importlib.metadata.version("scikit-learn")}


def _fit(inputs, artifact):
    """Fit the classifier; keep its scores of the test samples."""
    dataset = inputs.dataset
    seed = inputs.settings.seed
    recordings = dataset.recordings
    split = dataset.split
    begun = time.perf_counter()
    table = recordings.table
    duration_ms = table.measure_typical_duration(split.train)
    features = 2 * recordings.sensor.rows * recordings.sensor.columns
    slices = max(SLICES) if features * max(SLICES) <= MAX_FEATURES else 1
    counts = table.count_in_slices(slices, duration_ms)
    classes = len(recordings.sensor.classes)
    baseline = fit_baseline(counts, dataset.labels, split.train, classes, seed)
    seconds = time.perf_counter() - begun
    ids = np.array([recordings.ids[index] for index in split.test], dtype=str)
    write_arrays(artifact.folder / SCORES, ids=ids, scores=baseline.scores[split.test])
    metrics = {
        **measure_accuracies(baseline.scores.argmax(1) == dataset.labels, dataset),
        "slices": baseline.slices,
        "strength": baseline.strength,
        "cross_validated_accuracy": baseline.cross_validated,
        "seconds": seconds,
        "versions": _list_versions(),
    }
    inputs.say(f"{describe_accuracy('counts', metrics)}, slices of time: {baseline.slices}")
    return metrics


def _read_logits(stage, inputs, samples, advance):
    """The stored scores of the samples."""
    stored = read_arrays(inputs.find_artifact("counts").folder / SCORES, DELETE_ITS_FOLDER)
    scores = dict(zip(stored["ids"].tolist(), stored["scores"], strict=True))
    return np.stack([scores[name] for name in samples.ids])[:, None]


# The classifier has no settings of its own.
STEP = Step("counts", "counts", ("metrics.json", SCORES), (), _fit, action="fitting")

REFERENCE = Reference(
    "Logistic regression on event counts",
    "logistic regression on the numbers of events in up to eight slices of time",
    "counts",
    _read_logits,
    _list_versions,
)
