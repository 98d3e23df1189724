"""Convolutions; see :mod:`deploy.network.ops.conv` for deployed ones."""

import math
import re
from dataclasses import dataclass

import numpy as np

from deploy.network.ops.conv import DeployedConvolution
from models.ops.base import NUMBER, Operation, Synapses


@dataclass(frozen=True)
class Convolution(Operation, DeployedConvolution):
    """A convolution with square filters; its kernel has the shape of the deployed weights."""

    token = re.compile(f"{NUMBER}c{NUMBER}(?:s{NUMBER})?(p?)")
    noun = "a convolution"
    examples = ("6c4", "6c4s2", "6c4p")

    def __post_init__(self):
        if min(self.filters, self.kernel_size, self.stride) < 1:
            raise ValueError(f"{self}: filters, kernel and stride must be at least 1")
        if self.padding not in ("valid", "same") and not self.padding.isdecimal():
            raise ValueError(f"{self}: padding is neither 'valid' nor 'same' nor a number")

    @classmethod
    def from_token(cls, match):
        filters, kernel_size, stride = (int(n) for n in match.groups("1")[:3])
        return cls(filters, kernel_size, stride, "same" if match[4] else "valid")

    def count_fan_in(self, pooled_shape):
        return self.kernel_size**2 * pooled_shape[2]

    def make_keras_layer(self, name, gain=None):
        from models.keras.keras2 import tf

        if gain is not None:
            return super().make_keras_layer(name, gain)
        # NengoDL converts Keras's own layers.
        return tf.keras.layers.Conv2D(
            self.filters, self.kernel_size, self.stride, self.padding, name=name
        )

    def compute_tensor_sums(self, kernel, frames):
        from models.keras.keras2 import tf

        return tf.nn.conv2d(frames, kernel, self.stride, self.padding.upper())

    def make_synapses(self, pooled_shape):
        rows, columns, channels = pooled_shape
        (top, _), (left, _) = self.compute_padding(pooled_shape)
        out_rows, out_columns, _ = self.compute_shape(pooled_shape)
        out_row, out_column, kernel_row, kernel_column, channel = np.indices(
            (out_rows, out_columns, self.kernel_size, self.kernel_size, channels)
        ).reshape(5, -1)
        row = out_row * self.stride + kernel_row - top
        column = out_column * self.stride + kernel_column - left
        source = (row * columns + column) * channels + channel
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        order = np.flatnonzero(inside)
        order = order[np.argsort(source[order], kind="stable")]
        counts = np.bincount(source[order], minlength=math.prod(pooled_shape))
        return Synapses(
            np.concatenate([[0], np.cumsum(counts)]),
            (out_row * out_columns + out_column)[order],
            ((kernel_row * self.kernel_size + kernel_column) * channels + channel)[order],
            self.filters,
        )

    def gather_inputs(self, values):
        # Channels are the last axis, as in the weights.
        windows = np.moveaxis(self.view_windows(values), 3, 5)
        return windows.reshape(*windows.shape[:3], -1)

    def __str__(self):
        stride = f"s{self.stride}" if self.stride > 1 else ""
        padding = {"valid": "", "same": "p"}.get(self.padding, f"p{self.padding}")
        return f"{self.filters}c{self.kernel_size}{stride}{padding}"
