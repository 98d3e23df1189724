"""The base class of operations, and the memory of synapses that all operations use."""

from __future__ import annotations

import math
from typing import Tuple

from ..chip import Chip

# Maximum number of synapses of one list.
SYNAPSES_OF_LIST = 64

# Possible widths of the index of a synapse's target.
INDEX_BITS = (6, 7, 8, 9, 10, 11, 12)

# Output axons that one population spike takes (NengoLoihi's axons of 32 bits).
POPULATION_SLOTS = 2


class Operation:
    """A linear map from a layer's input, after averaging, to its neurons.

    A layer is a :class:`deploy.network.spec.Layer`.  A subclass has all methods.

    Attributes
    ----------
    kind : str
        ``Layer.kind`` of the layers with this operation.
    is_spatial : bool
        True if the input must have rows, columns and channels.
    can_read_out : bool
        True if it can be the last layer, and a readout on the host with several sections.
    can_recur : bool
        True if its neurons can have weights from each other.
    """

    kind: str
    is_spatial = False
    can_read_out = False
    can_recur = False

    def shapes(self, layer) -> tuple:
        """Shapes of the output and of the weights, by the layer's other attributes.

        Values below 1 mean that the operation is larger than its input.
        """
        raise NotImplementedError

    def fan_out(self, layer):
        """Number of synapses of each value that the weights read, of shape `layer.read_shape`."""
        raise NotImplementedError

    def by_output(self, layer):
        """The weights with a row for each channel or unit of the output, shape (outputs, ...)."""
        raise NotImplementedError

    def transform(self, layer, chip: Chip) -> tuple:
        """The transform in Nengo with averaging folded in, and the inputs that it reads.

        Returns
        -------
        nengo.transforms.Transform
        inputs : list of int or None
            None for all of them.
        """
        raise NotImplementedError

    def resources(self, layer, chip: Chip) -> Resources:
        """Counts of what the layer needs of cores."""
        raise NotImplementedError

    def nir_nodes(self, layer, nir, area: float):
        """Names and nodes of the export to NIR, without the averaging and the neurons.

        Parameters
        ----------
        layer : Layer
        nir : module
        area : float
            Size of an input spike.
        """
        raise NotImplementedError

    def describe(self, layer) -> str:
        """A short text for tables."""
        raise NotImplementedError


class Resources:
    """Counts of axons and synapse memory of a layer that is divided into blocks of one shape.

    Recurrent weights are not included.

    Parameters
    ----------
    layer : deploy.network.spec.Layer
    chip : Chip
    """

    def __init__(self, layer, chip: Chip):
        self.layer = layer
        self.chip = chip

    def input_axons(self, block) -> int:
        """Number of input axons of all blocks."""
        raise NotImplementedError

    def needs(self, ranges) -> Tuple[int, int]:
        """Input axons and words of synapse memory of the block with these ranges of outputs."""
        raise NotImplementedError

    def receiver(self, block):
        """A function for the previous layer: output axons of its block with these ranges."""
        raise NotImplementedError


def n_blocks(shape, block) -> int:
    """Number of blocks of a layer."""
    return math.prod(-(-n // length) for n, length in zip(shape, block))


def ranges_of(n: int, length: int) -> list:
    """(first, one past the last) of each block along one dimension."""
    return [(first, min(first + length, n)) for first in range(0, n, length)]


def index_bits(highest: int) -> int:
    """Width of the index of a synapse's target."""
    return next((bits for bits in INDEX_BITS if 2**bits >= highest), INDEX_BITS[-1])


def input_words(synapses: int, bits: int, chip: Chip) -> int:
    """Number of words of synapse memory for the lists of one input's synapses."""
    full, rest = divmod(synapses, SYNAPSES_OF_LIST)
    words = full * list_words(SYNAPSES_OF_LIST, bits, chip)
    return words + (list_words(rest, bits, chip) if rest else 0)


def list_words(synapses: int, bits: int, chip: Chip) -> int:
    """Number of words of synapse memory for one list, which starts with a new word.

    Parameters
    ----------
    synapses : int
    bits : int
        Bits of each synapse.
    chip : Chip
    """
    return -(-(synapses * bits + chip.synapse_header_bits) // chip.synapse_word_bits)
