"""Keras models of the networks of :mod:`models.architecture`, including the paper's CNN.

The forward pass of their layers may use weights quantised as on Loihi.
"""

from __future__ import annotations

import numpy as np

from deploy.network.chip import LOIHI
from models.architecture import Architecture
from models.keras2 import as_written, tf

# Largest magnitude of a signed weight.
WEIGHT_LEVELS = LOIHI.weight_levels

# Bits of a bias current's mantissa.
BIAS_BITS = LOIHI.bias_bits


def straight_through(rounding, values):
    """Apply a rounding function with a straight-through gradient."""
    return values + tf.stop_gradient(rounding(values) - values)


def weight_scale(weights):
    """Value of one level of an 8-bit weight: a scalar tensor without a gradient.

    NengoLoihi scales the weights of a block so that the largest fills 8 bits
    (``discretize_weights``).
    """
    return tf.stop_gradient(tf.maximum(tf.reduce_max(tf.abs(weights)), 1e-12) / WEIGHT_LEVELS)


def eight_bits(weights):
    """Round weights to 8 bits with a common scale; the gradient is straight-through."""
    scale = weight_scale(weights)
    return straight_through(lambda values: tf.round(values / scale) * scale, weights)


def twelve_bits(bias):
    """Round each bias current to a 12-bit mantissa; the gradient is straight-through.

    Loihi stores a bias as 12 bits times a power of two (NengoLoihi's ``bias_to_manexp``).
    """
    magnitude = tf.maximum(tf.abs(bias), 1e-12)
    unit = tf.pow(2.0, tf.math.ceil(tf.math.log(magnitude) / np.log(2.0)) - BIAS_BITS)
    return straight_through(lambda values: tf.round(values / unit) * unit, bias)


@as_written
def on_chip(kernel, bias, gain: float):
    """Kernel and bias, quantised as on the chip.

    Parameters
    ----------
    kernel, bias : tensor
    gain : float
        Gain of the layer's neurons: their current is ``1 + gain * (kernel * input + bias)``, so
        that ``1 + gain * bias`` is their bias current.
    """
    return eight_bits(kernel), (twelve_bits(1 + gain * bias) - 1) / gain


class OnChipConv2D(tf.keras.layers.Conv2D):
    """A ``Conv2D`` with the chip's quantised weights and bias currents.

    Parameters
    ----------
    filters, kernel_size : int
    gain : float
        See :func:`on_chip`.
    """

    def __init__(self, filters, kernel_size, gain, **kwargs):
        super().__init__(filters, kernel_size, **kwargs)
        self.gain = gain

    def call(self, inputs):
        """Convolve; shapes as in ``Conv2D``."""
        kernel, bias = on_chip(self.kernel, self.bias, self.gain)
        return tf.nn.bias_add(
            tf.nn.conv2d(inputs, kernel, strides=self.strides, padding=self.padding.upper()), bias
        )


class OnChipDense(tf.keras.layers.Dense):
    """A ``Dense`` layer with the chip's quantised weights and bias currents.

    Parameters
    ----------
    units : int
    gain : float
        See :func:`on_chip`.
    """

    def __init__(self, units, gain, **kwargs):
        super().__init__(units, **kwargs)
        self.gain = gain

    def call(self, inputs):
        """Compute the weighted sums; shapes as in ``Dense``."""
        kernel, bias = on_chip(self.kernel, self.bias, self.gain)
        return tf.matmul(inputs, kernel) + bias


def build_cnn(architecture: Architecture, activation=None, gain=None) -> tf.keras.Model:
    """Build the Keras model of an architecture; its outputs are logits (the loss has the softmax).

    Parameters
    ----------
    architecture : Architecture
    activation : callable, optional
        ``activation(index)`` returns the activation layer of layer ``index``, counted from 0 over
        the convolutions and hidden dense layers.  Default: ReLU.
    gain : callable, optional
        ``gain(index)`` returns the gain of that layer's neurons; the layers then have the chip's
        quantised weights (:func:`on_chip`).  Default: weights in floating point.

    Returns
    -------
    tf.keras.Model
        Input (n, rows, columns, channels), output (n, outputs).  Layers are named ``conv1``,
        ``conv1_neurons``, ``pool1``, ``dense1``, ..., ``output``.
    """
    activation = activation or (lambda index: tf.keras.layers.ReLU())
    signal = inputs = tf.keras.Input(architecture.input_shape, name="image")
    index = 0
    for name, layer in zip(architecture.names, architecture.layers, strict=True):
        if layer.kind in ("dense", "output") and len(signal.shape) > 2:
            signal = tf.keras.layers.Flatten(name="flatten")(signal)
        if layer.kind == "pool":
            signal = tf.keras.layers.AveragePooling2D(layer.size, name=name)(signal)
        elif layer.kind == "output":
            signal = tf.keras.layers.Dense(layer.units, name=name)(signal)
        else:
            signal = _sums(layer, name, gain and gain(index))(signal)
            neurons = activation(index)
            neurons._name = f"{name}_neurons"
            signal = neurons(signal)
            index += 1
    return tf.keras.Model(inputs, signal)


