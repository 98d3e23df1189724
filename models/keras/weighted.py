"""Keras's layers with weights, convolutions and dense layers, in the layers of an architecture."""

import math

import numpy as np

from deploy.network.geometry import list_windows
from models.keras.converter import NO_CHAIN, RETRAIN, LayerConverter
from models.keras.model import KerasLayer
from models.ops import Convolution
from models.windows import Window, fit_to_chip, spread_kernel, sum_shifted


def convert_dense(converter: LayerConverter, layer: KerasLayer):
    """Append a dense layer, with its activation."""
    if len(converter.signal.shape) != 1:
        layer.refuse("is applied to each row and column; put a Flatten before it")
    kernel, bias = _read_kernel_and_bias(layer)
    if len(kernel) != len(converter.signal.offset):
        layer.refuse(NO_CHAIN)
    converter.append_dense(layer, kernel, bias)
    converter.use_layer_activation(layer)


def convert_convolution(converter: LayerConverter, layer: KerasLayer):
    """Append a convolution, with its activation."""
    if not converter.signal.is_image:
        layer.refuse("its input has no rows and columns")
    converter.require_activation(layer)
    kernel, bias = _read_kernel_and_bias(layer)
    if kernel.shape[1] != converter.signal.shape[2]:
        layer.refuse(NO_CHAIN)
    window, counts, (scale, offset) = _find_window(converter, layer, kernel)
    if window.stride[0] != window.stride[1]:
        layer.refuse("its strides along rows and columns differ; use the same")
    padding = layer.config["padding"]
    paddings = (padding, "same" if padding == "valid" else "valid")
    built = converter.signal.built
    fitting = fit_to_chip(window, built[:2], counts, paddings)
    if fitting is None:
        size = "x".join(map(str, window.kernel.shape[2:]))
        layer.refuse(
            f"its kernel of {size} with {window.before} zeros before the image has other "
            "windows than a square kernel with padding='same' or 'valid'; use one of these"
        )
    kernel = fitting["weights"]
    operation = Convolution(kernel.shape[-1], len(kernel), fitting["stride"], fitting["padding"])
    if offset.any() and _reads_padding(window, built, counts):
        _pad_without_offset(converter, layer, scale, offset)
    if len(kernel) != max(layer.read_pair("kernel_size")):
        size = f"{operation.kernel_size}x{operation.kernel_size}"
        converter.notes.append(f"{layer}: its windows became a kernel of {size}")
    bias = bias + np.einsum("ijcf,c->f", kernel, offset)
    converter.append_sums(layer, operation, kernel * scale[:, None], bias)
    converter.use_layer_activation(layer)


def _find_window(converter, layer, kernel):
    """The windows of a convolution on the built image, their counts, and its affine input.

    Parameters
    ----------
    converter : LayerConverter
    layer : KerasLayer
    kernel : ndarray, shape (filters, channels, rows, columns)
    """
    strides = layer.read_pair("strides")
    sides = converter.signal.shape[:2]
    along = [
        list_windows(*side, layer.config["padding"])
        for side in zip(sides, kernel.shape[2:], strides, strict=True)
    ]
    counts = [count for count, _, _ in along]
    before = tuple(
        zeros + pads[0] for (_, zeros, _), pads in zip(along, converter.signal.pads, strict=True)
    )
    if min(counts) < 1:
        layer.refuse("its kernel is larger than its input; use a smaller one")
    affine = converter.signal.find_channel_affine()
    if affine is not None:
        return Window(kernel, strides, before), counts, affine
    means = converter.means
    if means is None or means.map is not converter.signal.map:
        layer.refuse(converter.signal.describe_obstacle())
    if any(zeros or after for _, zeros, after in along):
        layer.refuse(
            "pads zeros around averages over windows that overlap or are not square; use "
            "padding='valid', AveragePooling2D(2), or a Dense after the averages"
        )
    kernel = spread_kernel(kernel, 1, means.strides)
    kernel = sum_shifted(kernel, means.size, (1, 1)) / math.prod(means.size)
    strides = tuple(a * b for a, b in zip(strides, means.strides, strict=True))
    return Window(kernel, strides, before), counts, means.affine


def _pad_without_offset(converter, layer, scale, offset):
    """Pad zeros of the built signal instead of zeros of the normalised one."""
    if not converter.retrain or not scale.all():
        layer.refuse(
            "zero padding after a normalisation or rescaling with an offset cannot be folded "
            f"into weights; {RETRAIN} padding before the normalisation and is trained further; "
            "or use padding='valid', or normalise before the ReLU of the layer before"
        )
    converter.paddings[len(converter.layers)] = -offset / scale
    converter.replaced.append(f"{layer}: zeros padded before the normalisation, not after it")


def _reads_padding(window, image, counts) -> bool:
    """True if windows read zeros outside of the image."""
    if any(window.before):
        return True
    reach = window.kernel.shape[2:]
    sides = zip(image, reach, counts, strict=False)
    return any((count - 1) * window.stride[0] + size > n for n, size, count in sides)


def _read_kernel_and_bias(layer):
    """Kernel and bias of a layer: (inputs, outputs) of a Dense, else (filters, channels, ...)."""
    kernel, *arrays = (array.astype(float) for array in layer.arrays)
    groups = layer.config.get("groups", 1)
    if layer.kind in ("DepthwiseConv2D", "SeparableConv2D"):
        groups = kernel.shape[2]
        kernel = kernel.reshape(*kernel.shape[:2], 1, -1)
    if layer.kind != "Dense":
        kernel = spread_kernel(
            kernel.transpose(3, 2, 0, 1), groups, layer.read_pair("dilation_rate")
        )
    if layer.kind == "SeparableConv2D":
        kernel = np.einsum("fcij,fo->ocij", kernel, arrays.pop(0)[0, 0])
    outputs = kernel.shape[1] if layer.kind == "Dense" else kernel.shape[0]
    return kernel, arrays[0] if arrays else np.zeros(outputs)
