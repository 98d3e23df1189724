"""Training a judge of how sure a network's outputs are; see :mod:`deploy.network.decision`."""

from __future__ import annotations

import numpy as np

from deploy.network.decision import HIDDEN, Judge, judged_by
from models.keras2 import tf

EPOCHS = 4
BATCH = 512
LEARNING_RATE = 0.002


def train_judge(outputs, right, seed: int) -> Judge:
    """Train a judge on what a network answered.

    The loss is the cross-entropy between its confidence and whether the largest output was the
    right one, over all steps.

    Parameters
    ----------
    outputs : list of ndarray, each of shape (steps, classes)
        A sample's sums of the readout, from its start to its last event.
    right : list of ndarray of bool, each of shape (steps,)
        Whether the largest output was the label's.
    seed : int
        Of the first weights and of the order in which steps are trained on.

    Returns
    -------
    Judge
    """
    told = np.concatenate([judged_by(sample) for sample in outputs])
    right = np.concatenate(right).astype(np.float32)
    middle, spread = told.mean(0), np.maximum(told.std(0), 1e-3)
    told = ((told - middle) / spread).astype(np.float32)
    layers = [
        tf.keras.layers.Dense(
            units,
            activation="relu" if units > 1 else None,
            kernel_initializer=tf.keras.initializers.GlorotUniform(seed + index),
        )
        for index, units in enumerate((*HIDDEN, 1))
    ]
    model = tf.keras.Sequential([tf.keras.Input(told.shape[1:]), *layers])
    model.compile(
        tf.keras.optimizers.Adam(LEARNING_RATE),
        tf.keras.losses.BinaryCrossentropy(from_logits=True),
    )
    rng = np.random.default_rng([seed, 0x10D6])
    for _ in range(EPOCHS):
        order = rng.permutation(len(told))
        model.fit(told[order], right[order], batch_size=BATCH, shuffle=False, verbose=0)
    kernels, biases = zip(*(layer.get_weights() for layer in layers), strict=True)
    # What the inputs were scaled by goes into the first layer.
    first = kernels[0] / spread[:, None]
    return Judge((first, *kernels[1:]), (biases[0] - middle @ first, *biases[1:]))
