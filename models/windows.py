"""Represent the windows of an imported network as those of the chip's convolution.

The chip's convolution has a square kernel and equal strides.  A smaller kernel gets zeros at its
edges, so that groups, dilation, average pooling next to it and other paddings have this form, too.
"""

import math
from dataclasses import dataclass

import numpy as np

from deploy.network.geometry import list_windows


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


def spread_kernel(weight, n_groups: int = 1, dilation=(1, 1)) -> np.ndarray:
    """The kernel of a convolution without groups and dilation.

    Parameters
    ----------
    weight : ndarray, shape (filters, channels of a group, rows, columns)
    n_groups : int
    dilation : tuple of int

    Returns
    -------
    ndarray, shape (filters, channels, rows, columns)
    """
    filters, channels, *size = weight.shape
    reach = [(k - 1) * d + 1 for k, d in zip(size, dilation, strict=True)]
    kernel = np.zeros((filters, channels * n_groups, *reach))
    per_group = filters // n_groups
    for group in range(n_groups):
        of_group = slice(group * per_group, (group + 1) * per_group)
        into = slice(group * channels, (group + 1) * channels)
        kernel[of_group, into, :: dilation[0], :: dilation[1]] = weight[of_group]
    return kernel


def sum_shifted(kernel, size, step) -> np.ndarray:
    """The sum of a kernel at a grid of places: sums over windows after or before a convolution.

    Parameters
    ----------
    kernel : ndarray, shape (filters, channels, rows, columns)
    size : tuple of int
        Numbers of places along rows and columns.
    step : tuple of int
        Distances between places: the convolution's stride for windows after it, 1 before it.
    """
    sides = [n + (k - 1) * d for n, k, d in zip(kernel.shape[2:], size, step, strict=True)]
    summed = np.zeros((*kernel.shape[:2], *sides))
    rows, columns = kernel.shape[2:]
    for row in range(0, size[0] * step[0], step[0]):
        for column in range(0, size[1] * step[1], step[1]):
            summed[:, :, row : row + rows, column : column + columns] += kernel
    return summed


def average_before(window: Window, size, strides) -> Window:
    """The windows of a convolution that reads averages over windows, without padding."""
    kernel = spread_kernel(window.kernel, 1, strides)
    kernel = sum_shifted(kernel, size, (1, 1)) / math.prod(size)
    steps = tuple(a * b for a, b in zip(window.stride, strides, strict=True))
    return Window(kernel, steps, window.before)


def fit_window_to_chip(window: Window, rows_and_columns, counts, paddings=None) -> dict | None:
    """Kernel, stride and padding of the chip's convolution, or None if the chip has none.

    Parameters
    ----------
    window : Window
    rows_and_columns, counts : tuple of int
        Of the input, before averaging, and of the output.
    paddings : sequence of str, optional
        The paddings to choose from, in this order; by default all.

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
    if paddings is None:
        numbers = range(1, max(*window.before, *reach) + 1)
        paddings = ("valid", "same", *map(str, numbers))
    for padding in paddings:
        for side in range(max(reach), max(reach) + max(*reach, 4) + 1):
            on_chip = [list_windows(n, side, stride, padding) for n in sizes]
            has_counts = [count for count, _, _ in on_chip] == list(counts)
            # Zeros at the edges of the kernel, which shift its windows to the right position.
            front = [
                zeros - before for (_, zeros, _), before in zip(on_chip, window.before, strict=True)
            ]
            back = [side - k - f for k, f in zip(reach, front, strict=True)]
            if has_counts and min(*front, *back) >= 0:
                edges = ((0, 0), (0, 0), *zip(front, back, strict=True))
                kernel = np.pad(window.kernel, edges).transpose(2, 3, 1, 0)
                return {
                    "weights": kernel,
                    "stride": stride,
                    "padding": padding,
                    "pool": window.pool,
                }
    return None
