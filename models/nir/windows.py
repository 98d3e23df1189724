"""Convolutions and averages of a graph as the windows of one convolution on the chip."""

import math
from dataclasses import replace

import numpy as np

from models.windows import Window, sum_shifted


def find_window(nodes, shape, find_scale) -> Window | None:
    """The map of nodes as windows, or None if it has another form.

    Parameters
    ----------
    nodes : sequence of models.nir.nodes.Node
    shape : tuple of int
        (channels, rows, columns) of their input.
    find_scale : callable
        Factors of a node that scales its input, of the node's shape.
    """
    window = Window(np.eye(shape[0])[:, :, None, None], (1, 1), (0, 0))
    has_convolution = False
    for node in nodes:
        if node.kind in ("LI", "CubaLI", "Scale"):
            window = _scale(window, find_scale(node))
        elif node.kind == "Conv2d" and not has_convolution:
            has_convolution = True
            window = _convolve(window, node)
        elif node.kind in ("AvgPool2d", "SumPool2d") and not any(map(any, node["padding"])):
            size = node["kernel_size"]
            stride = node["stride"]
            factor = 1.0 if node.kind == "SumPool2d" else 1 / math.prod(size)
            is_square = window.pool == 1 and size == stride and size[0] == size[1]
            if has_convolution:
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


def _scale(window, factors):
    """The windows with factors of their outputs, which must be one a channel."""
    by_channel = factors.reshape(factors.shape[0], -1)
    if (by_channel != by_channel[:, :1]).any():
        return None
    return replace(window, kernel=window.kernel * by_channel[:, 0, None, None, None])


def _convolve(window, node):
    """A convolution of channels that were only scaled before."""
    scale = np.diagonal(window.kernel[:, :, 0, 0])
    before = tuple(zeros for zeros, _ in node["padding"])
    return Window(node["weight"] * scale[:, None, None], node["stride"], before, window.pool)


def _sum_windows(window, size, stride, factor):
    """Windows of sums over windows: a larger kernel with larger steps."""
    kernel = sum_shifted(window.kernel, size, window.stride)
    steps = tuple(a * b for a, b in zip(window.stride, stride, strict=True))
    return replace(window, kernel=kernel * factor, stride=steps)
