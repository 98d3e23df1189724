"""A Keras model that its owner trained on images of their own keeps its accuracy on the chip."""

import subprocess
import sys

import numpy as np

from deploy.files import read_json
from pipeline.recordings.images import make_tactile_images
from pipeline.sources import load_recordings
from tests.command import LEAVE_GARBAGE, call, environment
from tests.own_sensor import CLASSES, COLUMNS, ROWS, gestures, owners_image, write_folder

OWNERS_SCRIPT = (
    LEAVE_GARBAGE
    + """
import sys, numpy as np, keras
data = np.load("images.npz")
keras.utils.set_random_seed(0)
model = keras.Sequential([
    keras.Input(data["train"].shape[1:] + (1,)),
    keras.layers.Conv2D(8, 3, activation="relu"),
    keras.layers.Conv2D(16, 3, strides=2, activation="relu"),
    keras.layers.Flatten(),
    keras.layers.Dense(4),
])
model.compile("adam", keras.losses.SparseCategoricalCrossentropy(from_logits=True))
model.fit(data["train"], data["train_labels"], epochs=6, verbose=0)
model.save("model.keras")
right = model.predict(data["test"], verbose=0).argmax(1) == data["test_labels"]
np.savez("right.npz", accuracy=right.mean())
"""
)


def test_images_are_those_that_the_owner_draws(tmp_path):
    """Every image of recordings in files is the owner's own, not its mirror image or transpose."""
    recordings = load_recordings(str(write_folder(tmp_path / "own", per_class=3)), jobs=1)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (ROWS, COLUMNS)
    expected = np.array([owners_image(events) for events, _ in gestures(3)])
    np.testing.assert_allclose(make_tactile_images(recordings)[..., 0], expected, atol=1e-6)
    assert recordings.labels.tolist() == [label for _, label in gestures(3)]


def test_an_own_model_scores_on_the_chip_what_its_owner_measured(tmp_path):
    """Within two points; the images that the owner measured on are other recordings."""
    images, labels = {}, {}
    for part, seed in (("train", 1), ("test", 2)):
        own = gestures(100, seed)
        images[part] = np.array([owners_image(events) for events, _ in own])
        labels[part] = np.array([label for _, label in own])
    np.savez(
        tmp_path / "images.npz",
        **images,
        **{f"{part}_labels": values for part, values in labels.items()},
    )
    done = subprocess.run(
        [sys.executable, "-c", OWNERS_SCRIPT], cwd=tmp_path, env=environment(), check=False
    )
    assert done.returncode == 0
    with np.load(tmp_path / "right.npz") as file:
        owners = float(file["accuracy"])
    assert owners > 0.9  # chance is 0.25

    data = write_folder(tmp_path / "own", per_class=100, seed=2)
    run = tmp_path / "run"
    assert call(
        *("convert", run, "--data", data, "--model", tmp_path / "model.keras"),
        *("--samples", 320, "--set", "split.test_fraction=0.8"),
    ) == 0  # fmt: skip
    assert call("check", "run", run / "bundle", "--target", "fast") == 0
    result = read_json(run / "checks" / "fast.json", "")
    assert result["accuracy"] >= owners - 0.02
    assert tuple(read_json(run / "dataset.json", "")["samples_per_class"]) == CLASSES
