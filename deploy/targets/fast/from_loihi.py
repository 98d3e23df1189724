"""Convert NengoLoihi's blocks, axons and synapses to flat arrays, using their internals.

They are read with their own mapping methods, so that population axons, atoms and split blocks give
the same result as in NengoLoihi's emulator.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from ...errors import UserError
from ...network.chip import LOIHI
from .arrays import U_BITS, ChipLayer, Network, Segments

_SCALARS = ("keep_u", "keep_v", "v_min", "v_max", "refractory")


def cannot(what, where=None):
    """The error for an unsupported feature."""
    place = "" if where is None else f" ({where})"
    return UserError(f"the target 'fast' does not support {what}{place}; use the target 'emulator'")


def chip_arrays(network, model, inputs):
    """Convert the chip's part of a model.

    Parameters
    ----------
    network : nengo.Network
    model : nengo_loihi.builder.Model
        The model built from the network, and discretised.
    inputs : list
        Populations on the host, each with ``neurons.n`` and ``senders``: pairs of an input of the
        model and the indices of the neurons that feed it.

    Returns
    -------
    Network
    dict of LoihiBlock to int array
        Indices of each block's compartments in the network.

    Raises
    ------
    UserError
        The model has a feature that this emulator does not support.
    """
    blocks = list(model.blocks)
    layers = _blocks_of_layers(network, model)
    columns = {name: [] for name in ("layer", "neuron", *_SCALARS, "bias", "threshold")}
    for block in blocks:
        compartment, n = block.compartment, block.n_neurons
        layer = next(i for i, (_, members) in enumerate(layers) if block in members)
        for name, value in (
            ("layer", layer),
            ("neuron", list(model.block_comp_map[block])),
            ("keep_u", LOIHI.decay_levels - compartment.decay_u),
            ("keep_v", LOIHI.decay_unit - compartment.decay_v),
            ("v_min", compartment.vmin),
            ("v_max", compartment.vmax),
            # The emulator decrements it in the step of the spike itself.
            ("refractory", np.maximum(compartment.refract_delay - 1, 0)),
            ("bias", compartment.bias),
            ("threshold", compartment.vth),
        ):
            columns[name].append(np.broadcast_to(np.asarray(value, np.int64), (n,)))
    table = {name: np.concatenate(parts) for name, parts in columns.items()}

    # Ordering by layer, segment and the population's own order makes the targets of a spike long
    # ranges of adjacent compartments.
    order = np.lexsort([table["neuron"], *(table[name] for name in _SCALARS), table["layer"]])
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    table = {name: column[order] for name, column in table.items()}
    offsets = np.cumsum([0] + [block.n_neurons for block in blocks])
    positions = {b: position[i:j] for b, i, j in zip(blocks, offsets[:-1], offsets[1:])}

    weights = _weights(model, inputs, positions, len(order))
    _refuse_loops(weights, table["layer"])
    _refuse_wrapping_voltages(table)
    segments, weights = _segments(table, weights)
    n_inputs = weights.shape[0] - len(order)
    chip = Network(
        n_inputs=n_inputs,
        weights=weights,
        segments=segments,
        bias=table["bias"].astype(np.int32),
        threshold=table["threshold"].astype(np.int32),
        layers=tuple(
            ChipLayer(label, _in_own_order(table, index)) for index, (label, _) in enumerate(layers)
        ),
        emulator_order=position,
    )
    return chip, positions


def _blocks_of_layers(network, model):
    """(label, blocks) of each ensemble on the chip, then of each block without an ensemble."""
    layers = []
    for ensemble in network.all_ensembles:
        if ensemble in model.params and ensemble.neurons in model.objs:
            blocks = model.objs[ensemble.neurons]["in"]
            layers.append((ensemble.label or str(ensemble), list(blocks)))
    known = {block for _, blocks in layers for block in blocks}
    layers += [(str(block.label), [block]) for block in model.blocks if block not in known]
    return layers


def _in_own_order(table, layer):
    mine = np.flatnonzero(table["layer"] == layer)
    return mine[np.argsort(table["neuron"][mine], kind="stable")]


def _weights(model, inputs, positions, n):
    """Matrix from each source (inputs, then compartments) to each compartment, int64."""
    home = {synapse: block for block in model.blocks for synapse in block.synapses}
    n_inputs = sum(item.neurons.n for item in inputs)
    sources, targets, values = [], [], []

    def add(axon, source_of):
        into = positions[home[axon.target]]
        for index, (compartments, weights) in enumerate(_fan_out(axon, len(source_of))):
            sources.append(np.full(len(weights), source_of[index]))
            targets.append(into[compartments])
            values.append(weights)

    start = 0
    for item in inputs:
        for spike_input, neurons in item.senders:
            for axon in spike_input.axons:
                add(axon, start + neurons)
        start += item.neurons.n
    for block in model.blocks:
        for axon in block.axons:
            add(axon, n_inputs + positions[block])
    if not values:
        return scipy.sparse.csr_matrix((n_inputs + n, n), dtype=np.int64)
    return scipy.sparse.coo_matrix(
        (
            np.concatenate(values).astype(np.int64),
            (np.concatenate(sources), np.concatenate(targets)),
        ),
        shape=(n_inputs + n, n),
    ).tocsr()  # sums the weights between the same source and compartment on several axons


def _refuse_loops(weights, layer_of):
    """Refuse connections to earlier layers; layers have the order of the network's definition."""
    n_inputs = weights.shape[0] - len(layer_of)
    entries = weights[n_inputs:].tocoo()
    if np.any(layer_of[entries.row] >= layer_of[entries.col]):
        raise cannot("connections on the chip back to a layer or to an earlier one")


