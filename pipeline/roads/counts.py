"""The simplest classifier of every road: a logistic regression on event counts."""

from __future__ import annotations

import importlib.metadata
import time

import numpy as np

from deploy.files import read_arrays, write_arrays
from pipeline.data.images import sliced_counts, typical_duration_ms
from pipeline.roads.road import Part, Reference, accuracies, accuracy_text, responses_of
from pipeline.run import DELETE_ITS_FOLDER

MOST_FEATURES = 20_000
"""Event counts of a sample, at most; a sensor with more has them in one slice of time."""

SCORES = "scores.npz"
"""Scores of the test samples, by their ids."""


def _versions():
    return {"scikit_learn": importlib.metadata.version("scikit-learn")}


def _fit(opened, artifact):
    """Fit the classifier; keep its scores of the test samples."""
    from pipeline.training.baseline import SLICES, fit_baseline

    dataset, seed = opened.dataset, opened.settings.seed
    recordings, split = dataset.recordings, dataset.split
    begun = time.perf_counter()
    if dataset.is_of_arrays:  # there are no events: the pixels take their place
        counts = dataset.inputs[:, None]
    else:
        duration = typical_duration_ms(recordings.part(split.train))
        features = 2 * recordings.sensor.rows * recordings.sensor.columns
        slices = max(SLICES) if features * max(SLICES) <= MOST_FEATURES else 1
        counts = sliced_counts(recordings, slices, duration)
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
    opened.say(accuracy_text("counts", metrics))
    return metrics


def _respond(stage, opened, bundle, advance):
    stored = read_arrays(opened.artifact("counts").folder / SCORES, DELETE_ITS_FOLDER)
    scores = dict(zip(stored["ids"].tolist(), stored["scores"], strict=True))
    logits = np.stack([scores[name] for name in bundle.checks.ids])[:, None]
    return responses_of(logits, bundle.spec.presentation)


PART = Part("counts", "counts", ("metrics.json", SCORES), (), _fit, action="fitting")
"""The classifier has no settings of its own."""

REFERENCE = Reference(
    "Event counts",
    "logistic regression on event counts, the simplest classifier",
    "counts",
    _respond,
    _versions,
)
