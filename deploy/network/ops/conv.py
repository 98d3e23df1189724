"""A convolution with square filters over rows and columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, NamedTuple

import numpy as np

from ...arithmetic import ceil_div
from ..geometry import (
    convolution_fan_out,
    convolution_shape,
    inputs_within,
    padded_kernel_size,
    windows,
)
from .base import (
    POPULATION_SLOTS,
    DeployedOperation,
    Resources,
    index_bits,
    input_words,
    ranges_of,
)

# Maximum offset of the targets of a shared list; a larger one needs a separate list.
MAX_LIST_OFFSET = 256


@dataclass(frozen=True)
class DeployedConvolution(DeployedOperation):
    """A convolution with square filters over rows and columns.

    A layer's weights have the shape (kernel, kernel, channels in, filters).

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
    is_spatial = True

    @classmethod
    def of_layer(cls, layer):
        return cls(layer.shape[-1], layer.kernel, layer.stride, layer.padding)

    def layer_attributes(self):
        return {"kernel": self.kernel, "stride": self.stride, "padding": self.padding}

    def shape(self, read_shape):
        shape = convolution_shape(read_shape, self.kernel, self.filters, self.stride, self.padding)
        if min(shape) < 1:
            rows, columns = read_shape[:2]
            raise ValueError(f"does not fit: its kernel is larger than its {rows}x{columns} input")
        return shape

    def weight_shape(self, read_shape):
        return (self.kernel, self.kernel, read_shape[2], self.filters)

    def fan_out(self, read_shape):
        return convolution_fan_out(read_shape, self.kernel, self.filters, self.stride, self.padding)

    def by_output(self, layer):
        return np.moveaxis(layer.weights, -1, 0)

    def transform(self, layer, chip):
        """As `DeployedOperation.transform`.

        Average pooling over P x P values without overlap, followed by a convolution with a kernel
        of size K and a stride S, is one convolution with a kernel of size K P and a stride of S P.
        """
        import nengo

        from ..convolution import PaddedConvolution

        kernel = layer.weights
        input_shape = layer.input_shape
        inputs = None
        has_own_padding = layer.padding not in ("valid", "same")
        if has_own_padding:
            sizes = [
                padded_kernel_size(n, layer.kernel, layer.stride, layer.padding)
                for n in layer.read_shape[:2]
            ]
            edges = [(0, size - layer.kernel) for size in sizes]
            kernel = np.pad(kernel, (*edges, (0, 0), (0, 0)))
        if layer.pool > 1:
            kernel, input_shape = _fold_pooling(layer, kernel)
            inputs = inputs_within(layer.input_shape, input_shape)
        shapes = {
            "n_filters": layer.shape[-1],
            "input_shape": input_shape,
            "kernel_size": kernel.shape[:2],
            "strides": (layer.stride * layer.pool,) * 2,
        }
        if has_own_padding:
            zeros = int(layer.padding) * layer.pool
            return PaddedConvolution(zeros, init=kernel, **shapes), inputs
        return nengo.Convolution(padding=layer.padding, init=kernel, **shapes), inputs

    def resources(self, layer, chip):
        return _ConvolutionResources(layer, chip)

    def nir_nodes(self, layer, nir, area):
        weights, padding = _pad_evenly(layer)
        yield (
            f"{layer.name}_weights",
            nir.Conv2d(
                input_shape=layer.read_shape[:2],
                weight=weights.transpose(3, 2, 0, 1) * area,  # filter, channel, row, column
                stride=layer.stride,
                padding=padding,
                dilation=1,
                groups=1,
                bias=layer.bias.copy(),
            ),
        )

    def describe(self, layer):
        return f"{layer.kernel}x{layer.kernel} convolution, stride {layer.stride}"


def _fold_pooling(layer, kernel):
    """A kernel that includes average pooling, and the shape of its input.

    With padding it may need zeros: Nengo puts half of the padding, rounded down, before the values,
    whereas half of the padding of pooled values is a whole number of windows.
    """
    pool = layer.pool
    stride = layer.stride * layer.pool
    kernel = kernel.repeat(pool, axis=0).repeat(pool, axis=1) / pool**2
    if layer.padding == "valid":
        return kernel, layer.input_shape
    cut = tuple(n * pool for n in layer.read_shape[:2])
    if layer.padding != "same":
        return kernel, (*cut, layer.input_shape[2])
    zeros_before = [
        pool * windows(n, layer.kernel, layer.stride, "same")[1] for n in layer.read_shape[:2]
    ]
    for zeros in (0, pool):
        size = len(kernel) + zeros
        front = [windows(n, size, stride, "same")[1] - pad for n, pad in zip(cut, zeros_before)]
        if all(0 <= n <= zeros for n in front):
            break
    pads = [(n, zeros - n) for n in front]
    return np.pad(kernel, (*pads, (0, 0), (0, 0))), (*cut, layer.input_shape[2])


