"""Keras's layers that move or scale values, as the linear function of a signal.

The layers themselves compute where values go and how they are scaled, from numbers of the values,
from zeros and from ones.
"""

import numpy as np

from models.keras.converter import MAX_PIXEL, LayerConverter
from models.keras.model import KerasLayer

# Largest input whose values, of any size, a first layer brings to a size of about 1, which is not
# that of an image of pixels: images here end at 1.
MAX_IMAGE_VALUE = 20.0


def rearrange(converter: LayerConverter, layer: KerasLayer):
    """Move values, repeat them, leave some out, or put zeros between them."""
    numbers = layer.compute(converter.signal.positions + 1)
    converter.signal.arrange(np.rint(numbers).astype(int) - 1)


def convert_zero_padding(converter: LayerConverter, layer: KerasLayer):
    """Put zeros around rows and columns."""
    converter.signal.pad(tuple(map(tuple, layer.config["padding"])))


def scale(converter: LayerConverter, layer: KerasLayer):
    """Scale and shift each value."""
    offset, moved = (layer.compute(np.full(converter.signal.shape, value)) for value in (0.0, 1.0))
    factor = moved - offset
    if layer.kind != "BatchNormalization":
        _take_pixels(converter, layer, factor, offset)
    converter.apply_affine(layer, factor.ravel(), offset.ravel())


def _take_pixels(converter, layer, factor, offset):
    """Multiply images, whose values end at 1, for a first layer whose input ends at 255."""
    with np.errstate(divide="ignore", invalid="ignore"):
        largest = ((1 + np.abs(offset)) / np.abs(factor)).max()
    if not largest > MAX_IMAGE_VALUE or converter.layers or converter.input_scale != 1:
        return
    if not converter.pixels:
        converter.notes.append(f"{layer}: scales pixels up to 255, and images here end at 1")
        return
    converter.input_scale = MAX_PIXEL
    converter.signal.scale(np.full(len(converter.signal.offset), MAX_PIXEL), 0.0)
    converter.notes.append(
        f"{layer}: is for pixels up to 255; images here end at 1 and are multiplied by 255"
    )