def _refuse_wrapping_voltages(table):
    """Refuse bounds that would overflow: the emulator's voltages are int32 as well."""
    lost = LOIHI.decay_unit - table["keep_v"]
    reached = 2**30 * lost < 2**U_BITS * LOIHI.decay_unit
    if np.any(reached & (table["v_min"] < -(2**30))):
        raise cannot("a minimum voltage so low that voltages can leave 32 bits")


def _fan_out(axon, n_sources):
    """For each source, the compartments of the target block that its spike reaches, and weights."""
    synapse = axon.target
    compartments = np.arange(n_sources)
    for index, atom in zip(axon.map_axon(compartments), axon.map_atoms(compartments)):
        base = synapse.axon_compartment_base(index) if index >= 0 else None
        if base is None:
            yield np.empty(0, int), np.empty(0, np.int32)
            continue
        weights, indices = synapse.axon_weights_indices(index, atom=atom)
        # As in the emulator's `q[indices] += weights`, only the last of equal indices counts.
        row = dict(zip((base + indices).tolist(), weights.tolist()))
        yield np.fromiter(row.keys(), int, len(row)), np.fromiter(row.values(), np.int64, len(row))


def _segments(table, weights):
    """Group compartments with equal parameters; divide their weights by a common power of two."""
    key = np.stack([table[name] for name in ("layer", *_SCALARS)])
    edges = np.flatnonzero(np.any(key[:, 1:] != key[:, :-1], axis=0)) + 1
    start = np.concatenate([[0], edges]).astype(np.int32)
    stop = np.concatenate([edges, [key.shape[1]]]).astype(np.int32)
    used = np.zeros(key.shape[1], np.int64)
    np.bitwise_or.at(used, weights.indices, weights.data)
    bits = np.bitwise_or.reduceat(used, start)
    shift = np.array([_trailing_zeros(int(b)) for b in bits], np.int32)
    weights = weights.copy()
    weights.data >>= np.repeat(shift, stop - start)[weights.indices]
    scalars = {name: table[name][start].astype(np.int32) for name in ("layer", *_SCALARS)}
    weights.eliminate_zeros()
    weights.sort_indices()
    segments = Segments(start=start, stop=stop, shift=shift, **scalars)
    return segments, weights.astype(np.int32)


def _trailing_zeros(bits):
    return (bits & -bits).bit_length() - 1 if bits else 0
