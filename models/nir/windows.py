"""Convolutions and averages of a graph as the windows of one convolution on the chip.

The chip's convolution has a square kernel and equal strides.  A smaller kernel gets zeros at its
edges, so that groups, dilation, averaging after it and every symmetric padding have this form.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from deploy.network.geometry import windows


@dataclass(frozen=True)
class Window:
    """The inputs of each output: a kernel on a grid of windows.

    Attributes
    ----------
    kernel : ndarray, shape (filters, channels, rows, columns)
    stride : tuple of int
    before : tuple of int
        Zeros before the first row and column.
    pool : int
        Side length of the squares of values that are averaged before.
    """

    kernel: np.ndarray
    stride: tuple
    before: tuple
    pool: int = 1


def find_window(nodes, shape, scale_of) -> Window | None:
    """The map of nodes as windows, or None if it has another form.

    Parameters
    ----------
    nodes : sequence of models.nir.graph.Node
    shape : tuple of int
        (channels, rows, columns) of their input.
    scale_of : callable
        Factors of a node that scales its input, of the node's shape.
    """
    window = Window(np.eye(shape[0])[:, :, None, None], (1, 1), (0, 0))
    has_kernel = False
    for node in nodes:
        if node.kind in ("LI", "CubaLI", "Scale"):
            window = _scale(window, scale_of(node))
        elif node.kind == "Conv2d" and not has_kernel:
            has_kernel = True
            window = _convolve(window, node)
        elif node.kind in ("AvgPool2d", "SumPool2d") and not any(map(any, node["padding"])):
            size = node["kernel_size"]
            stride = node["stride"]
            factor = 1.0 if node.kind == "SumPool2d" else 1 / math.prod(size)
            is_square = window.pool == 1 and size == stride and size[0] == size[1]
            if has_kernel:
                window = _sum_windows(window, size, stride, factor)
            elif is_square:
                kernel = window.kernel * factor * size[0] ** 2
                window = replace(window, kernel=kernel, pool=size[0])
            else:
                return None
        elif node.kind not in ("Flatten", "Reshape", "Identity") or node.shape != node.input_shape:
            return None
        if window is None:
            return None
    return window


def fit_to_chip(window: Window, rows_and_columns, counts) -> dict | None:
    """Kernel, stride and padding of the chip's convolution, or None if the chip has none.

    Parameters
    ----------
    window : Window
    rows_and_columns, counts : tuple of int
        Of the input, before averaging, and of the output.

    Returns
    -------
    dict
        ``weights``, shape (rows, columns, channels, filters); ``stride``, ``padding``, ``pool``.
    """
    if window.stride[0] != window.stride[1]:
        return None
    reach = window.kernel.shape[2:]
    stride = window.stride[0]
    sizes = [n // window.pool for n in rows_and_columns]
    zeros = range(1, max(*window.before, *reach) + 1)
    for padding in ("valid", "same", *map(str, zeros)):
        for side in range(max(reach), max(reach) + max(*reach, 4) + 1):
            chips = [windows(n, side, stride, padding) for n in sizes]
            front = [chip[1] - wanted for chip, wanted in zip(chips, window.before, strict=True)]
            back = [side - k - f for k, f in zip(reach, front, strict=True)]
            if [chip[0] for chip in chips] == list(counts) and min(*front, *back) >= 0:
                edges = ((0, 0), (0, 0), *zip(front, back, strict=True))
                kernel = np.pad(window.kernel, edges).transpose(2, 3, 1, 0)
                return {
                    "weights": kernel,
                    "stride": stride,
                    "padding": padding,
                    "pool": window.pool,
                }
    return None


def _scale(window, factors):
    """The windows with factors of their outputs, which must be one a channel."""
    by_channel = factors.reshape(factors.shape[0], -1)
    if (by_channel != by_channel[:, :1]).any():
        return None
    return replace(window, kernel=window.kernel * by_channel[:, 0, None, None, None])


def _convolve(window, node):
    """A convolution, without groups and dilation, of channels that were only scaled before."""
    weight = node["weight"]
    groups = node["groups"]
    dilation = node["dilation"]
    filters, channels, *size = weight.shape
    reach = [(k - 1) * d + 1 for k, d in zip(size, dilation, strict=True)]
    kernel = np.zeros((filters, channels * groups, *reach))
    per_group = filters // groups
    for group in range(groups):
        of_group = slice(group * per_group, (group + 1) * per_group)
        into = slice(group * channels, (group + 1) * channels)
        kernel[of_group, into, :: dilation[0], :: dilation[1]] = weight[of_group]
    scale = np.diagonal(window.kernel[:, :, 0, 0])
    before = tuple(zeros for zeros, _ in node["padding"])
    return Window(kernel * scale[:, None, None], node["stride"], before, window.pool)


def _sum_windows(window, size, stride, factor):
    """Windows of sums over windows: a larger kernel with larger steps."""
    kernel = 0.0
    for row in range(size[0]):
        for column in range(size[1]):
            above = row * window.stride[0]
            left = column * window.stride[1]
            below = (size[0] - 1) * window.stride[0] - above
            right = (size[1] - 1) * window.stride[1] - left
            kernel = kernel + np.pad(window.kernel, ((0, 0), (0, 0), (above, below), (left, right)))
    steps = tuple(a * b for a, b in zip(window.stride, stride, strict=True))
    return replace(window, kernel=kernel * factor, stride=steps)
