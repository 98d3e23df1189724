"""Keras's layers without weights that move or scale values, as the linear function of a signal."""

import math

import numpy as np

from models.architecture import MAX_VALUES
from models.keras.converter import MAX_PIXEL, NO_CHAIN, LayerConverter
from models.keras.model import KerasLayer

# The least deviation of Keras's Normalization.
MIN_DEVIATION = 1e-7

# The scale below which a first Rescaling is for pixels (1/127.5 is the largest in use), and the sum
# of mean and deviation above which a Normalization is.
MAX_PIXEL_SCALE = 0.01
MAX_STANDARDISED = 2.0


def convert_flatten(converter: LayerConverter, layer: KerasLayer):
    """Move the values into one dimension."""
    converter.signal.flatten()


def convert_reshape(converter: LayerConverter, layer: KerasLayer):
    """Move the values into another shape."""
    target = tuple(layer.config["target_shape"])
    try:
        converter.signal.arrange(converter.signal.positions.reshape(target))
    except ValueError:
        layer.refuse(NO_CHAIN)


def convert_permute(converter: LayerConverter, layer: KerasLayer):
    """Exchange dimensions."""
    axes = [axis - 1 for axis in layer.config["dims"]]
    converter.signal.arrange(converter.signal.positions.transpose(axes))


def convert_zero_padding(converter: LayerConverter, layer: KerasLayer):
    """Put zeros around rows and columns."""
    pads = layer.config["padding"]
    pads = (pads, pads) if isinstance(pads, int) else pads
    pads = tuple((n, n) if isinstance(n, int) else tuple(n) for n in pads)
    sides = [n + sum(around) for n, around in zip(converter.signal.shape, pads, strict=False)]
    if math.prod(sides) * converter.signal.shape[2] > MAX_VALUES:
        layer.refuse(f"has more than {MAX_VALUES} values")
    converter.signal.pad(pads)


def convert_cropping(converter: LayerConverter, layer: KerasLayer):
    """Leave out rows and columns at the edges."""
    (top, bottom), (left, right) = layer.config["cropping"]
    rows, columns = converter.signal.shape[:2]
    converter.signal.arrange(
        converter.signal.positions[top : rows - bottom, left : columns - right]
    )


def convert_batch_normalisation(converter: LayerConverter, layer: KerasLayer):
    """Scale and shift the values along an axis as learned."""
    axis = layer.config["axis"]
    axis = axis[0] if isinstance(axis, (list, tuple)) and len(axis) == 1 else axis
    if not isinstance(axis, int):
        layer.refuse("normalises over several axes; use axis=-1")
    arrays = [array.astype(float) for array in layer.arrays]
    gamma = arrays.pop(0) if layer.config.get("scale", True) else 1.0
    beta = arrays.pop(0) if layer.config.get("center", True) else 0.0
    mean, variance = arrays
    scale = gamma / np.sqrt(variance + layer.config["epsilon"])
    shape = [1] * len(converter.signal.shape)
    shape[axis if axis < 0 else axis - 1] = -1
    offset = beta - mean * scale
    scale = np.reshape(scale * np.ones_like(mean), shape)
    converter.apply_affine(layer, scale, np.reshape(offset, shape))


def convert_rescaling(converter: LayerConverter, layer: KerasLayer):
    """Scale and shift all values."""
    scale, offset = (np.asarray(layer.config[key], float) for key in ("scale", "offset"))
    _take_pixels(converter, layer, np.abs(scale).max() <= MAX_PIXEL_SCALE)
    converter.apply_affine(layer, scale, offset)


def convert_normalisation(converter: LayerConverter, layer: KerasLayer):
    """Scale and shift values to a mean of 0 and a deviation of 1."""
    if layer.config.get("invert", False):
        layer.refuse("undoes a normalisation; use Rescaling")
    axis = layer.config["axis"]
    axes = axis if isinstance(axis, (list, tuple)) else [axis]
    shape = [1] * len(converter.signal.shape)
    for number in axes if axis is not None else ():
        index = number if number < 0 else number - 1
        shape[index] = converter.signal.shape[index]
    arrays = layer.arrays[:2]
    if layer.config.get("mean") is not None:
        arrays = layer.config["mean"], layer.config["variance"]
    mean, variance = (
        np.ones(shape) * (values if np.size(values) == 1 else np.reshape(values, shape))
        for values in arrays
    )
    deviation = np.maximum(np.sqrt(variance), MIN_DEVIATION)
    _take_pixels(converter, layer, (np.abs(mean) + deviation).max() > MAX_STANDARDISED)
    converter.apply_affine(layer, 1 / deviation, -mean / deviation)


def _take_pixels(converter, layer, has_pixels):
    """Multiply images, whose values end at 1, for a first layer whose input ends at 255."""
    if not has_pixels or converter.layers or converter.input_scale != 1:
        return
    if not converter.pixels:
        converter.notes.append(f"{layer}: scales pixels up to 255, and images here end at 1")
        return
    converter.input_scale = MAX_PIXEL
    converter.signal.scale(np.full(len(converter.signal.offset), MAX_PIXEL), 0.0)
    converter.notes.append(
        f"{layer}: is for pixels up to 255; images here end at 1 and are multiplied by 255"
    )
