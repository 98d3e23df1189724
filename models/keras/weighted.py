"""Keras's layers with weights, convolutions and dense layers, in the layers of an architecture."""

import math

import numpy as np

from deploy.network.geometry import list_windows
from models.keras.converter import RETRAIN, LayerConverter
from models.keras.model import NO_CHAIN, KerasLayer
from models.keras.signal import compute_counts, make_matrix
from models.ops import Convolution
from models.windows import Window, average_before, fit_window_to_chip, spread_kernel


def convert_dense(converter: LayerConverter, layer: KerasLayer):
    """Append a dense layer, with its activation."""
    if len(converter.signal.shape) != 1:
        layer.refuse("is applied to each row and column; put a Flatten before it")
    kernel, bias = _read_kernel_and_bias(layer)
    if len(kernel) != len(converter.signal.offset):
        layer.refuse(NO_CHAIN)
    converter.append_dense(layer, kernel, bias)
    converter.use_activation(layer, layer.activation)


def convert_convolution(converter: LayerConverter, layer: KerasLayer):
    """Append a convolution, or its matrix if the chip has no such windows, with its activation."""
    signal = converter.signal
    kernel, bias = _read_kernel_and_bias(layer)
    if not signal.is_image or kernel.shape[1] != signal.shape[2]:
        layer.refuse(NO_CHAIN)
    strides = layer.read_pair("strides")
    padding = layer.config["padding"]
    counts = compute_counts(signal.shape, kernel.shape[2:], strides, padding)
    if min(counts) < 1:
        layer.refuse("its kernel is larger than its input; use a smaller one")
    converter.require_activation(layer)
    if not _append_windows(converter, layer, kernel, bias, counts):
        matrix = make_matrix(kernel, signal.shape, strides, padding)
        converter.append_dense(layer, matrix.T, np.tile(bias, math.prod(counts)))
        signal.arrange(signal.positions.reshape(*counts, -1))
        converter.notes.append(
            f"{layer}: its windows are not those of the chip (a square kernel with equal strides "
            "and padding='same' or 'valid', on the image before it); takes the memory of a dense "
            "layer"
        )
    converter.use_activation(layer, layer.activation)


def _append_windows(converter, layer, kernel, bias, counts) -> bool:
    """Append a convolution if the chip has its windows."""
    found = _find_windows(converter, layer, kernel.shape[2:])
    if found is None:
        return False
    before, averaged, (scale, offset) = found
    window = Window(kernel, layer.read_pair("strides"), before)
    if averaged is not None:
        window = average_before(window, averaged.size, averaged.strides)
    padding = layer.config["padding"]
    paddings = (padding, "same" if padding == "valid" else "valid")
    image = converter.signal.built
    fitting = fit_window_to_chip(window, image[:2], counts, paddings)
    if fitting is None:
        return False
    weights = fitting["weights"]
    operation = Convolution(weights.shape[-1], len(weights), fitting["stride"], fitting["padding"])
    if offset.any() and _reads_padding(window, image, counts):
        _pad_without_offset(converter, layer)
    if len(weights) != max(layer.read_pair("kernel_size")):
        size = f"{operation.kernel_size}x{operation.kernel_size}"
        converter.notes.append(f"{layer}: its windows became a kernel of {size}")
    bias = bias + np.einsum("ijcf,c->f", weights, offset)
    converter.append_sums(layer, operation, weights * scale[:, None], bias)
    return True


def _find_windows(converter, layer, size):
    """Find the values of the built image that a convolution reads; None if there is no image.

    Returns
    -------
    before : tuple of int
        Zeros before the first row and column.
    averaged : WindowMeans or None
        The averages that it reads.
    affine : tuple of ndarray
        Scale and offset of each channel.
    """
    if converter.ends_dense:
        return None
    signal = converter.signal
    along = zip(signal.shape, size, layer.read_pair("strides"), strict=False)
    zeros = [list_windows(*side, layer.config["padding"])[1:] for side in along]
    before = tuple(n[0] + pads[0] for n, pads in zip(zeros, signal.pads, strict=True))
    affine = signal.find_channel_affine()
    if affine is not None:
        return before, None, affine
    means = converter.means
    is_padded = signal.is_padded or any(map(any, zeros))
    if means is None or means.map is not signal.map or is_padded:
        return None
    return before, means, means.affine


def _pad_without_offset(converter, layer):
    """Pad zeros of the built signal instead of zeros of the normalised one."""
    if not converter.retrain:
        layer.refuse(
            "zero padding after a normalisation or rescaling with an offset cannot be folded "
            f"into weights; {RETRAIN} padding before the normalisation and is trained further; "
            "or use padding='valid', or normalise before the ReLU of the layer before"
        )
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
