"""The paper's CNN on each of the images that the paper's words allow.

"Each element corresponds to the aggregated FA responses from a single taxel. The tactile image is
then normalized" (Section 3.2.1): it does not say whether rises and falls of pressure are added or
subtracted, nor what an image is divided by.  Each reading here is one answer to both.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pipeline.recordings.dataset import Dataset
from pipeline.settings import Settings

# The stage that is measured here.
STAGE = "cnn-reading"

# Rows, columns and channels of an image, as axes of an array of images.
IMAGE_AXES = (1, 2)


class Reading(NamedTuple):
    """One way to read the paper's words.

    Attributes
    ----------
    title : str
    aggregate : callable
        From the counts of rises and falls, two arrays (n_samples, rows, columns), to images.
    normalise : callable
        From all images and the training images to normalised images.
    """

    title: str
    aggregate: Callable
    normalise: Callable


def _add(rises, falls):
    return rises + falls


def _subtract(rises, falls):
    return rises - falls


def _take_rises(rises, falls):
    return rises


def _take_falls(rises, falls):
    return falls


def _divide(images, divisors):
    return images / np.where(divisors > 0, divisors, 1)


def _divide_by_largest(images, training):
    return _divide(images, np.abs(images).max(IMAGE_AXES, keepdims=True))


def _divide_by_sum(images, training):
    return _divide(images, np.abs(images).sum(IMAGE_AXES, keepdims=True))


def _divide_by_length(images, training):
    return _divide(images, np.sqrt(np.square(images).sum(IMAGE_AXES, keepdims=True)))


def _divide_by_length_of_columns(images, training):
    """As ``tf.keras.utils.normalize(images, axis=1)``, known from tutorials on MNIST."""
    return _divide(images, np.sqrt(np.square(images).sum(1, keepdims=True)))


def _divide_by_largest_of_all(images, training):
    return images / np.abs(training).max()


def _standardise_images(images, training):
    centred = images - images.mean(IMAGE_AXES, keepdims=True)
    return _divide(centred, images.std(IMAGE_AXES, keepdims=True))


def _standardise_taxels(images, training):
    return _divide(images - training.mean(0), training.std(0)[None])


def _divide_root_by_largest(images, training):
    return _divide_by_largest(np.sign(images) * np.sqrt(np.abs(images)), training)


READINGS = {
    "max": Reading("all events, by the largest taxel", _add, _divide_by_largest),
    "max-signed": Reading("rises minus falls, by the largest taxel", _subtract, _divide_by_largest),
    "max-rises": Reading("rises, by the largest taxel", _take_rises, _divide_by_largest),
    "max-falls": Reading("falls, by the largest taxel", _take_falls, _divide_by_largest),
    "sum": Reading("all events, by their number", _add, _divide_by_sum),
    "l2": Reading("all events, by the image's Euclidean length", _add, _divide_by_length),
    "l2-columns": Reading(
        "all events, by each column's length", _add, _divide_by_length_of_columns
    ),
    "max-of-all": Reading(
        "all events, by the largest of all images", _add, _divide_by_largest_of_all
    ),
    "images": Reading("all events, images of mean 0 and SD 1", _add, _standardise_images),
    "taxels": Reading("all events, taxels of mean 0 and SD 1", _add, _standardise_taxels),
    "sqrt-max": Reading(
        "square roots of all events, by the largest", _add, _divide_root_by_largest
    ),
}


def predict_test_samples(dataset: Dataset, index, name: str, settings: Settings) -> np.ndarray:
    """Train the paper's CNN on images of one reading, and predict some samples.

    Parameters
    ----------
    dataset : Dataset
    index : ndarray of int, shape (n,)
        The samples to predict.
    name : str
        A key of :data:`READINGS`.
    settings : Settings
        With the seed, and the CNN and its recipe.

    Returns
    -------
    ndarray of int, shape (n,)
    """
    from pipeline.training.images.epochs import TrainingSamples  # imports TensorFlow
    from pipeline.training.images.train import train_cnn  # imports TensorFlow

    reading = READINGS[name]
    train = dataset.split.train
    table = dataset.recordings.table
    counts = table.count_in_slices(1, table.typical_duration_ms)[:, 0]
    images = reading.aggregate(counts[..., 0], counts[..., 1])
    images = reading.normalise(images, images[train])[..., None].astype(np.float32)
    samples = TrainingSamples(images[train], dataset.labels[train])
    network = train_cnn(settings, samples, settings.seed)
    return network.compute_logits(images[index]).argmax(1)
