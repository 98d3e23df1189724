"""The base class of operations, and the memory of synapses that all operations use."""

from __future__ import annotations

import math
from typing import Tuple

import numpy as np

from ...arithmetic import ceil_div
from ...errors import UserError
from ..chip import Chip
from ..geometry import pooled_shape, unpool

# Maximum number of synapses of one list.
SYNAPSES_OF_LIST = 64

# Possible widths of the index of a synapse's target.
INDEX_BITS = (6, 7, 8, 9, 10, 11, 12)

# Output axons that one population spike takes (NengoLoihi's axons of 32 bits).
POPULATION_SLOTS = 2


class DeployedOperation:
    """A linear map from a layer's input, after averaging, to its neurons.

    A subclass is a frozen dataclass whose fields are the operation's numbers, such as the number of
    filters.  Its methods are:

    ==============================  ================================================================
    `kind`, `shape`,                always
    `weight_shape`, `fan_out`,
    `transform`
    `of_layer`, `layer_attributes`  if it has fields
    `by_output`                     if the first axis of the weights is not that of the outputs
    `resources`                     if not every input has a synapse to every neuron (without it the
                                    axons and the memory are counted too high)
    `nir_nodes`                     for the export to NIR, which is refused without it
    ==============================  ================================================================

    ``layer`` is a :class:`deploy.network.spec.Layer`, and ``read_shape`` the shape of its input
    after averaging: (rows, columns, channels) or (values,).

    Attributes
    ----------
    kind : str
        The key in `DEPLOYED_OPERATIONS`, which is ``Layer.kind`` of the layers with this operation.
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

    @classmethod
    def of_layer(cls, layer) -> DeployedOperation:
        """The operation of a layer, by its attributes other than the weights.

        Raises
        ------
        ValueError
            A number is out of range.
        """
        return cls()

    def layer_attributes(self) -> dict:
        """Attributes of a layer from which `of_layer` makes this operation, but for the shapes."""
        return {"kernel": 0}

    def shape(self, read_shape) -> Tuple[int, ...]:
        """Shape of the output.

        Raises
        ------
        ValueError
            The operation is larger than its input.
        """
        raise NotImplementedError

    def weight_shape(self, read_shape) -> Tuple[int, ...]:
        """Shape of the weights; of a readout in sections, that of one section."""
        raise NotImplementedError

    def fan_out(self, read_shape) -> np.ndarray:
        """Number of synapses of each value of the input, int64, of shape ``read_shape``."""
        raise NotImplementedError

    def input_fan_out(self, input_shape, pool: int = 1) -> np.ndarray:
        """Number of synapses of each value before averaging, of shape ``input_shape``.

        Values outside of complete windows have none.
        """
        if pool == 1:
            return self.fan_out(input_shape)
        return unpool(self.fan_out(pooled_shape(input_shape, pool)), input_shape, pool)

    def transform(self, layer, chip: Chip) -> tuple:
        """The transform in Nengo with averaging folded in, and the inputs that it reads.

        Returns
        -------
        nengo.transforms.Transform
        inputs : list of int or None
            None for all of them.
        """
        raise NotImplementedError

    def by_output(self, layer) -> np.ndarray:
        """The weights with a row for each channel or unit of the output, shape (outputs, ...)."""
        return layer.weights

    def resources(self, layer, chip: Chip) -> Resources:
        """Counts of what the layer needs of cores."""
        return DiscreteResources(layer, chip)

    def nir_nodes(self, layer, nir, area: float):
        """Names and nodes of the export to NIR, without the averaging and the neurons.

        Parameters
        ----------
        layer : Layer
        nir : module
        area : float
            Size of an input spike.

        Raises
        ------
        UserError
            The operation has no node in NIR.
        """
        raise UserError(f"layer {layer.name!r}: NIR has no node for its operation, {self.kind!r}")

    def describe(self, layer) -> str:
        """A short text for tables."""
        return self.kind


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


class DiscreteResources(Resources):
    """An axon for each input into each block, with a synapse to every neuron of the block."""

    def input_axons(self, block):
        return math.prod(self.layer.input_shape) * n_blocks(self.layer.shape, block)

    def needs(self, ranges):
        inputs = math.prod(self.layer.input_shape)
        return inputs, inputs * input_words(n_neurons(ranges), self.chip.weight_bits, self.chip)

    def receiver(self, block):
        blocks = n_blocks(self.layer.shape, block)
        return lambda ranges: n_neurons(ranges) * blocks


def n_blocks(shape, block) -> int:
    """Number of blocks of a layer."""
    return math.prod(ceil_div(n, length) for n, length in zip(shape, block))


def n_neurons(ranges) -> int:
    """Number of neurons of a block with these ranges, (first, one past the last), of outputs."""
    return math.prod(last - first for first, last in ranges)


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
    return ceil_div(synapses * bits + chip.synapse_header_bits, chip.synapse_word_bits)
