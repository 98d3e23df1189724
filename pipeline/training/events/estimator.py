"""Train the estimator of the confidence in a prediction; see :mod:`deploy.network.decision`."""

from __future__ import annotations

import functools

import numpy as np

from deploy.network.decision import HIDDEN, Estimator, estimator_inputs
from models.keras.keras2 import tf

# Hyperparameters of the training.
EPOCHS = 4
BATCH_SIZE = 512
LEARNING_RATE = 0.002

# Columns of the inputs whose deviations are computed at a time.
COLUMNS_AT_ONCE = 8


def train_estimator(outputs, right, seed: int) -> Estimator:
    """Train a confidence estimator on the outputs of a network.

    The loss is the cross-entropy between its confidence and whether the largest output was right,
    over all steps.

    Parameters
    ----------
    outputs : list of ndarray, each of shape (steps, classes)
        For each sample the accumulated readout, from its start to its last event.
    right : list of ndarray of bool, each of shape (steps,)
        True where the largest output is the label's.
    seed : int
        Seed of the initial weights and of the order of the training steps.

    Returns
    -------
    Estimator
    """
    right = np.concatenate(right).astype(np.float32)
    inputs, middle, spread = _scaled_inputs(outputs)
    model, untouched = _estimator_model(inputs.shape[1])
    for variable, value in zip(model.optimizer.variables, untouched, strict=True):
        variable.assign(value)
    for index, layer in enumerate(model.layers):
        layer.kernel.assign(tf.keras.initializers.GlorotUniform(seed + index)(layer.kernel.shape))
        layer.bias.assign(tf.zeros_like(layer.bias))
    rng = np.random.default_rng([seed, 0x10D6])
    for _ in range(EPOCHS):
        order = rng.permutation(len(inputs))
        model.fit(inputs[order], right[order], batch_size=BATCH_SIZE, shuffle=False, verbose=0)
    kernels, biases = zip(*(layer.get_weights() for layer in model.layers), strict=True)
    # Fold the scaling of the inputs into the first layer.
    first = kernels[0] / spread[:, None]
    return Estimator((first, *kernels[1:]), (biases[0] - middle @ first, *biases[1:]))


def _scaled_inputs(outputs):
    """Inputs of all steps with mean 0 and deviation 1, float32, their means and deviations.

    They are hundreds of megabytes, of which no more copies are made than necessary.
    """
    ends = np.cumsum([len(sample) for sample in outputs])
    width = estimator_inputs(outputs[0]).shape[1]
    inputs = np.empty((ends[-1], width))
    for sample, end in zip(outputs, ends, strict=True):
        inputs[end - len(sample) : end] = estimator_inputs(sample)
    middle = inputs.mean(0)
    blocks = np.array_split(np.arange(width), max(width // COLUMNS_AT_ONCE, 1))
    spread = np.concatenate([inputs[:, some[0] : some[-1] + 1].std(0) for some in blocks])
    spread = np.maximum(spread, 1e-3)
    inputs -= middle
    inputs /= spread
    return inputs.astype(np.float32), middle, spread


@functools.lru_cache(maxsize=1)
def _estimator_model(inputs):
    """A model and the initial values of its optimiser, reused with new initial weights.

    All trainings of a process share it because tracing its training step takes a second.
    """
    layers = [tf.keras.layers.Dense(n, activation="relu" if n > 1 else None) for n in (*HIDDEN, 1)]
    model = tf.keras.Sequential([tf.keras.Input((inputs,)), *layers])
    model.compile(
        tf.keras.optimizers.Adam(LEARNING_RATE),
        tf.keras.losses.BinaryCrossentropy(from_logits=True),
    )
    model.optimizer.build(model.trainable_variables)
    return model, [variable.numpy() for variable in model.optimizer.variables]
