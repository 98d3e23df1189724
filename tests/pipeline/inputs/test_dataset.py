"""Recordings as networks see them: loaded, divided and made in one place."""

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.inputs.dataset import Dataset, split_of
from pipeline.inputs.images import tactile_images
from pipeline.inputs.splits import random_split, writer_split
from pipeline.settings import Settings
from tests.pipeline.handmade import archive, good_members, recordings

SMALL = Settings().with_values(
    {"seed": 3, "data": {"samples_per_digit": 6}, "split": {"validation_fraction": 0.25}}, "test"
)


@pytest.fixture(scope="module")
def dataset():
    return Dataset.of(SMALL)


def test_inputs_and_labels_are_those_of_the_recordings(dataset):
    assert len(dataset) == 60
    np.testing.assert_array_equal(dataset.labels, np.repeat(np.arange(10), 6))
    np.testing.assert_array_equal(dataset.inputs, tactile_images(dataset.recordings))


def test_the_split_is_of_the_settings_seed_and_fractions(dataset):
    expected = random_split(60, 3, 0.2, 0.25)
    for name in ("train", "validation", "test"):
        inputs, labels = dataset.part(name)
        index = getattr(expected, name)
        np.testing.assert_array_equal(inputs, dataset.inputs[index])
        np.testing.assert_array_equal(labels, dataset.labels[index])


def test_another_split_of_the_same_samples_has_no_validation_part(dataset):
    by_seed = dataset.divided(5, 0.2)
    np.testing.assert_array_equal(by_seed.split.test, random_split(60, 5).test)
    assert by_seed.part("validation") is None
    assert by_seed.inputs is dataset.inputs
    by_writer = dataset.divided(5, 0.2, "writers")
    np.testing.assert_array_equal(
        by_writer.split.test, writer_split(dataset.recordings.writers, 5).test
    )


def test_writers_that_are_not_known_are_refused():
    with pytest.raises(ValueError, match="not known"):
        split_of(recordings([], []), 0, 0.2, kind="writers")


def test_too_few_samples_are_one_line_with_the_source(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, good_members())
    values = {"data": {"source": str(path)}, "split": {"test_fraction": 0.01}}
    settings = Settings().with_values(values, "test")
    with pytest.raises(UserError, match=r"st\.zip: 10 samples are too few .*; ask for fewer"):
        Dataset.of(settings)
