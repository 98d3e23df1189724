"""A user's Keras model as an architecture and weights that compute the same function.

The layers are converted one by one (:mod:`models.keras.layers`).  In the end the result is compared
with the model on random images; where layers were replaced, because training continues, the network
that is compared has the model's own activations and maxima.
"""

import functools
import math
from pathlib import Path

import numpy as np

from deploy.files import hash_file, reporting_os_errors
from models.keras.files import REMEDY, ModelFileError, load_keras_model
from models.keras.layers import convert_layers
from models.keras.model import LINEAR, NO_CHAIN, RELU, Activation, KerasLayer, KerasModel

# Random images on which the architecture is compared with the model.
COMPARED_IMAGES = 8

# Largest difference to the model's output, as a share of its largest output.
MAX_DIFFERENCE = 1e-3


def read_keras(path, retrain: bool = False, grid=None, pixels: bool = True) -> KerasModel:
    """Read a file of a Keras model; a file is read once in a process.

    Parameters
    ----------
    path : path-like
    retrain : bool
        Replace maxima by averages and other activations by ReLUs, since training continues.
    grid : tuple of int, optional
        (rows, columns, channels) of an image, for a model whose input is a vector.
    pixels : bool
        Multiply images, which end at 1, by 255 for a model that begins with the scaling of pixels;
        False for one that was trained on images as they are.

    Raises
    ------
    ModelFileError
        The file is no model, or the model is not supported; the message names the file, the layer
        if any, and a remedy.
    UserError
        The file cannot be converted.
    """
    path = Path(path)
    if path.is_dir():
        raise ModelFileError(f"{path}: is a folder, as a SavedModel is; {REMEDY}")
    try:
        with reporting_os_errors(path, "cannot read", "check the path"):
            sha256 = hash_file(path)
            # A model of images has rows and columns of its own.
            is_of_vectors = len(_load(path, sha256).inputs[0].shape) == 2
            return _convert(path, sha256, retrain, grid if is_of_vectors else None, pixels)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


@functools.lru_cache(maxsize=2)
def _load(path, sha256):
    """Load the model of a file whose content has a hash."""
    model = load_keras_model(path)
    if len(model.inputs) != 1 or len(model.outputs) != 1:
        raise ModelFileError("has several inputs or outputs; use one chain of layers")
    return model


@functools.lru_cache(maxsize=2)
def _convert(path, sha256, retrain, grid, pixels) -> KerasModel:
    """Convert the model of a file whose content has a hash."""
    model = _load(path, sha256)
    layers = [_read_layer(layer) for layer in _flatten_layers(model)]
    converted = convert_layers(tuple(model.inputs[0].shape[1:]), layers, retrain, grid, pixels)
    if not converted.architecture.spiking:
        raise ModelFileError("has no layer of neurons before its output; add one with a ReLU")
    _compare(model, converted)
    return converted


def _flatten_layers(model):
    """The layers of a model, with those of models inside of it."""
    for layer in model.layers:
        if hasattr(layer, "layers"):
            yield from _flatten_layers(layer)
        else:
            yield layer


def _read_layer(layer) -> KerasLayer:
    if hasattr(layer, "_set_dtype_policy"):  # Keras 2; layers of mixed precision have 16 bits
        layer._set_dtype_policy("float32")
    else:
        layer.dtype_policy = "float32"
    config = layer.get_config()
    name = config.get("activation")
    activation = LINEAR if name is None else Activation(name, layer.activation)
    try:
        size = math.prod(n or 0 for n in layer.output.shape[1:])
    except (AttributeError, ValueError) as error:
        raise ModelFileError(f"layer {layer.name!r}: {NO_CHAIN}") from error
    arrays = tuple(layer.get_weights())
    return KerasLayer(type(layer).__name__, layer.name, config, arrays, layer, activation, size)


def make_original_network(model: KerasModel):
    """The network of the file, with its own activations, maxima and padding, on a sensor's images.

    Returns
    -------
    tf_keras.Model
        See :func:`models.cnn.build_cnn`; its outputs are logits.
    """
    from models.cnn import build_cnn, set_weights
    from models.keras.keras2 import tf

    names = list(model.architecture.spiking)

    def make_activation(index):
        activation = model.activations.get(names[index], RELU)
        return tf.keras.layers.Activation(lambda values: activation.function(values))

    network = build_cnn(model.architecture, make_activation)

    def replace_layer(layer):
        if layer.name in model.max_pools:
            pool = model.max_pools[layer.name]
            if pool.kernel is None:
                return tf.keras.layers.Lambda(
                    lambda values: _take_maximum(values, pool), name=layer.name
                )
            return _make_layer_of_maxima(layer, pool)
        if layer.name in model.paddings:
            return _make_padded_convolution(layer, model.paddings[layer.name])
        return layer

    if model.max_pools or model.paddings:
        network = tf.keras.models.clone_model(network, clone_function=replace_layer)
    set_weights(network, model.weights)
    return network


def _take_maximum(values, pool):
    from models.keras.keras2 import tf

    signs = pool.signs.astype(np.float32)
    return signs * tf.nn.max_pool2d(signs * values, pool.size, pool.strides, pool.padding.upper())


def _make_layer_of_maxima(layer, pool):
    """A layer of the maxima over windows of an image, with the kernel of the file."""
    from models.keras.keras2 import tf

    class OfMaxima(type(layer)):
        def call(self, inputs):
            maxima = _take_maximum(tf.reshape(inputs, (-1, *pool.image)), pool)
            if pool.conv_strides:
                sums = tf.nn.conv2d(maxima, pool.kernel, pool.conv_strides, "VALID")
            else:
                sums = tf.reshape(maxima, (-1, len(pool.kernel))) @ pool.kernel
            return sums + self.bias

    return OfMaxima.from_config(layer.get_config())


def _make_padded_convolution(layer, padding):
    """A convolution of the same weights whose input is padded with a value for each channel."""
    from models.keras.keras2 import tf

    padding = padding.astype(np.float32)

    class PaddedConvolution(tf.keras.layers.Conv2D):
        def call(self, inputs):
            # Zeros that are padded around the difference are the value.
            inside = super().call(inputs - padding)
            return inside + tf.reduce_sum(self.kernel * padding[:, None], (0, 1, 2))

    return PaddedConvolution.from_config(layer.get_config())


def _compare(model, converted: KerasModel):
    """Refuse a model that is no chain of its layers, or that has an effect in prediction only."""
    from models.cnn import predict
    from models.keras.keras2 import quiet_compiler, tf

    shape = converted.architecture.input_shape
    images = np.random.default_rng(0).uniform(0, 1, (COMPARED_IMAGES, *shape)).astype(np.float32)
    values = images.reshape(COMPARED_IMAGES, -1)[:, converted.input_order.ravel()]
    inputs = converted.input_scale * values
    inputs = inputs.reshape(COMPARED_IMAGES, *converted.input_order.shape)
    # XLA computes convolutions with channels first on a CPU, which TensorFlow does not.
    is_channels_first = '"channels_first"' in model.to_json()
    if is_channels_first:
        quiet_compiler()
    compute = tf.function(model, jit_compile=True) if is_channels_first else model
    with np.errstate(all="ignore"):
        outputs = np.asarray(compute(inputs, training=False))
        logits = predict(make_original_network(converted), images)
        if outputs.shape[1] == 1:
            logits = logits[:, 1:] - logits[:, :1]
        difference = np.abs(converted.end.function(tf.constant(logits)) - outputs).max()
        if not difference <= MAX_DIFFERENCE * np.abs(outputs).max():
            raise ModelFileError(NO_CHAIN)
