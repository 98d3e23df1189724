"""Windows of convolutions and pooling over an image."""

from __future__ import annotations

import numpy as np

from ..arithmetic import divide_up


def list_windows(n: int, size: int, stride: int = 1, padding: str = "valid"):
    """Windows of a convolution along one dimension.

    Parameters
    ----------
    n : int
        Number of values along the dimension.
    size, stride : int
        Length of a window, and distance from one to the next.
    padding : str
        ``"valid"``; ``"same"``: ceil(n / stride) windows, which takes max((ceil(n / stride) - 1)
        stride + size - n, 0) zeros, half of them before the values, rounded down (as TensorFlow and
        Nengo have it); or a number of zeros before and after the values, such as ``"1"``.

    Returns
    -------
    count, before, after : int
        Number of windows (0 or less if none fits), and zeros before and after the values.
    """
    zeros = 0
    if padding == "same":
        zeros = max((divide_up(n, stride) - 1) * stride + size - n, 0)
    elif padding != "valid":
        zeros = 2 * int(padding)
    return (n + zeros - size) // stride + 1, zeros // 2, zeros - zeros // 2


def compute_padded_kernel_size(n: int, kernel_size: int, stride: int, zeros: str) -> int:
    """Size of a kernel with zeros at its end, whose last window ends with the padded values."""
    count = list_windows(n, kernel_size, stride, zeros)[0]
    return n + 2 * int(zeros) - (count - 1) * stride


def count_windows(n: int, count: int, size: int, stride: int, before: int) -> np.ndarray:
    """Number of windows, of ``count``, that contain each of n positions, int64, shape (n,)."""
    steps = np.zeros(n + 1, np.int64)
    start = np.arange(count) * stride - before
    np.add.at(steps, np.clip(start, 0, n), 1)
    np.add.at(steps, np.clip(start + size, 0, n), -1)
    return np.cumsum(steps)[:n]


def compute_convolution_shape(
    input_shape, kernel_size, filters, stride=1, padding="valid"
) -> tuple:
    """(rows, columns, channels) of a convolution's output."""
    return (*(list_windows(n, kernel_size, stride, padding)[0] for n in input_shape[:2]), filters)


def count_convolution_fan_out(
    input_shape, kernel_size, filters, stride=1, padding="valid"
) -> np.ndarray:
    """Synapses that leave each input of a convolution, int64, of shape ``input_shape``."""
    reach = []
    for n in input_shape[:2]:
        count, before, _ = list_windows(n, kernel_size, stride, padding)
        reach.append(count_windows(n, count, kernel_size, stride, before))
    positions = np.outer(*reach) * filters
    return np.repeat(positions[..., None], input_shape[2], axis=2)


def compute_pooled_shape(input_shape, size: int) -> tuple:
    """Shape after average pooling without overlap; incomplete windows at the end are dropped."""
    rows, columns, channels = input_shape
    return (rows // size, columns // size, channels)


def sum_windows(values, size: int) -> np.ndarray:
    """Sums over the squares of an average pooling, which are its averages times ``size**2``.

    Parameters
    ----------
    values : ndarray, shape (n, rows, columns, channels)
        The values may have any shape if ``size`` is 1.
    size : int
        Side length of the squares; incomplete ones at the end are dropped.

    Returns
    -------
    ndarray, shape (n, rows // size, columns // size, channels)
    """
    if size == 1:
        return values
    rows, columns, channels = compute_pooled_shape(values.shape[1:], size)
    complete = values[:, : rows * size, : columns * size]
    return complete.reshape(-1, rows, size, columns, size, channels).sum((2, 4))


def unpool(values, input_shape, size: int) -> np.ndarray:
    """Expand values after a pooling to the positions before it.

    Parameters
    ----------
    values : ndarray, shape (rows // size, columns // size, channels, ...)
    input_shape : tuple of int
        (rows, columns, channels).
    size : int

    Returns
    -------
    ndarray, shape (rows, columns, channels, ...)
        0 outside of complete windows.
    """
    values = np.asarray(values)
    spread = values.repeat(size, axis=0).repeat(size, axis=1)
    result = np.zeros((*input_shape[:2], *values.shape[2:]), values.dtype)
    result[: spread.shape[0], : spread.shape[1]] = spread
    return result


def list_inputs_within(input_shape, complete_shape):
    """Indices of the inputs in the first rows and columns, or None for all of them.

    Values outside of complete pooling windows are not read.

    Parameters
    ----------
    input_shape, complete_shape : tuple of int
        (rows, columns, channels) of the input, and of its complete pooling windows.
    """
    if complete_shape == input_shape:
        return None
    indices = np.arange(np.prod(input_shape)).reshape(input_shape)
    return indices[: complete_shape[0], : complete_shape[1]].ravel().tolist()
