"""A chain of Keras layers as an architecture and weights.

`HANDLERS` has a function for each layer that can be converted, `REFUSED` an alternative for others.
The functions change a :class:`models.keras.converter.LayerConverter`, which has the layers
converted so far.
"""

import math
from collections.abc import Callable

import numpy as np

from models.architecture import MAX_LAYERS, MAX_VALUES
from models.keras.converter import USE_RELU, LayerConverter
from models.keras.files import ModelFileError
from models.keras.linear import (
    convert_batch_normalisation,
    convert_cropping,
    convert_flatten,
    convert_normalisation,
    convert_permute,
    convert_rescaling,
    convert_reshape,
    convert_zero_padding,
)
from models.keras.model import KerasLayer, KerasModel
from models.keras.pooling import (
    convert_average_pooling,
    convert_global_average_pooling,
    convert_global_max_pooling,
    convert_max_pooling,
)
from models.keras.weighted import convert_convolution, convert_dense


def convert_layers(
    input_shape, layers, retrain: bool = False, grid=None, pixels: bool = True
) -> KerasModel:
    """Turn a chain of layers into an architecture and its weights.

    Parameters
    ----------
    input_shape : tuple of int
        Shape of one sample.
    layers : sequence of KerasLayer
    retrain : bool
        Replace what cannot be converted exactly, where training makes up for it.
    grid : tuple of int, optional
        (rows, columns, channels) of an image, for a model whose input is a vector.
    pixels : bool
        Multiply images by 255 for a model that begins with the scaling of pixels.

    Raises
    ------
    ModelFileError
        A layer is not supported.
    """
    order = _find_input_order(input_shape, layers, grid)
    converter = LayerConverter(order, retrain, pixels)
    for layer in layers:
        convert_layer(converter, layer)
    return converter.finish()


def convert_layer(converter: LayerConverter, layer: KerasLayer):
    """Convert the next layer of a chain.

    Raises
    ------
    ModelFileError
        The layer is not supported after those before it.
    """
    if layer.kind == "InputLayer":
        return
    if layer.kind in TRAINING_LAYERS:
        converter.notes.append(f"{layer} left out: it only acts in training")
        return
    if layer.kind not in HANDLERS:
        layer.refuse(f"not supported; {REFUSED.get(layer.kind, USABLE)}")
    if not all(np.isfinite(array).all() for array in layer.arrays):
        layer.refuse("has NaN or infinite weights; train it again, with a lower learning rate")
    if len(converter.layers) >= MAX_LAYERS:
        raise ModelFileError(f"has more than {MAX_LAYERS} layers; use fewer")
    if converter.maxima is not None and layer.kind in WITH_WINDOWS:
        layer.refuse(
            "follows a maximum whose windows are cut off at the edge, or overlap so that "
            "averages without overlap have another shape; use MaxPooling2D(2) of an even "
            "number of rows and columns, or a stride of 2 with padding='same'"
        )
    if converter.end is not None:  # no output, since a layer follows
        before, activation = converter.end
        converter.end = None
        if activation == "softmax":
            layer.refuse(f"follows the softmax of {before}; remove that softmax")
        converter.use_hidden_activation(before, activation)
    is_channels_first = layer.config.get("data_format") == "channels_first"
    if is_channels_first and converter.signal.is_image:
        converter.signal.move_axis(0, -1)
    HANDLERS[layer.kind](converter, layer)
    if is_channels_first and converter.signal.is_image:
        converter.signal.move_axis(-1, 0)


def _find_input_order(input_shape, layers, grid):
    """The positions of an image's values in the model's input, and the shape of the image."""
    shape = tuple(input_shape)
    sizes = "x".join(map(str, shape[:6]))
    if None in shape or not 1 <= len(shape) <= 3 or math.prod(shape) > MAX_VALUES:
        raise ModelFileError(
            f"its input of {sizes} is not an image of a sensor's rows and columns; begin the model "
            "with keras.Input((rows, columns, channels))"
        )
    first = next((layer for layer in layers if layer.kind != "InputLayer"), None)
    if len(shape) == 1:
        image = _find_image_of_vector(shape[0], first, grid)
        return np.arange(shape[0]), image
    if len(shape) == 2:
        shape = (*shape, 1)
    formats = [layer.config["data_format"] for layer in layers if "data_format" in layer.config]
    if len(input_shape) == 3 and formats[:1] == ["channels_first"]:
        image = (*shape[1:], shape[0])
        return np.moveaxis(np.arange(math.prod(shape)).reshape(image), -1, 0), image
    return np.arange(math.prod(shape)).reshape(input_shape), shape