def _pad_evenly(layer):
    """Kernel and padding for readers that pad equally before and after.

    If one more zero is needed after the values than before, the kernel gets a zero in front.
    """
    if layer.padding != "same":
        return layer.weights, 0 if layer.padding == "valid" else int(layer.padding)
    pads = [windows(n, layer.kernel, layer.stride, "same")[1:] for n in layer.read_shape[:2]]
    front = [(after - before, 0) for before, after in pads]
    return np.pad(layer.weights, (*front, (0, 0), (0, 0))), tuple(after for _, after in pads)


class _Reach(NamedTuple):
    """The windows of a block that contain each input position along one dimension.

    Attributes
    ----------
    lowest, number, offset : ndarray of int, shape (positions,)
        First of those windows, their number, and the position's offset in the first one.
    """

    lowest: np.ndarray
    number: np.ndarray
    offset: np.ndarray

    @property
    def is_read(self):
        """True for positions that are in a window."""
        return self.number > 0

    def of_read_positions(self) -> _Reach:
        """The same without positions that are in no window."""
        return _Reach(*(values[self.is_read] for values in self))


class _Line(NamedTuple):
    """A layer's windows along one dimension of its input, including pooling before it."""

    n: int
    kernel: int
    stride: int
    before: int

    def reach(self, first, last) -> _Reach:
        """For each input position the windows among ``first`` to ``last - 1`` that contain it."""
        at = np.arange(self.n) + self.before
        lowest = np.maximum(ceil_div(at - self.kernel + 1, self.stride), first)
        highest = np.minimum(at // self.stride, last - 1)
        number = np.maximum(highest - lowest + 1, 0)
        return _Reach(lowest, number, at - lowest * self.stride)


def _make_lines(layer) -> List[_Line]:
    lines = []
    pool = layer.pool
    for n, read in zip(layer.input_shape[:2], layer.read_shape[:2]):
        _, before, _ = windows(read, layer.kernel, layer.stride, layer.padding)
        kernel = layer.kernel
        if layer.padding not in ("valid", "same"):  # the network is built with zeros at the end
            kernel = padded_kernel_size(read, kernel, layer.stride, layer.padding)
        # With padding a window would reach values outside of complete pooling windows.
        length = n if layer.padding == "valid" else read * pool
        lines.append(_Line(length, kernel * pool, layer.stride * pool, before * pool))
    return lines


class _ConvolutionResources(Resources):
    """An axon for each pixel, with the channels as its atoms."""

    def __init__(self, layer, chip):
        super().__init__(layer, chip)
        self.lines = _make_lines(layer)

    def input_axons(self, block):
        pixels = 1
        for line, n, length in zip(self.lines, self.layer.shape, block):
            blocks = ranges_of(n, length)
            pixels *= sum(int(line.reach(*ends).is_read.sum()) for ends in blocks)
        return pixels * self._channel_blocks(block)

    def needs(self, ranges):
        """As `Resources.needs`.

        Inputs at the same offset in their windows have the same synapses and share their lists,
        unless the targets of one are too far from those of the other.
        """
        row_range, column_range, _ = ranges
        rows, columns, filters = (last - first for first, last in ranges)
        down = self.lines[0].reach(*row_range).of_read_positions()
        across = self.lines[1].reach(*column_range).of_read_positions()
        first_row = down.lowest[:, None] - row_range[0]
        first_target = (first_row * columns + across.lowest - column_range[0]) * filters
        keys = np.broadcast_arrays(
            down.number[:, None],
            down.offset[:, None],
            across.number,
            across.offset,
            first_target // MAX_LIST_OFFSET,
        )
        lists = np.unique(np.stack(keys, axis=-1).reshape(-1, len(keys)), axis=0)
        n_down = lists[:, 0]
        n_across = lists[:, 2]
        last_target = MAX_LIST_OFFSET + ((n_down - 1) * columns + n_across) * filters
        highest = int(min(last_target.max(initial=1), rows * columns * filters))
        bits = self.chip.weight_bits + index_bits(highest)
        synapses = n_down * n_across * filters
        words = sum(input_words(int(n), bits, self.chip) for n in synapses)
        pixels = len(down.number) * len(across.number)
        return pixels, words * self.layer.input_shape[2]

    def receiver(self, block):
        row_blocks, column_blocks = (
            self._is_read_by(line, n, length)
            for line, n, length in zip(self.lines, self.layer.shape, block)
        )
        slots = self._channel_blocks(block) * POPULATION_SLOTS

        def output_axons(ranges):
            (first_row, last_row), (first_column, last_column), *_ = ranges
            rows = row_blocks[:, first_row:last_row].sum()
            columns = column_blocks[:, first_column:last_column].sum()
            return int(rows * columns) * slots

        return output_axons

    @staticmethod
    def _is_read_by(line, n, length):
        """Whether each block along a dimension reads each input, bool, shape (blocks, inputs)."""
        return np.stack([line.reach(*ends).is_read for ends in ranges_of(n, length)])

    def _channel_blocks(self, block):
        """Number of blocks along the channels."""
        return ceil_div(self.layer.shape[2], block[2])
