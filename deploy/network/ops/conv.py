"""A convolution with square filters over rows and columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, NamedTuple

import numpy as np

from ...arithmetic import divide_up
from ...loading import AT_LEAST_1, Limit, limited_field, load_dataclass
from ..geometry import (
    compute_convolution_shape,
    compute_padded_kernel_size,
    count_convolution_fan_out,
    list_inputs_within,
    list_windows,
)
from .base import (
    POPULATION_SLOTS,
    DeployedOperation,
    Resources,
    count_axon_words,
    find_index_bits,
    list_ranges,
)

PADDING = Limit(
    lambda value: value in ("valid", "same") or (value.isdecimal() and 1 <= int(value) <= 1000),
    "'valid', 'same' or a number from 1 to 1000",
)

# Maximum offset of the targets of a shared list; a larger one needs a separate list.
MAX_LIST_OFFSET = 256


@dataclass(frozen=True)
class DeployedConvolution(DeployedOperation):
    """A convolution with square filters over rows and columns.

    A layer's weights have the shape (kernel_size, kernel_size, channels in, filters).

    Attributes
    ----------
    filters, kernel_size : int
        Number of filters and side length of each.
    stride : int
    padding : str
        ``"valid"`` or ``"same"``, as in TensorFlow; of an imported network also a number of zeros
        on each side, such as ``"1"``: see :func:`deploy.network.geometry.list_windows`.
    """

    filters: int = limited_field(AT_LEAST_1)
    kernel_size: int = limited_field(AT_LEAST_1, name_in_file="kernel")
    stride: int = limited_field(AT_LEAST_1, 1)
    padding: str = limited_field(PADDING, "valid")
    kind = "conv"
    is_spatial = True

    def to_file(self):
        return {"kernel": self.kernel_size, "stride": self.stride, "padding": self.padding}

    @classmethod
    def from_file(cls, numbers, shape):
        return load_dataclass(cls, {**numbers, "filters": shape[-1]})

    def compute_shape(self, pooled_shape):
        shape = compute_convolution_shape(
            pooled_shape, self.kernel_size, self.filters, self.stride, self.padding
        )
        if min(shape) < 1:
            rows, columns = pooled_shape[:2]
            raise ValueError(f"does not fit: its kernel is larger than its {rows}x{columns} input")
        return shape

    def compute_weight_shape(self, pooled_shape):
        return (self.kernel_size, self.kernel_size, pooled_shape[2], self.filters)

    def compute_sums(self, weights, values):
        axes = ((3, 4, 5), (2, 0, 1))
        return np.tensordot(self.view_windows(values), weights, axes)

    def view_windows(self, values) -> np.ndarray:
        """The values that each window reads, including the zeros of the padding.

        Parameters
        ----------
        values : ndarray, shape (n, rows, columns, channels)

        Returns
        -------
        ndarray, shape (n, windows down, windows across, channels, kernel rows, kernel columns)
        """
        pads = self.compute_padding(values.shape[1:])
        padded = np.pad(values, ((0, 0), *pads, (0, 0)))
        down, across, _ = self.compute_shape(values.shape[1:])
        # The function sliding_window_view is newer than the NumPy of hosts with a board.
        n, row, column, channel = padded.strides
        return np.lib.stride_tricks.as_strided(
            padded,
            shape=(len(padded), down, across, padded.shape[3], self.kernel_size, self.kernel_size),
            strides=(n, row * self.stride, column * self.stride, channel, row, column),
            writeable=False,
        )

    def compute_padding(self, pooled_shape) -> tuple:
        """Numbers of zeros padded to rows and columns: ((before, after), (before, after))."""
        return tuple(
            list_windows(n, self.kernel_size, self.stride, self.padding)[1:]
            for n in pooled_shape[:2]
        )

    def count_fan_out(self, pooled_shape):
        return count_convolution_fan_out(
            pooled_shape, self.kernel_size, self.filters, self.stride, self.padding
        )

    def find_largest_weights(self, weights, pooled_shape):
        return np.abs(weights).max((0, 1, 2))

    def make_transform(self, layer, chip):
        """As `DeployedOperation.make_transform`.

        Average pooling over P x P values without overlap, followed by a convolution with a kernel
        of size K and a stride S, is one convolution with a kernel of size K P and a stride of S P.
        """
        import nengo

        from ..convolution import PaddedConvolution

        kernel = layer.weights
        input_shape = layer.input_shape
        inputs = None
        has_numbered_padding = self.padding not in ("valid", "same")
        if has_numbered_padding:
            sizes = [
                compute_padded_kernel_size(n, self.kernel_size, self.stride, self.padding)
                for n in layer.pooled_shape[:2]
            ]
            edges = [(0, size - self.kernel_size) for size in sizes]
            kernel = np.pad(kernel, (*edges, (0, 0), (0, 0)))
        if layer.pool > 1:
            kernel, input_shape = _fold_pooling(layer, kernel)
            inputs = list_inputs_within(layer.input_shape, input_shape)
        shapes = {
            "n_filters": layer.shape[-1],
            "input_shape": input_shape,
            "kernel_size": kernel.shape[:2],
            "strides": (self.stride * layer.pool,) * 2,
        }
        if has_numbered_padding:
            zeros = int(self.padding) * layer.pool
            return PaddedConvolution(zeros, init=kernel, **shapes), inputs
        return nengo.Convolution(padding=self.padding, init=kernel, **shapes), inputs

    def make_resources(self, layer, chip):
        return _ConvolutionResources(layer, chip)

    def make_nir_nodes(self, layer, nir, area):
        weights, padding = _pad_evenly(layer)
        yield (
            f"{layer.name}_weights",
            nir.Conv2d(
                input_shape=layer.pooled_shape[:2],
                weight=weights.transpose(3, 2, 0, 1) * area,  # filter, channel, row, column
                stride=self.stride,
                padding=padding,
                dilation=1,
                groups=1,
                bias=layer.bias.copy(),
            ),
        )

    def describe(self, layer):
        return f"{self.kernel_size}x{self.kernel_size} convolution, stride {self.stride}"


def _fold_pooling(layer, kernel):
    """A kernel that includes average pooling, and the shape of its input.

    With padding it may need zeros: Nengo puts half of the padding, rounded down, before the values,
    whereas half of the padding of pooled values is a whole number of windows.
    """
    operation = layer.operation
    pool = layer.pool
    stride = operation.stride * pool
    kernel = kernel.repeat(pool, axis=0).repeat(pool, axis=1) / pool**2
    if operation.padding == "valid":
        return kernel, layer.input_shape
    cut = tuple(n * pool for n in layer.pooled_shape[:2])
    if operation.padding != "same":
        return kernel, (*cut, layer.input_shape[2])
    zeros_before = [pool * before for before, _ in operation.compute_padding(layer.pooled_shape)]
    for zeros in (0, pool):
        size = len(kernel) + zeros
        front = [
            list_windows(n, size, stride, "same")[1] - pad for n, pad in zip(cut, zeros_before)
        ]
        if all(0 <= n <= zeros for n in front):
            break
    pads = [(n, zeros - n) for n in front]
    return np.pad(kernel, (*pads, (0, 0), (0, 0))), (*cut, layer.input_shape[2])


def _pad_evenly(layer):
    """Kernel and padding for readers that pad equally before and after.

    If one more zero is needed after the values than before, the kernel gets a zero in front.
    """
    padding = layer.operation.padding
    if padding != "same":
        return layer.weights, 0 if padding == "valid" else int(padding)
    pads = layer.operation.compute_padding(layer.pooled_shape)
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

    def select_read_positions(self) -> _Reach:
        """The same without positions that are in no window."""
        return _Reach(*(values[self.is_read] for values in self))


class _Line(NamedTuple):
    """A layer's windows along one dimension of its input, including pooling before it.

    Attributes
    ----------
    n : int
        Number of inputs.
    kernel_size, stride : int
        Length of a window, and distance from one to the next.
    before : int
        Zeros before the first input.
    """

    n: int
    kernel_size: int
    stride: int
    before: int

    def find_reach(self, first, last) -> _Reach:
        """For each input position the windows among ``first`` to ``last - 1`` that contain it."""
        at = np.arange(self.n) + self.before
        lowest = np.maximum(divide_up(at - self.kernel_size + 1, self.stride), first)
        highest = np.minimum(at // self.stride, last - 1)
        number = np.maximum(highest - lowest + 1, 0)
        return _Reach(lowest, number, at - lowest * self.stride)


def _make_lines(layer) -> List[_Line]:
    operation = layer.operation
    stride = operation.stride
    padding = operation.padding
    pool = layer.pool
    lines = []
    for n, n_pooled in zip(layer.input_shape[:2], layer.pooled_shape[:2]):
        kernel_size = operation.kernel_size
        _, before, _ = list_windows(n_pooled, kernel_size, stride, padding)
        if padding not in ("valid", "same"):  # the network is built with zeros at the end
            kernel_size = compute_padded_kernel_size(n_pooled, kernel_size, stride, padding)
        # With padding a window would reach values outside of complete pooling windows.
        length = n if padding == "valid" else n_pooled * pool
        lines.append(_Line(length, kernel_size * pool, stride * pool, before * pool))
    return lines


class _ConvolutionResources(Resources):
    """An axon for each pixel, with the channels as its atoms."""

    def __init__(self, layer, chip):
        super().__init__(layer, chip)
        self.lines = _make_lines(layer)

    def count_input_axons(self, block):
        pixels = 1
        for line, n, length in zip(self.lines, self.layer.shape, block):
            blocks = list_ranges(n, length)
            pixels *= sum(int(line.find_reach(*ends).is_read.sum()) for ends in blocks)
        return pixels * self._count_channel_blocks(block)

    def count_needs(self, ranges):
        """As `Resources.count_needs`.

        Inputs at the same offset in their windows have the same synapses and share their lists,
        unless the targets of one are too far from those of the other.
        """
        row_range, column_range, _ = ranges
        rows, columns, filters = (last - first for first, last in ranges)
        down = self.lines[0].find_reach(*row_range).select_read_positions()
        across = self.lines[1].find_reach(*column_range).select_read_positions()
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
        bits = self.chip.weight_bits + find_index_bits(highest)
        synapses = n_down * n_across * filters
        channels = self.layer.input_shape[2]
        words = sum(count_axon_words(channels, int(n), bits, self.chip) for n in synapses)
        pixels = len(down.number) * len(across.number)
        return pixels, words

    def make_output_axon_counter(self, block):
        row_blocks, column_blocks = (
            self._is_read_by(line, n, length)
            for line, n, length in zip(self.lines, self.layer.shape, block)
        )
        slots = self._count_channel_blocks(block) * POPULATION_SLOTS

        def count_output_axons(ranges):
            (first_row, last_row), (first_column, last_column), *_ = ranges
            rows = row_blocks[:, first_row:last_row].sum()
            columns = column_blocks[:, first_column:last_column].sum()
            return int(rows * columns) * slots

        return count_output_axons

    @staticmethod
    def _is_read_by(line, n, length):
        """Whether each block along a dimension reads each input, bool, shape (blocks, inputs)."""
        return np.stack([line.find_reach(*ends).is_read for ends in list_ranges(n, length)])

    def _count_channel_blocks(self, block):
        """Number of blocks along the channels."""
        return divide_up(self.layer.shape[2], block[2])
