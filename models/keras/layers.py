"""A chain of Keras layers as an architecture and weights.

`HANDLERS` has a function for each layer that can be converted, `REFUSED` an alternative for others.
The functions change a :class:`models.keras.converter.LayerConverter`, which has the layers
converted so far.
"""

import math

import numpy as np

from models.architecture import MAX_LAYERS, MAX_VALUES
from models.keras.converter import LayerConverter
from models.keras.files import ModelFileError
from models.keras.linear import convert_zero_padding, rearrange, scale
from models.keras.model import Activation, KerasLayer, KerasModel
from models.keras.pooling import convert_pooling
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
    layers = [layer for layer in layers if layer.kind != "InputLayer"]
    for layer in layers:
        _require_usable(layer)
    order = _find_input_order(input_shape, layers, grid)
    converter = LayerConverter(order, retrain, pixels)
    for layer in layers:
        convert_layer(converter, layer)
    _take_deferred_average(converter, converter.deferred)
    return converter.finish()


def _require_usable(layer: KerasLayer):
    if layer.kind not in (*HANDLERS, *TRAINING_LAYERS):
        layer.refuse(f"not supported; {REFUSED.get(layer.kind, USABLE)}")
    if layer.size > MAX_VALUES:
        layer.refuse(f"has more than {MAX_VALUES} values")
    if not all(np.isfinite(array).all() for array in layer.arrays):
        layer.refuse("has NaN or infinite weights; train it again, with a lower learning rate")


def convert_layer(converter: LayerConverter, layer: KerasLayer):
    """Convert the next layer of a chain.

    Raises
    ------
    ModelFileError
        The layer is not supported after those before it.
    """
    if layer.kind in TRAINING_LAYERS:
        converter.notes.append(f"{layer} left out: it only acts in training")
        return
    if len(converter.layers) >= MAX_LAYERS:
        raise ModelFileError(f"has more than {MAX_LAYERS} layers; use fewer")
    if converter.end is not None:  # no output, since a layer follows
        before, activation = converter.end
        converter.end = None
        if activation.name == "softmax":
            layer.refuse(f"follows the softmax of {before}; remove that softmax")
        converter.use_hidden_activation(before, activation)
    if not (layer.kind == "BatchNormalization" or HANDLERS[layer.kind] == convert_activation):
        _take_deferred_average(converter, layer)
    is_channels_first = (
        layer.config.get("data_format") == "channels_first" and HANDLERS[layer.kind] != rearrange
    )
    if is_channels_first and converter.signal.is_image:
        converter.signal.move_axis(0, -1)
    HANDLERS[layer.kind](converter, layer)
    if is_channels_first and converter.signal.is_image:
        converter.signal.move_axis(-1, 0)
    if not converter.is_linear:
        _take_deferred_average(converter, layer)


def _take_deferred_average(converter, before):
    """Take the average in place of a maximum of sums, which have an activation by then."""
    layer, converter.deferred = converter.deferred, None
    if layer is not None:
        converter.require_activation(before)
        convert_layer(converter, layer)


def _find_input_order(input_shape, layers, grid):
    """The positions of an image's values in the model's input, and the shape of the image."""
    shape = tuple(input_shape)
    sizes = "x".join(map(str, shape[:6]))
    if None in shape or not 1 <= len(shape) <= 3 or math.prod(shape) > MAX_VALUES:
        raise ModelFileError(
            f"its input of {sizes} is not an image of a sensor's rows and columns; begin the model "
            "with keras.Input((rows, columns, channels))"
        )
    positions = np.arange(math.prod(shape)).reshape(shape)
    image = positions if len(shape) > 1 else None
    for layer in layers:
        if layer.kind not in ("Reshape", "Permute"):
            break
        positions = np.rint(layer.compute(positions)).astype(int)
        if positions.ndim == 3 or (positions.ndim == 2 and len(shape) == 1):
            image = positions
    if image is None:
        image = positions.reshape(_find_image_of_vector(len(positions.ravel()), grid))
    if image.ndim == 2:
        image = image[..., None]
    formats = [layer.config["data_format"] for layer in layers if "data_format" in layer.config]
    if image.shape == shape and formats[:1] == ["channels_first"]:
        image = np.moveaxis(image, 0, -1)
    order = np.empty(image.size, int)
    order[image.ravel()] = np.arange(image.size)
    return order.reshape(shape), image.shape


def _find_image_of_vector(length, grid):
    """The shape of the image that a vector of values has: the sensor's, or a square."""
    if grid is not None and math.prod(grid) == length:
        return tuple(grid)
    side = math.isqrt(length)
    if side * side == length:
        return side, side, 1
    raise ModelFileError(
        f"its input is a vector of {length} values; say of which rows and columns: "
        "--set skin.rows=... --set skin.columns=..."
    )


def convert_activation(converter: LayerConverter, layer: KerasLayer):
    """Use the function of a layer."""
    name = layer.config.get("activation") or ACTIVATIONS.get(layer.kind, layer.kind)
    if any(layer.config.get(key) for key in ("max_value", "negative_slope", "threshold")):
        name = ACTIVATIONS["LeakyReLU"] if layer.kind == "LeakyReLU" else "ReLU with arguments"
    converter.use_activation(layer, Activation(name, layer.function))


# Names of functions of layers.
ACTIVATIONS = {"ReLU": "relu", "LeakyReLU": "leaky_relu", "ELU": "elu", "Softmax": "softmax"}

HANDLERS = {
    **dict.fromkeys(("Conv2D", "DepthwiseConv2D", "SeparableConv2D"), convert_convolution),
    "Dense": convert_dense,
    **dict.fromkeys(("Activation", *ACTIVATIONS, "PReLU", "ThresholdedReLU"), convert_activation),
    **dict.fromkeys(("BatchNormalization", "Rescaling", "Normalization"), scale),
    **dict.fromkeys(
        ("Flatten", "Reshape", "Permute", "Cropping2D", "CenterCrop", "RepeatVector"), rearrange
    ),
    "ZeroPadding2D": convert_zero_padding,
    **dict.fromkeys(("AveragePooling2D", "GlobalAveragePooling2D"), convert_pooling),
    **dict.fromkeys(("MaxPooling2D", "GlobalMaxPooling2D"), convert_pooling),
}
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
    "Resizing": "train the model on images of the sensor's size",
    **dict.fromkeys(
        ("Add", "Concatenate", "Multiply", "Average"), "use one chain, without branches"
    ),
}
