"""Keras's pooling: averages, and maxima that a further training replaces by averages."""

from dataclasses import replace

import numpy as np

from deploy.network.geometry import list_windows
from models.keras.converter import RETRAIN, LayerConverter, WindowMeans
from models.keras.model import KerasLayer, MaxPool
from models.keras.signal import Signal
from models.ops import Pooling


def convert_average_pooling(converter: LayerConverter, layer: KerasLayer):
    """Average over windows."""
    _pool_average(
        converter, layer.read_pair("pool_size"), _read_strides(layer), layer.config["padding"]
    )


def convert_global_average_pooling(converter: LayerConverter, layer: KerasLayer):
    """Average over all rows and columns."""
    _pool_average(converter, converter.signal.shape[:2], converter.signal.shape[:2], "valid")
    _drop_sides(converter, layer)


def convert_max_pooling(converter: LayerConverter, layer: KerasLayer):
    """Take averages in place of the maxima over windows."""
    _pool_maximum(
        converter,
        layer,
        layer.read_pair("pool_size"),
        _read_strides(layer),
        layer.config["padding"],
    )


def convert_global_max_pooling(converter: LayerConverter, layer: KerasLayer):
    """Take an average in place of the maximum over all rows and columns."""
    _pool_maximum(converter, layer, converter.signal.shape[:2], converter.signal.shape[:2], "valid")
    _drop_sides(converter, layer)


def _drop_sides(converter, layer):
    """Leave only channels of one row and column, unless the layer keeps its dimensions."""
    if not layer.config.get("keepdims", False):
        converter.signal.flatten()


def _pool_average(converter, size, strides, padding):
    """Append a pooling, or let the signal have averages that the chip's pooling does not have."""
    affine = None
    if not (converter.is_linear or converter.signal.is_padded):
        affine = converter.signal.find_channel_affine()
    sides = converter.signal.shape[:2]
    fills = padding == "valid" or not any(n % k for n, k in zip(sides, size, strict=True))
    if affine is not None and size == strides and size[0] == size[1] and fills:
        if size != (1, 1):
            converter.layers.append(Pooling(size[0]))
            shape = converter.layers[-1].compute_shape(converter.signal.built)
            converter.signal.begin(shape, *affine)
        return
    is_inside = affine is not None and padding == "valid"
    converter.signal.average(size, strides, padding)
    if is_inside:
        converter.means = WindowMeans(size, strides, affine, converter.signal.map)


def _pool_maximum(converter, layer, size, strides, padding):
    """Append an average in place of a maximum."""
    if not converter.retrain:
        layer.refuse(
            f"the chip cannot take a maximum; {RETRAIN} an average and the network is trained "
            "further; or use AveragePooling2D, or a stride in the convolution before it"
        )
    affine = converter.signal.find_channel_affine()
    sides = converter.signal.shape[:2]
    counts = [list_windows(*side, padding)[0] for side in zip(sides, size, strides, strict=True)]
    is_like_average = strides[0] == strides[1] > 1 and counts == [n // strides[0] for n in sides]
    if affine is None or converter.signal.is_padded:
        layer.refuse(
            "its input is padded, or in another order than rows, columns and channels; use it "
            "right after a convolution"
        )
    scale, offset = affine
    pool = MaxPool(size, strides, padding, np.sign(scale))
    if is_like_average:
        converter.max_pools[len(converter.layers)] = pool
        converter.layers.append(Pooling(strides[0]))
        shape = converter.layers[-1].compute_shape(converter.signal.built)
        converter.signal.begin(shape, scale, offset)
        converter.replaced.append(f"{layer}: replaced by AveragePooling2D({strides[0]})")
        return
    means = Signal(converter.signal.built)
    means.average(size, strides, padding)
    converter.maxima = replace(pool, means=means.map, image=converter.signal.built)
    converter.signal.begin(means.shape, scale, offset)
    converter.replaced.append(f"{layer}: replaced by an average over the same windows")


def _read_strides(layer):
    return layer.read_pair("pool_size" if layer.config["strides"] is None else "strides")
