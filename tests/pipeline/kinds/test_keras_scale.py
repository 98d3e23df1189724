"""The scale of images for a user's model that begins with the scaling of pixels."""

from types import SimpleNamespace

import numpy as np
import pytest

from models.keras.keras2 import tf
from pipeline.kinds.image.keras_model import make_model_settings, read_usable_model
from pipeline.settings import Settings


@pytest.fixture(scope="module")
def dataset():
    """Images of one value below or above a half, which are the two classes."""
    labels = np.arange(80) % 2
    values = np.random.default_rng(0).uniform(0, 0.4, 80) + 0.6 * labels
    images = np.broadcast_to(values[:, None, None, None], (80, 10, 10, 1)).astype(np.float32)
    return SimpleNamespace(subset=lambda part: (images, labels))


@pytest.mark.parametrize("largest", [255.0, 1.0])
def test_the_training_samples_tell_where_images_ended(tmp_path, dataset, largest):
    """Both models divide by 255; one was trained on images up to 255, the other on these."""
    layers = tf.keras.layers
    model = tf.keras.Sequential(
        [
            tf.keras.Input((10, 10, 1)),
            layers.Rescaling(1 / 255),
            layers.Flatten(),
            layers.Dense(2, activation="relu"),
            layers.Dense(2, activation="softmax"),
        ]
    )
    mean = np.full(100, 0.01 * 255 / largest)
    hidden = np.stack([-mean, mean], 1), np.array([0.5, -0.5])
    model.set_weights([*hidden, np.eye(2), np.zeros(2)])
    model.save(tmp_path / "model.keras")
    settings = Settings().with_values(make_model_settings(tmp_path / "model.keras"))
    _, read = read_usable_model(tmp_path / "cnn", settings, dataset)
    assert read.input_scale == largest
    assert ("end at 1" in read.notes[-1]) == (largest == 1.0)