def _find_image_of_vector(length, first, grid):
    """The shape of the image that a vector of values has: what the model says, or a square."""
    if first is not None and first.kind == "Reshape":
        target = tuple(first.config["target_shape"])
        if len(target) in (2, 3) and math.prod(target) == length:
            return target if len(target) == 3 else (*target, 1)
    if grid is not None and math.prod(grid) == length:
        return tuple(grid)
    side = math.isqrt(length)
    if side * side == length:
        return side, side, 1
    raise ModelFileError(
        f"its input is a vector of {length} values; say of which rows and columns: "
        "--set skin.rows=... --set skin.columns=..."
    )


def convert_relu(converter: LayerConverter, layer: KerasLayer):
    """Use a ReLU, or one with a slope, threshold or limit."""
    max_value = layer.config.get("max_value")
    slope = float(layer.config.get("negative_slope") or 0)
    threshold = float(layer.config.get("threshold") or 0)
    activation: str | Callable = "relu"
    if max_value is not None or slope + threshold:
        activation = _make_activation(
            "ReLU with arguments", "relu", max_value=max_value, alpha=slope, threshold=threshold
        )
    converter.use_activation(layer, activation)


def convert_leaky_relu(converter: LayerConverter, layer: KerasLayer):
    """Use a ReLU with a slope below 0."""
    slope = layer.config.get("negative_slope", layer.config.get("alpha"))
    converter.use_activation(
        layer, _make_activation("leaky_relu", "relu", alpha=float(np.asarray(slope)))
    )


def convert_elu(converter: LayerConverter, layer: KerasLayer):
    """Use an ELU."""
    converter.use_activation(
        layer, _make_activation("elu", "elu", alpha=float(layer.config["alpha"]))
    )


def _make_activation(name, function, **arguments) -> Callable:
    """An activation of Keras 2 with arguments."""

    def compute(values):
        from models.keras.keras2 import tf

        return getattr(tf.keras.activations, function)(values, **arguments)

    compute.__name__ = name
    return compute


HANDLERS = {
    "Conv2D": convert_convolution,
    "DepthwiseConv2D": convert_convolution,
    "SeparableConv2D": convert_convolution,
    "Dense": convert_dense,
    "Activation": LayerConverter.use_layer_activation,
    "ReLU": convert_relu,
    "LeakyReLU": convert_leaky_relu,
    "ELU": convert_elu,
    "Softmax": lambda converter, layer: converter.use_activation(layer, "softmax"),
    "BatchNormalization": convert_batch_normalisation,
    "Rescaling": convert_rescaling,
    "Normalization": convert_normalisation,
    "Flatten": convert_flatten,
    "Reshape": convert_reshape,
    "Permute": convert_permute,
    "ZeroPadding2D": convert_zero_padding,
    "Cropping2D": convert_cropping,
    "AveragePooling2D": convert_average_pooling,
    "GlobalAveragePooling2D": convert_global_average_pooling,
    "MaxPooling2D": convert_max_pooling,
    "GlobalMaxPooling2D": convert_global_max_pooling,
}
# Layers that read windows of an image.
WITH_WINDOWS = (
    *("Conv2D", "DepthwiseConv2D", "SeparableConv2D", "AveragePooling2D", "MaxPooling2D"),
    *("GlobalAveragePooling2D", "GlobalMaxPooling2D", "ZeroPadding2D"),
)
# Layers that only act in training.
TRAINING_LAYERS = (
    *("Dropout", "SpatialDropout2D", "AlphaDropout", "GaussianDropout", "GaussianNoise"),
    *("ActivityRegularization", "RandomFlip", "RandomRotation", "RandomZoom", "RandomContrast"),
    *("RandomTranslation", "RandomBrightness", "Identity"),
)
USABLE = "use Conv2D (with a stride), AveragePooling2D, Dense, Flatten, ReLU, BatchNormalization"
# Alternatives to layers that are not supported.
REFUSED = {
    "LayerNormalization": "use BatchNormalization",
    "Conv1D": "use Conv2D on an input of rows, columns, channels",
    "PReLU": USE_RELU,
    "Resizing": "train the model on images of the sensor's size",
    **dict.fromkeys(
        ("Add", "Concatenate", "Multiply", "Average"), "use one chain, without branches"
    ),
}
