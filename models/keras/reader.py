"""A user's Keras model as an architecture and weights that compute the same function.

The layers are converted one by one (:mod:`models.keras.layers`).  In the end the result is compared
with the model on random images; where layers were replaced, because training continues, the layers
themselves are, one after the other.
"""

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.files import hash_file, reporting_os_errors
from models.keras.files import REMEDY, ModelFileError, load_keras_model
from models.keras.layers import TRAINING_LAYERS, convert_layers
from models.keras.model import LINEAR, NO_CHAIN, Activation, KerasLayer, KerasModel

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
    predict = functools.partial(model, training=False)
    converted = replace(converted, function=_make_function(model, predict))
    if not converted.architecture.spiking:
        raise ModelFileError("has no layer of neurons before its output; add one with a ReLU")
    _compare(model, layers, converted)
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


def _make_function(model, compute):
    """Return ``compute``, which calls the layers of a model, compiled if they need it."""
    from models.keras.keras2 import quiet_compiler, tf

    # XLA computes convolutions with channels first on a CPU, which TensorFlow does not.
    if '"channels_first"' not in model.to_json():
        return compute
    quiet_compiler()
    return tf.function(compute, jit_compile=True)


def _compare(model, layers, converted: KerasModel):
    """Refuse a model that is no chain of its layers, or that has an effect in prediction only."""
    from models.cnn import build_cnn, compute_logits, set_weights
    from models.keras.keras2 import tf

    def compute_one_by_one(values):
        for layer in layers:
            if layer.kind not in ("InputLayer", *TRAINING_LAYERS):
                values = layer.function(values)
        return values

    shape = converted.architecture.input_shape
    images = np.random.default_rng(0).uniform(0, 1, (COMPARED_IMAGES, *shape)).astype(np.float32)
    with np.errstate(all="ignore"):
        outputs = converted.compute_outputs(images)
        if converted.replaced:
            function = _make_function(model, compute_one_by_one)
            computed = replace(converted, function=function).compute_outputs(images)
        else:
            network = build_cnn(converted.architecture)
            set_weights(network, converted.weights)
            logits = compute_logits(network, images)
            if math.prod(model.output_shape[1:]) == 1:  # its sigmoid is that of their difference
                logits = np.hstack([logits[:, :1] - logits[:, 1:], logits[:, 1:] - logits[:, :1]])
            computed = np.asarray(converted.end.function(tf.constant(logits)))
        if not np.abs(computed - outputs).max() <= MAX_DIFFERENCE * np.abs(outputs).max():
            raise ModelFileError(NO_CHAIN)
