"""The classifier of event counts."""

import numpy as np
import pytest

from pipeline.kinds.counts import fit_baseline
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor, TaxelMap
from pipeline.recordings.spike_frames import EventTable


def recordings():
    """Two recordings of one row of three taxels; times in ms."""
    taxels, sensor = TaxelMap.grid(1, 3), Sensor(1, 3, classes=("a", "b"))
    parts = [([5, 7, 9, 25], [0, 0, 2, 1], [1, 1, -1, 1]), ([100, 139], [2, 2], [-1, 1])]
    events = [
        Events(np.array(t) * 10**6, np.array(x), np.array(p), np.ones(len(t), int))
        for t, x, p in parts
    ]
    source = Source("two", "0" * 64, False)
    return join_recordings(events, [0, 1], ["one", "two"], [-1, -1], source, taxels, sensor)


def test_counts_by_hand():
    """Times count from the first event, and what comes later is in the last slice."""
    table = EventTable.from_recordings(recordings())
    counts = table.count_in_slices(2, 20.0)
    assert counts.shape == (2, 2, 1, 3, 2)
    assert counts[0, 0, 0].tolist() == [[2, 0], [0, 0], [0, 1]]
    assert counts[0, 1, 0].tolist() == [[0, 0], [1, 0], [0, 0]]
    assert counts[1, 0, 0].tolist() == [[0, 0], [0, 0], [0, 1]]
    assert counts[1, 1, 0].tolist() == [[0, 0], [0, 0], [1, 0]]
    assert table.typical_duration_ms == pytest.approx(20 + 0.9 * 19)


def poisson(rates, n, seed=0):
    """``n`` samples of each class with these mean counts, (classes, slices, taxels)."""
    rng, rates = np.random.default_rng(seed), np.asarray(rates, float)
    labels = np.repeat(np.arange(len(rates)), n)
    return rng.poisson(rates[labels]).astype(np.float32), labels


def test_classes_that_only_the_time_tells_apart_need_slices():
    early, late = np.repeat([9, 1], 4), np.repeat([1, 9], 4)
    counts, labels = poisson([np.tile(part[:, None], 3) for part in (early, late)], 40)
    training = np.arange(0, 80, 2)
    fitted = fit_baseline(counts, labels, training, 2)
    assert fitted.slices > 1
    assert (fitted.scores.argmax(1) == labels).mean() > 0.95
    assert fit_baseline(counts[:, :1], labels, training, 2).slices == 1


def test_only_training_samples_are_used():
    counts, labels = poisson(np.random.default_rng(1).uniform(1, 9, (4, 8, 5)), 20)
    training = np.flatnonzero(np.arange(80) % 4)
    first = fit_baseline(counts, labels, training, 4)
    changed = labels.copy()
    changed[::4] = 0
    other = counts.copy()
    other[::4] = 100
    second = fit_baseline(other, changed, training, 4)
    assert np.array_equal(first.scores[training], second.scores[training])
    assert first.cross_validated == second.cross_validated


def test_a_class_without_training_samples_is_never_the_answer():
    counts, labels = poisson(np.random.default_rng(2).uniform(1, 9, (3, 1, 5)), 10)
    fitted = fit_baseline(counts, labels, np.flatnonzero(labels > 0), 3)
    assert fitted.scores.shape == (30, 3)
    assert 0 not in fitted.scores.argmax(1)


def test_equal_samples_are_answered_with_the_most_frequent_class():
    counts, labels = np.ones((10, 8, 5)), np.repeat([0, 1, 2], [2, 4, 4])
    counts[9] = 7  # is not in training
    fitted = fit_baseline(counts, labels, np.arange(9), 3)
    assert fitted.scores.tolist() == [[0, 1, 0]] * 10
