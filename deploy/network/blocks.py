"""Division of a layer into blocks, one block per core.

A layer that fits a core is one block.  A larger one is split along rows, columns and channels into
equal blocks (`nengo_loihi.BlockShape`); of all splits in which every block fits a core, the one
with the fewest input axons in total is chosen, and of those the one with the fewest blocks.  Axons
are the cost of a split: an input that two blocks read needs an axon into each.

The counts are computed here before NengoLoihi makes the blocks; pre-flight counts the blocks made
(:mod:`deploy.preflight.resources`) and refuses those that do not fit.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Dict, List, NamedTuple, Optional, Tuple

import numpy as np

from .chip import LOIHI
from .geometry import padded_kernel, windows

# Maximum number of synapses of one list.
LIST = 64

# Possible widths of the index of a synapse's target.
INDEX_BITS = (6, 7, 8, 9, 10, 11, 12)

# Output axons that one population spike takes (NengoLoihi's axons of 32 bits).
POPULATION_SLOTS = 2

# Maximum offset of the targets of a shared list; a larger one needs a separate list.
OFFSET = 256


def block_shapes(layers) -> Dict[str, Tuple[int, ...]]:
    """Block of each layer on the chip, by its name; an explicit ``block_shape`` has precedence.

    Parameters
    ----------
    layers : sequence of deploy.network.spec.Layer
        Layers of a network, in order.
    """
    shapes: dict = {}
    after: tuple = ()
    for layer in reversed(layers):
        if layer.placement == "chip":
            shapes[layer.name] = layer.block_shape or default_block(layer, *after)
            after = layer, shapes[layer.name]
    return shapes


def reads_populations(layer) -> bool:
    """True for a dense layer whose input spikes name a pixel and, as the axon's atom, a channel.

    A core has fewer input axons than such a layer has inputs.  An axon for each pixel with all its
    channels, as a convolution has them, is sufficient then; its synapses take more memory, since
    each has an index.

    Parameters
    ----------
    layer : deploy.network.spec.Layer
    """
    if (layer.kind, layer.placement) != ("dense", "chip") or len(layer.input_shape) != 3:
        return False
    limit = LOIHI.limits["input axons"]
    return math.prod(layer.input_shape) > limit >= math.prod(_pixels_read(layer))


def _pixels_read(layer):
    """(rows, columns) of the input inside of complete pooling windows."""
    return tuple(n * layer.pool for n in layer.read_shape[:2])


def scaled_by_block(layers) -> List[str]:
    """Names of the layers whose blocks have other integers than the layer as a whole.

    NengoLoihi scales the weights of each block so that the largest fills 8 bits
    (``discretize_weights``).  A layer that is divided by filters or units therefore has weights and
    thresholds that are rounded separately in each block.

    Parameters
    ----------
    layers : sequence of deploy.network.spec.Layer
        Layers of a network, in order.
    """
    shapes = block_shapes(layers)
    names = []
    for layer in layers:
        if layer.name not in shapes or layer.neurons is None:
            continue
        sizes = np.abs(layer.weights)
        outputs = -1 if layer.kind == "conv" else 0
        largest = np.moveaxis(sizes, outputs, 0).reshape(layer.shape[-1], -1).max(1)
        if layer.recurrent is not None:
            largest = np.maximum(largest, np.abs(layer.recurrent).max(1))
        parts = parts_of(layer.shape[-1], shapes[layer.name][-1])
        if any(largest[first:last].max() < largest.max() for first, last in parts):
            names.append(layer.name)
    return names


def default_block(layer, after=None, after_block=None) -> Tuple[int, ...]:
    """Choose the block of a layer; see the module's docstring.

    Parameters
    ----------
    layer : deploy.network.spec.Layer
    after : deploy.network.spec.Layer, optional
        The next layer on the chip, which receives its spikes.
    after_block : tuple of int, optional
        Its block.

    Returns
    -------
    tuple of int
        If nothing fits, the best block whose compartments fit a core.
    """
    return _default_block(layer, layer.recurrent is not None, after, after_block)


@functools.lru_cache(maxsize=256)
def _default_block(layer, recurrent, after, after_block):
    """As `default_block`; layers of the same shapes are equal, whether recurrent or not."""
    limit, cutting = LOIHI.limits["compartments"], _Cutting(layer)
    receiver = after and _Receiver(after, after_block)
    if layer.size <= limit and cutting.fits(layer.shape, receiver):
        return layer.shape
    ways = [list(_lengths(n)) for n in layer.shape]
    blocks = [block for block in itertools.product(*ways) if np.prod(block) <= limit]
    by_cost = sorted(blocks, key=lambda block: (cutting.axons(block), cutting.count(block), block))
    for block in by_cost:
        if cutting.fits(block, receiver):
            return block
    return by_cost[0]


def _lengths(n):
    """Lengths of equal parts along one dimension, from the whole down; the last may be shorter."""
    return sorted({-(-n // parts) for parts in range(1, n + 1)}, reverse=True)


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


class _Cutting:
    """Resources that a layer needs if it is split into blocks."""

    def __init__(self, layer):
        self.layer = layer
        self.is_conv = layer.kind == "conv"
        self.lines = _lines(layer) if self.is_conv else []
        self.has_populations = reads_populations(layer)
        self.n_inputs = int(np.prod(layer.input_shape))
        if self.has_populations:
            self.n_inputs = math.prod(_pixels_read(layer))
        self.n_own = 0 if layer.recurrent is None else layer.size

    def count(self, block) -> int:
        """Number of blocks."""
        return int(np.prod([-(-n // b) for n, b in zip(self.layer.shape, block)]))

    def axons(self, block) -> int:
        """Number of input axons of all blocks."""
        if not self.is_conv:
            return (self.n_inputs + self.n_own) * self.count(block)
        along = [
            sum(int(np.count_nonzero(line.reach(*part)[1])) for part in parts_of(n, b))
            for line, n, b in zip(self.lines, self.layer.shape, block)
        ]
        return int(np.prod(along)) * -(-self.layer.shape[2] // block[2])

    def fits(self, block, receiver) -> bool:
        """True if each block is within the limits of a core, compartments excepted."""
        limits = LOIHI.limits
        for parts in itertools.product(*(parts_of(n, b) for n, b in zip(self.layer.shape, block))):
            axons, words = self.needs(parts)
            if axons > limits["input axons"] or words > limits["synapse words"]:
                return False
            sent = 0 if receiver is None else receiver.axons_from(parts)
            if self.layer.recurrent is not None:
                sent += (parts[0][1] - parts[0][0]) * self.count(block)
            if sent > limits["output axons"]:
                return False
        return True

    def needs(self, parts):
        """Input axons and words of synapse memory of one block."""
        lengths = [last - first for first, last in parts]
        if not self.is_conv:
            own = self.n_own * _words(lengths[0], LOIHI.weight_bits)
            return self.n_inputs + self.n_own, own + self._words_of_inputs(lengths[0])
        columns, filters = lengths[1], lengths[2]
        reach = [line.reach(*part) for line, part in zip(self.lines, parts)]
        seen = [np.flatnonzero(number) for _, number, _ in reach]
        (low_r, n_r, at_r), (low_c, n_c, at_c) = (
            tuple(values[used] for values in one) for one, used in zip(reach, seen)
        )
        offset = ((low_r[:, None] - parts[0][0]) * columns + low_c - parts[1][0]) * filters
        # Inputs at the same offset in their windows share a list.
        keys = np.stack(
            np.broadcast_arrays(n_r[:, None], at_r[:, None], n_c, at_c, offset // OFFSET), axis=-1
        ).reshape(-1, 5)
        lists = np.unique(keys, axis=0)
        highest = OFFSET + ((lists[:, 0] - 1) * columns + lists[:, 2]) * filters
        highest = int(min(highest.max(initial=1), np.prod(lengths)))
        bits = LOIHI.weight_bits + _index_bits(highest)
        words = sum(_words(int(n), bits) for n in lists[:, 0] * lists[:, 2] * filters)
        return len(seen[0]) * len(seen[1]), words * self.layer.input_shape[2]

    def _words_of_inputs(self, units):
        """Words of synapse memory from the previous layer to some units of a dense layer."""
        if not self.has_populations:
            return self.n_inputs * _words(units, LOIHI.weight_bits)
        channels = self.layer.input_shape[2]
        # In a divided layer, the pixels of a pooling window share their lists.
        is_shared = units < self.layer.size
        lists = math.prod(self.layer.read_shape) if is_shared else self.n_inputs * channels
        return lists * _words(units, LOIHI.weight_bits + _index_bits(units))


def _index_bits(highest):
    """Width of the index of a synapse's target."""
    return next((bits for bits in INDEX_BITS if 2**bits >= highest), INDEX_BITS[-1])


