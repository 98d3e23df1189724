"""Your own network for your own sensor: from arrays and a Keras model to the loss ladder.

The arrays are five simulated gestures on 16 x 16 taxels; replace them by your own images, labels
and model.  Run it as a script (``python examples/own_network.py``), or block by block in a
notebook.
"""

import keras
import numpy as np

from stmnist import (
    Dataset,
    RunFolder,
    Settings,
    ladder_text,
    measure_ladder,
    stages,
)

CLASSES = ("across", "along", "diagonal", "ring", "press")


def gestures(n, seed=0):
    """Images (n, 16, 16) from 0 to 1 and labels (n,): a gesture anywhere, pressed more or less."""
    rng, (y, x) = np.random.default_rng(seed), np.mgrid[:16, :16]
    labels, images = rng.integers(0, len(CLASSES), n), np.empty((n, 16, 16))
    for image, label in zip(images, labels, strict=True):
        v, u = y - rng.normal(7.5, 1.5), x - rng.normal(7.5, 1.5)
        far = (v, u, (v - u) / 2**0.5, np.hypot(v, u) - 4.5, np.hypot(v, u) / 2)[label]
        image[:] = rng.uniform(0.6, 1) * np.exp(-(far**2) / 2) + rng.normal(0, 0.15, (16, 16))
    return images.clip(0, 1), labels


images, labels = gestures(1500)
settings = Settings().with_values({"data": {"source": "made-up gestures"}})
dataset = Dataset.of_arrays(images, labels, settings, CLASSES, simulated=True)

keras.utils.set_random_seed(0)
model = keras.Sequential([
    keras.Input((16, 16, 1)),
    keras.layers.Conv2D(8, 4, strides=2, activation="relu"),
    keras.layers.Conv2D(16, 3, activation="relu"),
    keras.layers.Flatten(),
    keras.layers.Dense(len(CLASSES)),
])  # fmt: skip
model.compile("adam", keras.losses.SparseCategoricalCrossentropy(from_logits=True))
model.fit(*dataset.part("train"), epochs=6, verbose=0)

run = RunFolder("runs/gestures")
with run.locked():
    model.save(run.path / "model.keras")
    settings = settings.with_values(
        stages.settings_of_model(run.path / "model.keras", retrain=True)
    )
    chosen = ("cnn", "rate-lif", "nengo", "fast")  # the last two from the bundle, as a chip would
    opened = stages.open_run(run, settings, dataset=dataset)
    ladder = measure_ladder(opened, asked=chosen)
print(ladder_text(ladder))
