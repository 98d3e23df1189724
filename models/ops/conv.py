"""Convolutions; see :mod:`deploy.network.ops.conv` for deployed ones."""

import math
import re
from dataclasses import dataclass

import numpy as np

from deploy.network.geometry import convolution_fan_out, convolution_shape, windows
from models.ops.base import NUMBER, Operation, Synapses


@dataclass(frozen=True)
class Convolution(Operation):
    """A convolution with square filters.

    Attributes
    ----------
    filters, kernel : int
        Number of filters and side length of each.
    stride : int
    padding : str
        ``"valid"`` or ``"same"``, as in TensorFlow; of an imported network also a number of zeros
        on each side.
    """

    filters: int
    kernel: int
    stride: int = 1
    padding: str = "valid"
    kind = "conv"
    noun = "a convolution"
    token = re.compile(f"{NUMBER}c{NUMBER}(?:s{NUMBER})?(p?)")
    is_spatial = True

    def __post_init__(self):
        if min(self.filters, self.kernel, self.stride) < 1:
            raise ValueError(f"{self}: filters, kernel and stride must be at least 1")
        if self.padding not in ("valid", "same") and not self.padding.isdecimal():
            raise ValueError(f"{self}: padding is neither 'valid' nor 'same' nor a number")

    @classmethod
    def from_token(cls, match):
        filters, kernel, stride = (int(n) for n in match.groups("1")[:3])
        return cls(filters, kernel, stride, "same" if match[4] else "valid")

    def pads(self, input_shape) -> tuple:
        """Numbers of zeros padded to rows and columns: ((before, after), (before, after))."""
        return tuple(
            windows(n, self.kernel, self.stride, self.padding)[1:] for n in input_shape[:2]
        )

    def shape(self, input_shape) -> tuple:
        """(rows, columns, channels) of the output.

        Raises
        ------
        ValueError
            The kernel is larger than the input.
        """
        shape = convolution_shape(input_shape, self.kernel, self.filters, self.stride, self.padding)
        if min(shape) < 1:
            rows, columns = input_shape[:2]
            raise ValueError(f"does not fit: its kernel is larger than its {rows}x{columns} input")
        return shape

    def weight_shapes(self, input_shape) -> dict:
        """Shapes of ``"kernel"`` (rows, columns, input channels, filters) and of ``"bias"``."""
        kernel = (self.kernel, self.kernel, input_shape[2], self.filters)
        return {"kernel": kernel, "bias": (self.filters,)}

    def fan_out(self, input_shape) -> np.ndarray:
        """Synapses that leave each input position, int64, of shape ``input_shape``."""
        return convolution_fan_out(
            input_shape, self.kernel, self.filters, self.stride, self.padding
        )

    def keras_layer(self, name, gain=None):
        from models.keras.keras2 import tf

        size = self.filters, self.kernel
        options = {"name": name, "strides": self.stride, "padding": self.padding}
        if gain is None:
            return tf.keras.layers.Conv2D(*size, **options)
        from models.cnn import OnChipConv2D

        return OnChipConv2D(*size, gain, **options)

    def sums(self, kernel, frames):
        from models.keras.keras2 import tf

        return tf.nn.conv2d(frames, kernel, self.stride, self.padding.upper())

    def synapses(self, input_shape):
        rows, columns, channels = input_shape
        (top, _), (left, _) = self.pads(input_shape)
        out_rows, out_columns, _ = self.shape(input_shape)
        out_row, out_column, kernel_row, kernel_column, channel = np.indices(
            (out_rows, out_columns, self.kernel, self.kernel, channels)
        ).reshape(5, -1)
        row = out_row * self.stride + kernel_row - top
        column = out_column * self.stride + kernel_column - left
        source = (row * columns + column) * channels + channel
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        order = np.flatnonzero(inside)
        order = order[np.argsort(source[order], kind="stable")]
        counts = np.bincount(source[order], minlength=math.prod(input_shape))
        return Synapses(
            np.concatenate([[0], np.cumsum(counts)]),
            (out_row * out_columns + out_column)[order],
            ((kernel_row * self.kernel + kernel_column) * channels + channel)[order],
        )

    def geometry(self):
        return {"stride": self.stride, "padding": self.padding}

    @classmethod
    def from_link(cls, link, output):
        return cls(link.shape[-1], link.kernel, link.stride, link.padding)

    @staticmethod
    def currents(link, weights, spikes):
        axes = ((3, 4, 5), (2, 0, 1))
        return np.tensordot(_sum_windows(link, spikes), weights, axes).reshape(
            *spikes.shape[:2], -1
        )

    @staticmethod
    def windows(link, values):
        seen = np.moveaxis(_sum_windows(link, values), 3, 5)  # channels last, as in the weights
        return seen.reshape(*seen.shape[:3], -1)

    @staticmethod
    def deployed_weights(link):
        return link.weights

    def __str__(self):
        stride = f"s{self.stride}" if self.stride > 1 else ""
        padding = {"valid": "", "same": "p"}.get(self.padding, f"p{self.padding}")
        return f"{self.filters}c{self.kernel}{stride}{padding}"


def _sum_windows(link, spikes):
    """Windows (frames, rows, columns, channels, kernel's rows, columns) of sums over squares."""
    frames = spikes.reshape(-1, *link.input_shape)
    if link.pool > 1:
        rows, columns = (n // link.pool for n in link.input_shape[:2])
        channels = link.input_shape[2]
        cut = frames[:, : rows * link.pool, : columns * link.pool]
        frames = cut.reshape(-1, rows, link.pool, columns, link.pool, channels).sum((2, 4))
    side = link.kernel
    pads = [windows(n, side, link.stride, link.padding)[1:] for n in frames.shape[1:3]]
    frames = np.pad(frames, ((0, 0), *pads, (0, 0)))
    seen = np.lib.stride_tricks.sliding_window_view(frames, (side, side), (1, 2))
    return seen[:, :: link.stride, :: link.stride]