def _words(synapses, bits):
    """Number of memory words for the lists of one input's synapses."""
    full, rest = divmod(synapses, LIST)
    return full * list_words(LIST, bits) + (list_words(rest, bits) if rest else 0)


def list_words(synapses: int, bits: int) -> int:
    """Number of words of synapse memory for one list, which starts with a new word.

    Parameters
    ----------
    synapses : int
    bits : int
        Bits of each synapse.
    """
    return -(-(synapses * bits + LOIHI.synapse_header_bits) // LOIHI.synapse_word_bits)


def parts_of(n: int, length: int) -> list:
    """(first, one past the last) of each part along one dimension."""
    return [(first, min(first + length, n)) for first in range(0, n, length)]


class _Receiver:
    """A layer on the chip with its blocks, as the target of the previous layer."""

    def __init__(self, layer, block):
        self.layer = layer
        self.blocks = int(np.prod([-(-n // b) for n, b in zip(layer.shape, block)]))
        self.seen: Optional[list] = None
        if layer.kind == "conv":
            self.seen = [
                [line.reach(*part)[1] > 0 for part in parts_of(n, b)]
                for line, n, b in zip(_lines(layer), layer.shape, block)
            ]
            self.copies = -(-layer.shape[2] // block[2])
        elif reads_populations(layer):
            sides = zip(layer.input_shape, _pixels_read(layer))
            self.seen = [[np.arange(n) < read] for n, read in sides]
            self.copies = self.blocks

    def axons_from(self, parts) -> int:
        """Number of output axons of a block of the previous layer."""
        if self.seen is None:
            return int(np.prod([last - first for first, last in parts])) * self.blocks
        along = [
            sum(int(seen[first:last].sum()) for seen in line)
            for line, (first, last) in zip(self.seen, parts)
        ]
        return along[0] * along[1] * self.copies * POPULATION_SLOTS
