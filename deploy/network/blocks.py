"""Division of a layer into blocks, one block per core.

A layer that fits a core is one block.  A larger one is split along rows, columns and channels into
equal blocks (`nengo_loihi.BlockShape`); of all splits in which every block fits a core, the one
with the fewest input axons in total is chosen, and of those the one with the fewest blocks.  Axons
are the cost of a split: an input that two blocks read needs an axon into each.

The counts are computed here before NengoLoihi makes the blocks
(`DeployedOperation.make_resources`); pre-flight counts the blocks made
(:mod:`deploy.preflight.resources`) and refuses those that do not fit.
"""

from __future__ import annotations

import functools
import itertools
from typing import Dict, List, Tuple

import numpy as np

from ..arithmetic import divide_up
from .chip import LOIHI, Chip
from .ops.base import count_blocks, count_input_words, list_ranges


def choose_blocks(layers, chip: Chip = LOIHI) -> Dict[str, Tuple[int, ...]]:
    """Block of each layer on the chip, by its name; an explicit ``block_shape`` has precedence.

    Parameters
    ----------
    layers : sequence of deploy.network.layer.Layer
        Layers of a network, in order.
    chip : Chip
    """
    shapes: dict = {}
    after = None
    for layer in reversed(layers):
        if layer.placement == "chip":
            after_block = shapes[after.name] if after is not None else None
            shapes[layer.name] = layer.block_shape or choose_block(layer, after, after_block, chip)
            after = layer
    return shapes


def find_rescaled_layers(layers) -> List[str]:
    """Names of the layers whose blocks have other integers than the layer as a whole.

    NengoLoihi scales the weights of each block so that the largest fills 8 bits
    (``discretize_weights``).  A layer that is divided by filters or units therefore has weights and
    thresholds that are rounded separately in each block.

    Parameters
    ----------
    layers : sequence of deploy.network.layer.Layer
        Layers of a network, in order.
    """
    shapes = choose_blocks(layers)
    names = []
    for layer in layers:
        if layer.name not in shapes or layer.neurons is None:
            continue
        largest = layer.operation.find_largest_weights(layer.weights, layer.pooled_shape)
        if layer.recurrent is not None:
            largest = np.maximum(largest, np.abs(layer.recurrent).max(1))
        ranges = list_ranges(layer.shape[-1], shapes[layer.name][-1])
        if any(largest[first:last].max() < largest.max() for first, last in ranges):
            names.append(layer.name)
    return names


def choose_block(layer, after=None, after_block=None, chip: Chip = LOIHI) -> Tuple[int, ...]:
    """Choose the block of a layer; see the module's docstring.

    Parameters
    ----------
    layer : deploy.network.layer.Layer
    after : deploy.network.layer.Layer, optional
        The next layer on the chip, which receives its spikes.
    after_block : tuple of int, optional
        Lengths of the blocks of the layer after.
    chip : Chip

    Returns
    -------
    tuple of int
        If nothing fits, the best block whose compartments fit a core.
    """
    return _choose_default_block(layer, layer.recurrent is not None, after, after_block, chip)


@functools.lru_cache(maxsize=256)
def _choose_default_block(layer, is_recurrent, after, after_block, chip):
    """As `choose_block`; layers of the same shapes are equal, whether recurrent or not."""
    limit = chip.limits["compartments"]
    needs = BlockNeeds(layer, chip)
    count_output_axons = None
    if after:
        resources = after.operation.make_resources(after, chip)
        count_axons_of_synapse = resources.make_output_axon_counter(after_block)

        def count_output_axons(ranges):
            return after.synapses_per_weight * count_axons_of_synapse(ranges)

    if layer.size <= limit and needs.are_within_limits(layer.shape, count_output_axons):
        return layer.shape
    lengths = [list(_list_lengths(n)) for n in layer.shape]
    blocks = [block for block in itertools.product(*lengths) if np.prod(block) <= limit]

    def compute_cost(block):
        return needs.count_input_axons(block), count_blocks(layer.shape, block), block

    by_cost = sorted(blocks, key=compute_cost)
    for block in by_cost:
        if needs.are_within_limits(block, count_output_axons):
            return block
    return by_cost[0]


def _list_lengths(n):
    """Lengths of equal blocks along one dimension, from the whole down; the last may be shorter."""
    return sorted({divide_up(n, blocks) for blocks in range(1, n + 1)}, reverse=True)


class BlockNeeds:
    """Resources that a layer's blocks need, with those of its recurrent weights.

    Parameters
    ----------
    layer : deploy.network.layer.Layer
    chip : Chip
    """

    def __init__(self, layer, chip: Chip = LOIHI):
        self.layer = layer
        self.chip = chip
        self.resources = layer.operation.make_resources(layer, chip)
        self.synapses = layer.synapses_per_weight
        self.recurrent_axons = 0 if layer.recurrent is None else layer.size

    def count_input_axons(self, block) -> int:
        """Number of input axons of all blocks of one shape."""
        blocks = count_blocks(self.layer.shape, block)
        axons = self.resources.count_input_axons(block) + self.recurrent_axons * blocks
        return axons * self.synapses

    def count(self, ranges) -> Tuple[int, int]:
        """Input axons and words of synapse memory of the block with these ranges of outputs."""
        axons, words = self.resources.count_needs(ranges)
        if self.recurrent_axons:
            ((first, last),) = ranges
            words_of_one = count_input_words(last - first, self.chip.weight_bits, self.chip)
            words += self.recurrent_axons * words_of_one
        return (axons + self.recurrent_axons) * self.synapses, words * self.synapses

    def are_within_limits(self, block, count_output_axons) -> bool:
        """True if each block is within the limits of a core, compartments excepted.

        Parameters
        ----------
        block : tuple of int
        count_output_axons : callable or None
            From `Resources.make_output_axon_counter` of the next layer.
        """
        limits = self.chip.limits
        along = [list_ranges(n, length) for n, length in zip(self.layer.shape, block)]
        for ranges in itertools.product(*along):
            axons, words = self.count(ranges)
            if axons > limits["input axons"] or words > limits["synapse words"]:
                return False
            sent = 0 if count_output_axons is None else count_output_axons(ranges)
            if self.recurrent_axons:
                neurons = ranges[0][1] - ranges[0][0]
                sent += neurons * count_blocks(self.layer.shape, block) * self.synapses
            if sent > limits["output axons"]:
                return False
        return True
