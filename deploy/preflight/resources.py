"""Resources that NengoLoihi's blocks need of a core, and the limits of a core.

A block is the part of a layer on one core, after discretisation.
"""

from __future__ import annotations

from typing import Dict

import numpy as np

from ..arithmetic import divide_up
from ..network.chip import Chip
from ..network.ops.base import count_list_words

# By the type of axon: discrete, or a population's of 32 bits.
AXON_CFGS_PER_AXON = {0: 1, 32: 2}


def count_used(block, chip: Chip, n_registers: int) -> Dict[str, int]:
    """Number of each of the chip's limited resources that a block needs.

    Parameters
    ----------
    block : nengo_loihi.block.LoihiBlock
    chip : Chip
    n_registers : int
        AxonCfg registers of the block.
    """
    return {
        "compartments": int(block.compartment.n_compartments),
        "input axons": int(sum(synapse.n_axons for synapse in block.synapses)),
        "output axons": int(sum(axon.axon_slots() for axon in block.axons)),
        "AxonCfg registers": n_registers,
        "synapse words": count_synapse_words(block, chip),
    }


def count_axon_cfg_registers(block, targets):
    """Number of AxonCfg registers for a block's output axons.

    A neuron's spikes use a contiguous range of AxonCfg registers, one or (pop32) two for each
    destination.  Neurons of one population, the channels of one pixel, have the same destinations
    and may share a range.

    Parameters
    ----------
    block : nengo_loihi.block.LoihiBlock
    targets : dict
        :func:`find_axons_with_targets` of each synapse object, by its ``id``.

    Returns
    -------
    shared, unshared : int
        With and without sharing.  NengoLoihi assumes sharing, but boards have refused networks that
        passed NengoLoihi's count (its issue 326), so the actual number may be between the two.
    """
    if not block.axons:
        return 0, 0
    neurons = np.arange(block.n_neurons)
    # A column for each of the block's axon objects: the axon that a neuron's spikes go to, or -1.
    columns = []
    for axon in block.axons:
        numbers = np.array(axon.map_axon(neurons))
        numbers[(numbers >= 0) & ~targets[id(axon.target)][numbers]] = -1
        columns.append(numbers)
    destinations = np.stack(columns, axis=1)
    registers = np.array([AXON_CFGS_PER_AXON[axon.pop_type] for axon in block.axons])
    is_discrete = np.array([not axon.pop_type for axon in block.axons])
    unshared = (destinations >= 0) @ registers
    is_population = (destinations[:, is_discrete] < 0).all(axis=1)
    runs = np.unique(destinations[is_population], axis=0)
    shared = ((runs >= 0) @ registers).sum() + unshared[~is_population].sum()
    return int(shared), int(unshared.sum())


def find_axons_with_targets(synapse) -> np.ndarray:
    """For each axon of a synapse object whether it has targets; others are not on the chip."""
    sizes = np.array([weights[0].size for weights in synapse.weights])
    numbers = np.arange(synapse.n_axons)
    if synapse.axon_to_weight_map is not None:
        numbers = np.asarray(synapse.axon_to_weight_map)
    has_targets = sizes[numbers] > 0
    if synapse.axon_compartment_bases is not None:
        has_targets &= np.asarray(synapse.axon_compartment_bases) >= 0
    return has_targets


def count_synapse_words(block, chip: Chip) -> int:
    """Number of words of synapse memory of a block: the chip's, or NengoLoihi's if it is larger.

    NengoLoihi counts the synapses of all atoms of an axon as one sequence, and refuses blocks by
    that count.
    """
    words = sum(count_words_of_synapses(synapse, chip) for synapse in block.synapses)
    bits = sum(synapse.bits() for synapse in block.synapses)
    return int(max(words, divide_up(int(bits), chip.synapse_word_bits)))


def count_words_of_synapses(synapse, chip: Chip) -> int:
    """Number of words of synapse memory, where each list of synapses starts with a new word.

    A list is what one spike reads: the weights of an axon, for one atom in a population.
    """
    form = synapse.synapse_cfg
    bits = form.real_weight_bits + form.delay_bits + form.tag_bits
    bits += form.real_idx_bits if form.compression == 0 else 0
    per_block = form.n_synapses + 1
    words = 0
    for weights in synapse.weights:
        atoms, length = weights.shape
        for first in range(0, length, per_block):
            n = min(per_block, length - first)
            words += atoms * count_list_words(n, bits, chip)
    return words


def compute_worst_case(block, intervals, chip: Chip):
    """Largest possible magnitude of one step's synaptic input and of the current.

    Every source fires at its maximum rate, and only weights of one sign count.

    Parameters
    ----------
    block : nengo_loihi.block.LoihiBlock
    intervals : dict
        Minimum interval in steps between two spikes of a synapse object's sources, by its ``id``.
    chip : Chip

    Returns
    -------
    input, current : int
        In the chip's integers; the limits are `Chip.input_limit` and `Chip.current_limit`.
    """
    n = block.compartment.n_compartments
    # The chip subtracts one unit more from a current than its decay.
    keep = (chip.decay_levels - block.compartment.decay_u.astype(float)) / chip.decay_unit
    inputs = np.zeros((2, n))
    currents = np.zeros((2, n))
    for synapse in block.synapses:
        compartments, weights = _list_synapses(synapse)
        sums = np.stack(
            [
                np.bincount(compartments, np.maximum(sign * weights, 0), minlength=n)
                for sign in (1, -1)
            ]
        )
        inputs += sums
        currents += sums / (1 - keep ** intervals.get(id(synapse), 1))
    bias = block.compartment.bias.astype(float)
    currents += np.stack([np.maximum(bias, 0), np.maximum(-bias, 0)])
    return int(inputs.max()), int(currents.max())


def _list_synapses(synapse):
    """Compartments and weights of all synapses of a synapse object, two flat arrays."""
    compartments = [np.empty(0, np.int64)]
    weights = [np.empty(0)]
    for axon in range(synapse.n_axons):
        base = synapse.axon_compartment_base(axon)
        if base is None:
            continue
        at = synapse.axon_weight_idx(axon)  # arrays of shape (atoms, synapses)
        compartments.append((base + synapse.indices[at]).ravel())
        weights.append(synapse.weights[at].ravel())
    return np.concatenate(compartments).astype(np.int64), np.concatenate(weights)
