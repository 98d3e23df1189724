"""The base class of operations, and the memory of synapses that all operations use."""

from __future__ import annotations

import functools
import math
from dataclasses import asdict, dataclass
from typing import ClassVar, Tuple

import numpy as np

from ...arithmetic import divide_up
from ...errors import UserError
from ...loading import load_dataclass
from ..chip import Chip
from ..geometry import compute_pooled_shape, unpool

# Maximum number of synapses of one list.
SYNAPSES_OF_LIST = 64

# Possible widths of the index of a synapse's target.
INDEX_BITS = (6, 7, 8, 9, 10, 11, 12)

# Output axons that one population spike takes (NengoLoihi's axons of 32 bits).
POPULATION_SLOTS = 2


@dataclass(frozen=True)
class DeployedOperation:
    """A linear map from a layer's input, after average pooling, to its neurons.

    A subclass with numbers, such as the number of filters, is a frozen dataclass with one field for
    each number.  A field must not have the name of a layer's own value in a bundle
    (`deploy.network.layer.LAYER_NAMES`).

    A subclass must have `kind`, `compute_shape`, `compute_weight_shape` and `compute_sums`.  The
    sums are its meaning, and everything else follows from them.  A subclass overrides the other
    methods where their defaults are not good enough:

    ===========================  ===================================================================
    `to_file`, `from_file`       if a number is already in the layer's shape, or has another name in
                                 a bundle
    `count_fan_out`,             if the sums of as many samples as there are inputs need much memory
    `make_matrix`,
    `find_largest_weights`
    `make_transform`,            if the chip needs no synapse from every input to every neuron
    `make_resources`
    `make_nir_nodes`             for the export to NIR, which is refused without it
    ===========================  ===================================================================

    ``pooled_shape`` is the shape of the layer's input after average pooling, which is what the
    operation reads: (rows, columns, channels) or (values,).  ``layer`` is a
    :class:`deploy.network.layer.Layer`.  No method but `make_transform` knows of Nengo.

    Attributes
    ----------
    kind : str
        The key in `DEPLOYED_OPERATIONS`, and ``kind`` of the layers in a bundle.
    is_spatial : bool
        True if the input must have rows, columns and channels.
    can_read_out : bool
        True if it can be the last layer, and a readout on the host with several sections.  An
        architecture's notation has only one output, the dense layer ``No``: another operation is
        the last layer only in a network that is made or imported otherwise.
    can_recur : bool
        True if its neurons can have weights from each other.
    """

    kind: ClassVar[str]
    is_spatial: ClassVar[bool] = False
    can_read_out: ClassVar[bool] = False
    can_recur: ClassVar[bool] = False

    # --- the meaning ------------------------------------------------------------------------------

    def compute_shape(self, pooled_shape) -> Tuple[int, ...]:
        """Shape of the output: ``(n,)``, or ``(rows, columns, channels)``.

        Raises
        ------
        ValueError
            The operation does not fit its input.  The message is a predicate, such as ``"is larger
            than its input"``: the layer or its notation is written before it.
        """
        raise NotImplementedError

    def compute_weight_shape(self, pooled_shape) -> Tuple[int, ...]:
        """Shape of the weights; of a readout in sections, that of one section."""
        raise NotImplementedError

    def compute_sums(self, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The weighted sums of the values, in NumPy.

        Each sum adds values of the input, each multiplied by one of the weights.

        Parameters
        ----------
        weights : ndarray
            In the shape of `compute_weight_shape`.
        values : ndarray, shape (n, ...)
            Values of n samples or steps, in ``pooled_shape`` each.

        Returns
        -------
        ndarray, shape (n, ...)
            In `compute_shape` each; of a readout in sections (n, sections * units).
        """
        raise NotImplementedError

    # --- what follows from it ---------------------------------------------------------------------

    def find_synapses(self, pooled_shape) -> np.ndarray:
        """The weight of each synapse, as an index into the flat weights; -1 where there is none.

        Returns
        -------
        ndarray of int64, shape (inputs, outputs)

        Raises
        ------
        ValueError
            A sum is not one weight times each value that it reads.
        """
        return _find_synapses(self, tuple(pooled_shape))

    def count_fan_out(self, pooled_shape) -> np.ndarray:
        """Number of synapses of each value of the input, int64, of shape ``pooled_shape``."""
        has_synapse = self.find_synapses(pooled_shape) >= 0
        return has_synapse.sum(1, dtype=np.int64).reshape(pooled_shape)

    def count_input_fan_out(self, input_shape, pool: int = 1) -> np.ndarray:
        """Number of synapses of each value before pooling, of shape ``input_shape``.

        Values outside of complete windows have none.
        """
        if pool == 1:
            return self.count_fan_out(input_shape)
        return unpool(
            self.count_fan_out(compute_pooled_shape(input_shape, pool)), input_shape, pool
        )

    def make_matrix(self, weights: np.ndarray, pooled_shape) -> np.ndarray:
        """The weights as a matrix, shape (outputs, inputs)."""
        units = _make_units(pooled_shape)
        return self.compute_sums(weights, units).reshape(len(units), -1).T

    def make_transform(self, layer, chip: Chip) -> tuple:
        """The transform in Nengo with pooling folded in, and the inputs that it reads.

        The default has a synapse from every input to every neuron.

        Returns
        -------
        nengo.transforms.Transform
        inputs : list of int or None
            None for all of them.
        """
        import nengo

        matrix = self.make_matrix(layer.weights, layer.pooled_shape)
        if layer.pool > 1:
            by_position = np.moveaxis(matrix.reshape(len(matrix), *layer.pooled_shape), 0, -1)
            by_position = unpool(by_position, layer.input_shape, layer.pool) / layer.pool**2
            matrix = np.moveaxis(by_position, -1, 0).reshape(len(matrix), -1)
        return nengo.Dense(matrix.shape, init=matrix), None

    def make_resources(self, layer, chip: Chip) -> Resources:
        """The resources of cores that the synapses of the layer's `make_transform` need."""
        return DiscreteResources(layer, chip)

    # --- files and tables -------------------------------------------------------------------------

    def to_file(self) -> dict:
        """The operation's numbers in a bundle, by name, but for those in the layer's shapes."""
        return asdict(self)

    @classmethod
    def from_file(cls, numbers: dict, shape) -> DeployedOperation:
        """The inverse of `to_file`.

        Parameters
        ----------
        numbers : dict
        shape : tuple of int
            Shape of the layer's output.

        Raises
        ------
        deploy.loading.WrongValue
            A number is missing, unknown or out of range.
        """
        return load_dataclass(cls, numbers)

    def find_largest_weights(self, weights: np.ndarray, pooled_shape) -> np.ndarray:
        """The largest magnitude of a weight of each channel or unit, shape (channels,)."""
        synapses = self.find_synapses(pooled_shape)
        sizes = np.where(synapses < 0, 0, np.abs(weights.ravel())[synapses]).max(0)
        channels = self.compute_shape(pooled_shape)[-1]
        return sizes.reshape(-1, channels).max(0)

    def make_nir_nodes(self, layer, nir, area: float):
        """Yield the name and the NIR node of each part; pooling and neurons are added elsewhere.

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


def _make_units(pooled_shape) -> np.ndarray:
    """As many samples as there are inputs; sample i has a 1 at input i, and is 0 elsewhere."""
    inputs = math.prod(pooled_shape)
    return np.eye(inputs).reshape(inputs, *pooled_shape)


@functools.lru_cache(maxsize=16)
def _find_synapses(operation: DeployedOperation, pooled_shape) -> np.ndarray:
    """As `DeployedOperation.find_synapses`: the sums of units show which weight they have."""
    weight_shape = operation.compute_weight_shape(pooled_shape)
    numbers = np.arange(math.prod(weight_shape) + 1.0)
    units = _make_units(pooled_shape)

    def sum_units(weights):
        return operation.compute_sums(weights[1:].reshape(weight_shape), units)

    numbered = sum_units(numbers).reshape(len(units), -1)
    indices = np.clip(np.rint(numbered), 0, numbers[-1]).astype(np.int64)
    other_weights = np.where(numbers > 0, np.sqrt(numbers + 1), 0)  # none is its own square
    other_sums = sum_units(other_weights).reshape(len(units), -1)
    if not np.allclose(other_weights[indices], other_sums):
        raise ValueError(
            f"operation {operation.kind!r}: 'compute_sums' adds something other than one weight "
            "times each value that a sum reads"
        )
    synapses = indices - 1
    synapses.flags.writeable = False  # it is cached
    return synapses


class Resources:
    """Counts of axons and synapse memory of a layer that is divided into blocks of one shape.

    Recurrent weights are not included.

    Parameters
    ----------
    layer : deploy.network.layer.Layer
    chip : Chip
    """

    def __init__(self, layer, chip: Chip):
        self.layer = layer
        self.chip = chip

    def count_input_axons(self, block) -> int:
        """Number of input axons of all blocks."""
        raise NotImplementedError

    def count_needs(self, ranges) -> Tuple[int, int]:
        """Input axons and words of synapse memory of the block with these ranges of outputs."""
        raise NotImplementedError

    def make_output_axon_counter(self, block):
        """A function for the previous layer: output axons of its block with these ranges."""
        raise NotImplementedError


class DiscreteResources(Resources):
    """An axon for each input into each block, with a synapse to every neuron of the block."""

    def count_input_axons(self, block):
        return math.prod(self.layer.input_shape) * count_blocks(self.layer.shape, block)

    def count_needs(self, ranges):
        inputs = math.prod(self.layer.input_shape)
        return inputs, inputs * count_input_words(
            count_neurons(ranges), self.chip.weight_bits, self.chip
        )

    def make_output_axon_counter(self, block):
        blocks = count_blocks(self.layer.shape, block)
        return lambda ranges: count_neurons(ranges) * blocks


def count_blocks(shape, block) -> int:
    """Number of blocks of a layer."""
    return math.prod(divide_up(n, length) for n, length in zip(shape, block))


def count_neurons(ranges) -> int:
    """Number of neurons of a block with these ranges, (first, one past the last), of outputs."""
    return math.prod(last - first for first, last in ranges)


def list_ranges(n: int, length: int) -> list:
    """(first, one past the last) of each block along one dimension."""
    return [(first, min(first + length, n)) for first in range(0, n, length)]


def find_index_bits(highest: int) -> int:
    """Width of the index of a synapse's target."""
    return next((bits for bits in INDEX_BITS if 2**bits >= highest), INDEX_BITS[-1])


def count_input_words(n_synapses: int, bits: int, chip: Chip) -> int:
    """Number of words of synapse memory for the lists of one input's synapses."""
    full_lists, remaining = divmod(n_synapses, SYNAPSES_OF_LIST)
    words = full_lists * count_list_words(SYNAPSES_OF_LIST, bits, chip)
    return words + (count_list_words(remaining, bits, chip) if remaining else 0)


def count_axon_words(n_atoms: int, n_synapses: int, bits: int, chip: Chip) -> int:
    """Number of words of synapse memory for the lists of one axon whose spikes name an atom.

    The chip starts the lists of each atom with a new word.  NengoLoihi counts the synapses of all
    atoms as if they were those of one input, and refuses blocks by that count, which can be larger.

    Parameters
    ----------
    n_atoms : int
    n_synapses : int
        Number of synapses of each atom.
    bits : int
        Bits of each synapse.
    chip : Chip
    """
    return max(
        n_atoms * count_input_words(n_synapses, bits, chip),
        count_input_words(n_atoms * n_synapses, bits, chip),
    )


def count_list_words(n_synapses: int, bits: int, chip: Chip) -> int:
    """Number of words of synapse memory for one list, which starts with a new word.

    Parameters
    ----------
    n_synapses : int
    bits : int
        Bits of each synapse.
    chip : Chip
    """
    return divide_up(n_synapses * bits + chip.synapse_header_bits, chip.synapse_word_bits)
