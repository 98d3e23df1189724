"""Classifiers without a network, splits that hold out styles, and readings of the paper's image."""

import numpy as np
import pytest

from experiments import classifiers, measuring, readings, styles
from pipeline.results.study import Case
from pipeline.settings import Settings
from pipeline.sources import load_dataset
from pipeline.storage.artifacts import Library

SETTINGS = Settings().with_values({"data": {"samples_per_digit": 40}})


@pytest.fixture(scope="module")
def dataset():
    return load_dataset(SETTINGS)


@pytest.mark.parametrize("stage", classifiers.STAGES)
def test_a_classifier_is_better_than_chance_and_knows_its_training(dataset, stage):
    split, labels = dataset.split, dataset.labels
    of_test = classifiers.predict_test_samples(dataset, split.test, stage)
    assert np.mean(of_test == labels[split.test]) > 0.25  # chance is 0.1
    of_training = classifiers.predict_test_samples(dataset, split.train, stage)
    assert np.mean(of_training == labels[split.train]) > 0.9


def test_whole_clusters_are_held_out(dataset):
    held_out = styles.hold_out_styles(dataset, 0)
    train, test = held_out.split.train, held_out.split.test
    everything = np.concatenate([dataset.split.train, dataset.split.test])
    assert sorted([*train, *test]) == sorted(everything)
    assert set(dataset.labels[test]) == set(dataset.labels[train]) == set(range(10))
    assert held_out.origin != dataset.origin
    other = styles.hold_out_styles(dataset, 1)
    assert sorted(other.split.test) != sorted(test)
    features = np.repeat([[0.0], [10.0]], 40, axis=0) + 1e-3 * np.arange(80)[:, None]
    cluster = styles.find_clusters(features)
    assert not set(cluster[:40]) & set(cluster[40:])


def test_styles_are_a_split_of_their_own_in_the_rows(tmp_path):
    case = Case("nearest", SETTINGS, "nearest", split=styles.STYLES)
    row = measuring.measure(case, Library(tmp_path))
    assert (row["split"], row["stage"]) == ("styles", "nearest")
    assert row["accuracy"] == np.mean(row["right"])


def test_a_row_of_the_papers_samples_is_a_part_of_the_others(dataset):
    test = dataset.split.test
    right = (np.arange(len(test)) % 2).tolist()
    row = {"samples": test.tolist(), "predictions": test.tolist(), "right": right, "stage": "fast"}
    case = Case("loihi-200", SETTINGS, "fast-200")
    drawn = measuring._draw_check_samples(row, dataset, case)
    assert set(drawn["samples"]) <= set(test.tolist())
    assert drawn["predictions"] == drawn["samples"]
    assert drawn["accuracy"] == np.mean(drawn["right"])


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("max", [1, 0.5, 0, 0]),
        ("max-signed", [1, -1, 0, 0]),
        ("max-rises", [1, 0, 0, 0]),
        ("max-falls", [0.5, 1, 0, 0]),
        ("sum", [2 / 3, 1 / 3, 0, 0]),
        ("l2", [2 / 5**0.5, 1 / 5**0.5, 0, 0]),
        ("l2-columns", [1, 1, 0, 0]),
        ("max-of-all", [1, 0.5, 0, 0]),
        ("taxels", [0, 0, 0, 0]),
        ("sqrt-max", [1, 0.5**0.5, 0, 0]),
    ],
)
def test_readings_by_hand(name, expected):
    """Two taxels: three rises and one fall, and two falls."""
    rises, falls = (np.array([[row, [0, 0]]], float) for row in ([3, 0], [1, 2]))
    reading = readings.READINGS[name]
    images = reading.aggregate(rises, falls)
    result = reading.normalise(images, images).ravel()
    np.testing.assert_allclose(result, expected)
