"""Keras's pooling: averages, and maxima that a further training replaces by averages."""

from dataclasses import replace

import numpy as np

from models.keras.converter import RETRAIN, LayerConverter, WindowMeans
from models.keras.model import KerasLayer, MaxPool
from models.keras.signal import Signal, compute_counts
from models.ops import Pooling


def convert_pooling(converter: LayerConverter, layer: KerasLayer):
    """Average over windows, also in place of a maximum; global pooling has one window."""
    is_global = layer.kind.startswith("Global")
    size = converter.signal.shape[:2] if is_global else layer.read_pair("pool_size")
    has_strides = not is_global and layer.config["strides"] is not None
    strides = layer.read_pair("strides") if has_strides else size
    pool = _pool_maximum if "Max" in layer.kind else _pool_average
    pool(converter, layer, size, strides, layer.config.get("padding", "valid"))
    if is_global and not layer.config.get("keepdims", False):
        converter.signal.flatten()


def _pool_average(converter, layer, size, strides, padding):
    """Append a pooling, or let the signal have averages that the chip's pooling does not have."""
    affine = None
    if not (converter.is_linear or converter.signal.is_padded or converter.maxima):
        affine = converter.signal.find_channel_affine()
    sides = converter.signal.shape[:2]
    fills = padding == "valid" or not any(n % k for n, k in zip(sides, size, strict=True))
    if affine is not None and size == strides and size[0] == size[1] and fills:
        if size != (1, 1):
            _append_pooling(converter, size[0], *affine)
        return
    converter.signal.average(size, strides, padding)
    if affine is not None and padding == "valid":
        converter.means = WindowMeans(size, strides, affine, converter.signal.map)


def _append_pooling(converter, size, scale, offset):
    converter.layers.append(Pooling(size))
    shape = converter.layers[-1].compute_shape(converter.signal.built)
    converter.signal.begin(shape, scale, offset)


def _pool_maximum(converter, layer, size, strides, padding):
    """Append an average in place of a maximum."""
    if not converter.retrain:
        layer.refuse(
            f"the chip cannot take a maximum; {RETRAIN} an average and the network is trained "
            "further; or use AveragePooling2D, or a stride in the convolution before it"
        )
    signal = converter.signal
    affine = signal.find_channel_affine(same_shape=False)
    if affine is None or signal.is_padded or converter.maxima:
        layer.refuse(
            "its input is padded, another maximum, or in another order than rows, columns and "
            "channels; use it right after a convolution"
        )
    counts = compute_counts(signal.shape, size, strides, padding)
    is_halved = strides[0] == strides[1] > 1 and counts == [
        n // strides[0] for n in signal.shape[:2]
    ]
    pool = MaxPool(size, strides, padding, np.where(affine[0] < 0, -1, 1))
    if is_halved and signal.shape == signal.built:
        converter.max_pools[len(converter.layers)] = pool
        _append_pooling(converter, strides[0], *affine)
        converter.replaced.append(f"{layer}: replaced by AveragePooling2D({strides[0]})")
        return
    means = Signal(signal.shape)
    means.average(size, strides, padding)
    converter.maxima = replace(
        pool, means=means.map, shape=means.shape, image=signal.shape
    ).before_dense()
    signal.begin(means.shape, *affine)
    converter.replaced.append(f"{layer}: replaced by an average over the same windows")