def _sums(layer, name, gain):
    """The Keras layer for the weighted sums of a convolution or a hidden dense layer."""
    if layer.kind == "dense":
        size, options = (layer.units,), {"name": name}
        plain, on_chip = tf.keras.layers.Dense, OnChipDense
    else:
        size = (layer.filters, layer.kernel)
        options = {"name": name, "strides": layer.stride, "padding": layer.padding}
        plain, on_chip = tf.keras.layers.Conv2D, OnChipConv2D
    return plain(*size, **options) if gain is None else on_chip(*size, gain, **options)


def get_weights(model: tf.keras.Model) -> dict:
    """Trained arrays by name, ``<layer>.kernel`` and ``<layer>.bias``."""
    return {
        f"{layer.name}.{variable.name.split('/')[-1].split(':')[0]}": variable.numpy()
        for layer in model.layers
        for variable in layer.trainable_weights
    }


def set_weights(model: tf.keras.Model, weights: dict):
    """Assign the arrays that :func:`get_weights` returned.

    Raises
    ------
    ValueError
        An array is missing or has the wrong shape.
    """
    for layer in model.layers:
        for variable in layer.trainable_weights:
            name = f"{layer.name}.{variable.name.split('/')[-1].split(':')[0]}"
            if name not in weights or np.shape(weights[name]) != tuple(variable.shape):
                raise ValueError(f"no array {name!r} of shape {tuple(variable.shape)}")
            variable.assign(weights[name])


def relu(noise: float = 0.0, dropout: float = 0.0) -> tf.keras.layers.Layer:
    """A layer of ReLUs with the noise and the dropout of :func:`with_noise`."""
    layer = tf.keras.layers.ReLU()
    layer.noise, layer.dropout = noise, dropout
    return layer


def with_noise(model: tf.keras.Model, images, noise, masks=()):
    """Call the network in training mode, with noise on the input of its neurons, and dropout.

    Parameters
    ----------
    model : tf.keras.Model
        From :func:`build_cnn`.
    images : tensor, shape (n_samples, rows, columns, channels)
    noise : sequence of tensors
        One for each layer of :func:`noisy_layers`, shape (n_samples, \\*shape of its input); it
        is added.
    masks : sequence of tensors
        One for each layer of :func:`dropped_layers`, of the same shape; the output is multiplied.

    Returns
    -------
    tensor, shape (n_samples, outputs)
        Logits.
    """
    added = dict(zip(noisy_layers(model), noise, strict=True))
    dropped = dict(zip(dropped_layers(model), masks, strict=True))
    signal = images
    for layer in model.layers[1:]:  # the first is the input layer
        if layer in added:
            signal = signal + added[layer]
        signal = layer(signal, training=True)
        if layer in dropped:
            signal = signal * dropped[layer]
    return signal


def noisy_layers(model: tf.keras.Model) -> list:
    """The activation layers whose input is noisy during training."""
    return [layer for layer in model.layers if getattr(layer, "noise", 0)]


def dropped_layers(model: tf.keras.Model) -> list:
    """The activation layers whose output has dropout during training."""
    return [layer for layer in model.layers if getattr(layer, "dropout", 0)]


def predict(model: tf.keras.Model, images) -> np.ndarray:
    """Logits of images (n_samples, rows, columns, channels), shape (n_samples, outputs)."""
    return np.concatenate([model(part, training=False) for part in _parts(images)])


def activations(model: tf.keras.Model, images) -> dict:
    """Outputs of the neurons of each layer, by the layer's name.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        ``"conv1"``, ..., ``"dense1"``, ...; neurons in the order (row, column, channel).
    """
    suffix = "_neurons"
    layers = [layer for layer in model.layers if layer.name.endswith(suffix)]
    probe = tf.keras.Model(model.input, {layer.name: layer.output for layer in layers})
    parts = [probe(part, training=False) for part in _parts(images)]
    return {
        layer.name[: -len(suffix)]: np.concatenate([part[layer.name] for part in parts]).reshape(
            len(images), -1
        )
        for layer in layers
    }


def _parts(images):
    """Split images into batches of 512.

    Calling the model on them is faster than Keras's ``predict``, which traces a graph for one use.
    """
    images = np.asarray(images, np.float32)
    return np.split(images, range(512, len(images), 512))
