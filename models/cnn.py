"""The convolutional network of the paper's Table 2, built from its notation."""

from __future__ import annotations

import numpy as np

from models.keras2 import tf
from models.notation import Architecture


def build_cnn(architecture: Architecture, activation=None, convolution=None) -> tf.keras.Model:
    """Build the network; its output are logits, the softmax is in the loss.

    Parameters
    ----------
    architecture : Architecture
    activation : callable, optional
        ``activation(index)`` makes the layer that follows convolution ``index`` (from 0).
        Default: rectified linear.
    convolution : callable, optional
        ``convolution(index, conv, name)`` makes convolution ``index``, described by ``conv``.
        Default: a ``Conv2D``.

    Returns
    -------
    tf.keras.Model
        Input (n, rows, columns, channels), output (n, outputs).  Layers are named ``conv1``,
        ``conv1_neurons``, ..., ``output``.
    """
    activation = activation or (lambda index: tf.keras.layers.ReLU())
    convolution = convolution or _plain_convolution
    signal = inputs = tf.keras.Input(architecture.input_shape, name="image")
    for index, conv in enumerate(architecture.convs):
        signal = convolution(index, conv, f"conv{index + 1}")(signal)
        neurons = activation(index)
        neurons._name = f"conv{index + 1}_neurons"
        signal = neurons(signal)
    signal = tf.keras.layers.Flatten(name="flatten")(signal)
    outputs = tf.keras.layers.Dense(architecture.outputs, name="output")(signal)
    return tf.keras.Model(inputs, outputs)


def _plain_convolution(index, conv, name):
    return tf.keras.layers.Conv2D(conv.filters, conv.kernel, name=name)


def get_weights(model: tf.keras.Model) -> dict:
    """Trained arrays as ``<layer>.kernel`` and ``<layer>.bias``."""
    return {
        f"{layer.name}.{variable.name.split('/')[-1].split(':')[0]}": variable.numpy()
        for layer in model.layers
        for variable in layer.trainable_weights
    }


def set_weights(model: tf.keras.Model, weights: dict):
    """The inverse of :func:`get_weights`.

    Raises
    ------
    ValueError
        An array is missing or has another shape.
    """
    for layer in model.layers:
        for variable in layer.trainable_weights:
            name = f"{layer.name}.{variable.name.split('/')[-1].split(':')[0]}"
            if name not in weights or np.shape(weights[name]) != tuple(variable.shape):
                raise ValueError(f"no array {name!r} of shape {tuple(variable.shape)}")
            variable.assign(weights[name])


def predict(model: tf.keras.Model, images) -> np.ndarray:
    """Logits, shape (n_samples, outputs)."""
    return model.predict(np.asarray(images, np.float32), batch_size=512, verbose=0)


def activations(model: tf.keras.Model, images) -> dict:
    """What the neurons of each convolution put out, by the convolution's name.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        ``"conv1"``, ...; neurons in the order (row, column, channel).
    """
    suffix, images = "_neurons", np.asarray(images, np.float32)
    layers = [layer for layer in model.layers if layer.name.endswith(suffix)]
    probe = tf.keras.Model(model.input, {layer.name: layer.output for layer in layers})
    # Called, not predict(): that would trace a graph for a model that is used once.
    parts = [
        probe(images[first : first + 512], training=False) for first in range(0, len(images), 512)
    ]
    return {
        layer.name[: -len(suffix)]: np.concatenate([part[layer.name] for part in parts]).reshape(
            len(images), -1
        )
        for layer in layers
    }
