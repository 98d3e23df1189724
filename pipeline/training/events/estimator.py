"""Train the estimator of the confidence in a prediction; see :mod:`deploy.network.decision`."""

from __future__ import annotations

import functools

import numpy as np

from deploy.network.decision import HIDDEN_NEURONS, Estimator, make_estimator_inputs
from models.keras.keras2 import tf

# Hyperparameters of the training.
EPOCHS = 4
BATCH_SIZE = 512
LEARNING_RATE = 0.002

# Batches that are copied at a time.
BATCHES_AT_ONCE = 256


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
    inputs, middle, spread = _scale_inputs(outputs)
    model, untouched = _make_model(inputs.shape[1])
    for variable, value in zip(model.optimizer.variables, untouched, strict=True):
        variable.assign(value)
    for index, layer in enumerate(model.layers):
        layer.kernel.assign(tf.keras.initializers.GlorotUniform(seed + index)(layer.kernel.shape))
        layer.bias.assign(tf.zeros_like(layer.bias))
    rng = np.random.default_rng([seed, 0x10D6])
    for _ in range(EPOCHS):
        order = rng.permutation(len(inputs))
        for start in range(0, len(order), BATCHES_AT_ONCE * BATCH_SIZE):
            indices = order[start : start + BATCHES_AT_ONCE * BATCH_SIZE]
            model.fit(
                inputs[indices], right[indices], batch_size=BATCH_SIZE, shuffle=False, verbose=0
            )
    kernels, biases = zip(*(layer.get_weights() for layer in model.layers), strict=True)
    # Fold the scaling of the inputs into the first layer.
    first = kernels[0] / spread[:, None]
    return Estimator((first, *kernels[1:]), (biases[0] - middle @ first, *biases[1:]))


def _scale_inputs(outputs):
    """Inputs of all steps with mean 0 and deviation 1, float32, their means and deviations.

    In double precision they would take hundreds of megabytes: they are computed three times.
    """
    count = sum(map(len, outputs))
    middle = _sum_rows(outputs, lambda rows: rows) / count
    squares = _sum_rows(outputs, lambda rows: np.square(rows - middle))
    spread = np.maximum(np.sqrt(squares / count), 1e-3)
    inputs = np.empty((count, len(middle)), np.float32)
    end = 0
    for sample in outputs:
        begin = end
        end = end + len(sample)
        inputs[begin:end] = (make_estimator_inputs(sample) - middle) / spread
    return inputs, middle, spread


def _sum_rows(outputs, values):
    """The sum over all steps, added in their order as by :func:`numpy.sum` of all at once."""
    total = None
    for sample in outputs:
        rows = values(make_estimator_inputs(sample))
        total = np.sum(rows if total is None else np.vstack([total, rows]), axis=0)
    return total


@functools.lru_cache(maxsize=1)
def _make_model(inputs):
    """A model and the initial values of its optimiser, reused with new initial weights.

    All trainings of a process share it because tracing its training step takes a second.
    """
    layers = [
        tf.keras.layers.Dense(n, activation="relu" if n > 1 else None) for n in (*HIDDEN_NEURONS, 1)
    ]
    model = tf.keras.Sequential([tf.keras.Input((inputs,)), *layers])
    model.compile(
        tf.keras.optimizers.Adam(LEARNING_RATE),
        tf.keras.losses.BinaryCrossentropy(from_logits=True),
    )
    model.optimizer.build(model.trainable_variables)
    return model, [variable.numpy() for variable in model.optimizer.variables]
