"""A convolution with square filters over rows and columns."""

from __future__ import annotations

import math
from typing import List, NamedTuple

import numpy as np

from ..geometry import (
    convolution_fan_out,
    convolution_shape,
    inputs_within,
    padded_kernel,
    windows,
)
from .base import (
    POPULATION_SLOTS,
    Operation,
    Resources,
    index_bits,
    input_words,
    ranges_of,
)

# Maximum offset of the targets of a shared list; a larger one needs a separate list.
MAX_LIST_OFFSET = 256


class Convolution(Operation):
    """A convolution; its weights have the shape (kernel, kernel, channels in, filters)."""

    kind = "conv"
    is_spatial = True

    def shapes(self, layer):
        read = layer.read_shape
        filters = layer.shape[-1]
        shape = convolution_shape(read, layer.kernel, filters, layer.stride, layer.padding)
        return shape, (layer.kernel, layer.kernel, read[2], filters)

    def fan_out(self, layer):
        return convolution_fan_out(
            layer.read_shape, layer.kernel, layer.shape[-1], layer.stride, layer.padding
        )

    def by_output(self, layer):
        return np.moveaxis(layer.weights, -1, 0)

    def transform(self, layer, chip):
        """As `Operation.transform`.

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
                padded_kernel(n, layer.kernel, layer.stride, layer.padding)
                for n in layer.read_shape[:2]
            ]
            edges = [(0, size - layer.kernel) for size in sizes]
            kernel = np.pad(kernel, (*edges, (0, 0), (0, 0)))
        if layer.pool > 1:
            kernel, input_shape = _pooled_kernel(layer, kernel)
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


CONVOLUTION = Convolution()


def _pooled_kernel(layer, kernel):
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
    wanted = [
        pool * windows(n, layer.kernel, layer.stride, "same")[1] for n in layer.read_shape[:2]
    ]
    for zeros in (0, pool):
        size = len(kernel) + zeros
        front = [windows(n, size, stride, "same")[1] - pad for n, pad in zip(cut, wanted)]
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


class _Line(NamedTuple):
    """A layer's windows along one dimension of its input, including pooling before it."""

    n: int
    kernel: int
    stride: int
    before: int

    def reach(self, first, last):
        """For each input position the windows among ``first`` to ``last - 1`` that contain it.

        Returns
        -------
        lowest, number, offset : ndarray of int, shape (n,)
            First of those windows, their number, and the position's offset in the first one.
        """
        at = np.arange(self.n) + self.before
        lowest = np.maximum(-(-(at - self.kernel + 1) // self.stride), first)
        highest = np.minimum(at // self.stride, last - 1)
        number = np.maximum(highest - lowest + 1, 0)
        return lowest, number, at - lowest * self.stride


def _lines(layer) -> List[_Line]:
    lines = []
    pool = layer.pool
    for n, read in zip(layer.input_shape[:2], layer.read_shape[:2]):
        _, before, _ = windows(read, layer.kernel, layer.stride, layer.padding)
        kernel = layer.kernel
        if layer.padding not in ("valid", "same"):  # the network is built with zeros at the end
            kernel = padded_kernel(read, kernel, layer.stride, layer.padding)
        # With padding a window would reach values outside of complete pooling windows.
        length = n if layer.padding == "valid" else read * pool
        lines.append(_Line(length, kernel * pool, layer.stride * pool, before * pool))
    return lines


class _ConvolutionResources(Resources):
    """An axon for each pixel, with the channels as its atoms."""

    def __init__(self, layer, chip):
        super().__init__(layer, chip)
        self.lines = _lines(layer)

    def input_axons(self, block):
        along = [
            sum(int(np.count_nonzero(line.reach(*ends)[1])) for ends in ranges_of(n, length))
            for line, n, length in zip(self.lines, self.layer.shape, block)
        ]
        return math.prod(along) * -(-self.layer.shape[2] // block[2])

    def needs(self, ranges):
        lengths = [last - first for first, last in ranges]
        _, columns, filters = lengths
        reach = [line.reach(*ends) for line, ends in zip(self.lines, ranges)]
        seen = [np.flatnonzero(number) for _, number, _ in reach]
        (low_r, n_r, at_r), (low_c, n_c, at_c) = (
            tuple(values[used] for values in one) for one, used in zip(reach, seen)
        )
        offset = ((low_r[:, None] - ranges[0][0]) * columns + low_c - ranges[1][0]) * filters
        # Inputs at the same offset in their windows share a list.
        keys = np.stack(
            np.broadcast_arrays(n_r[:, None], at_r[:, None], n_c, at_c, offset // MAX_LIST_OFFSET),
            axis=-1,
        ).reshape(-1, 5)
        lists = np.unique(keys, axis=0)
        highest = MAX_LIST_OFFSET + ((lists[:, 0] - 1) * columns + lists[:, 2]) * filters
        highest = int(min(highest.max(initial=1), np.prod(lengths)))
        bits = self.chip.weight_bits + index_bits(highest)
        synapses = lists[:, 0] * lists[:, 2] * filters
        words = sum(input_words(int(n), bits, self.chip) for n in synapses)
        return len(seen[0]) * len(seen[1]), words * self.layer.input_shape[2]

    def receiver(self, block):
        seen = [
            [line.reach(*ends)[1] > 0 for ends in ranges_of(n, length)]
            for line, n, length in zip(self.lines, self.layer.shape, block)
        ]
        copies = -(-self.layer.shape[2] // block[2])

        def output_axons(ranges):
            along = [
                sum(int(reached[first:last].sum()) for reached in line)
                for line, (first, last) in zip(seen, ranges)
            ]
            return along[0] * along[1] * copies * POPULATION_SLOTS

        return output_axons
