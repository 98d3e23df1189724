"""A network of NengoLoihi as flat arrays: segments of compartments, rows of weights, routes.

Compartments have the emulator's order, one block after the other.

- A *segment* is a range of adjacent compartments of a block with the same decays, limits and
  refractory period, which are then scalars instead of arrays.
- A *row* has the weights that one spike adds: a few *runs* of adjacent weights.  A synapse's rows
  are in one of two pools.  The *narrow* pool has 16 bits, each weight without its block's common
  power of two, and runs are padded with zeros; sums of 16 bits are added to the input before they
  can overflow.  The *wide* pool has the type of the state.  It is used for float32, for weights
  that do not fit 16 bits, and for weights that learn.
- A *route* leads the spikes of an input or a block to a synapse.  Routes have the emulator's order
  of addition, on which sums of float32 depend.  A route has one *entry* for each neuron of its
  source: row, first compartment, and trace.
"""

from __future__ import annotations

from typing import Dict, List, NamedTuple

import numpy as np
from nengo_loihi.block import Axon, Synapse
from nengo_loihi.builder.discretize import LEARN_FRAC, learn_overflow_bits
from nengo_loihi.inputs import SpikeInput

KEYS = ("current", "voltage", "spiked")  # of probes; the compiled functions have their indices
LANES = 16  # narrow runs are padded to multiples: vectors of 256 bits
MAX_NARROW_WEIGHT = 4095  # a sum of 16 bits has room for at least eight rows


class Unsupported(Exception):
    """A property of a model that requires NengoLoihi's own code; the message names it."""


class Layout(NamedTuple):
    """A network as flat arrays; see the module's description.

    Attributes
    ----------
    network : tuple of ndarray
        ``segments, constants, blocks, routes, entries, first_run, runs, narrow, wide, sums,
        input_sizes``: as the compiled functions take them, which name their columns.
    learning : tuple of ndarray
        ``rules, rates``: a line for each synapse that learns.
    noise : tuple of ndarray
        Offset, scale, and whether it is added to the voltage, of each compartment.
    recorded : (n_runs, 4) int64 array
        Runs of compartments that are probed: key, first compartment, length, first column.
    widths : list of int
        Columns of each key.
    columns : dict of LoihiProbe to (int, list of slice)
        The key of a probe, and the columns of each of its blocks.
    weights : dict of Synapse to list of ndarray
        Weights of learning synapses: views of the wide pool, of the shape of the synapse's own.
    is_noisy : bool
    """

    network: tuple
    learning: tuple
    noise: tuple
    recorded: np.ndarray
    widths: List[int]
    columns: Dict
    weights: Dict
    is_noisy: bool


def make_layout(emulator) -> Layout:
    """Read a network from NengoLoihi's emulator, which is not changed.

    Parameters
    ----------
    emulator : nengo_loihi.emulator.EmulatorInterface

    Raises
    ------
    Unsupported
        The network has a feature that the compiled steps do not support, or something in it cannot
        be read: NengoLoihi may read it later, never, or raise an error of its own.
    """
    try:
        return _make_layout(emulator)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise Unsupported(f"a network that cannot be read ({error!r})") from error


def _make_layout(emulator):
    info = emulator.block_info
    state = emulator.compartment
    is_integer = state.dtype == np.int32
    for item in emulator.inputs:
        if type(item) is not SpikeInput:
            raise Unsupported(f"an input of the class {type(item).__name__}")
    noise = _make_noise(state.noise, is_integer)
    segments, constants, bounds = _make_segments(info, state, is_integer)
    pools = _Pools(emulator.synapses, info, is_integer)
    routes, entries = _make_routes(emulator, pools)
    blocks = np.array(
        [
            (part.start, part.stop, pools.shifts[b], pools.is_wide[b], *bounds[b])
            for b, part in enumerate(info.slices.values())
        ],
        np.int64,
    )
    learning = _make_learning(emulator.synapses, pools, is_integer)
    recorded, widths, columns = _plan_probes(emulator.probes)
    first_run, runs, narrow, wide = pools.to_arrays(state.dtype)
    return Layout(
        network=(
            segments, constants, blocks, routes, entries, first_run, runs, narrow, wide,
            np.zeros(info.n_compartments + LANES, np.int16),
            np.array([item.n_neurons for item in emulator.inputs], np.int64),
        ),
        learning=learning,
        noise=noise,
        recorded=recorded,
        widths=widths,
        columns=columns,
        weights={
            synapse: pools.view_weights(synapse, wide) for synapse in emulator.synapses.traces
        },
        is_noisy=bool(np.any(state.noise.mult)),
    )  # fmt: skip


def _make_segments(info, state, is_integer):
    """Segments, their constants, and the first and last segment of each block."""
    keep_u = (4095 if is_integer else 1) - state.decay_u
    keep_v = (4096 if is_integer else 1) - state.decay_v
    if is_integer:
        for keep in (keep_u, keep_v):
            if np.any((keep < 0) | (keep > 4096)):
                raise Unsupported("decays outside of 12 bits")
        if np.any(state.vmin <= -(2**31)):
            raise Unsupported("a minimum voltage beyond 32 bits")
    columns = [keep_u, keep_v, state.scale_u, state.scale_v, state.vmin, state.vmax]
    table = np.stack([*columns, state.ref], axis=1).astype(state.dtype)
    edge = np.ones(len(table) + 1, bool)
    edge[1:-1] = np.any(table[1:] != table[:-1], axis=1)
    edge[[part.start for part in info.slices.values()]] = True
    edges = np.flatnonzero(edge)
    segments = np.stack([edges[:-1], edges[1:], table[edges[:-1], -1].astype(np.int64)], axis=1)
    bounds = [
        tuple(np.searchsorted(edges, (part.start, part.stop)).tolist())
        for part in info.slices.values()
    ]
    return segments.astype(np.int64), np.ascontiguousarray(table[edges[:-1], :-1]), bounds


def _make_noise(noise, is_integer):
    scale_type = np.float64 if is_integer else np.float32
    if noise.mult.dtype != scale_type:
        raise Unsupported(f"noise of type {noise.mult.dtype}")
    if is_integer:
        largest = 127.0 + np.abs(noise.mant_offset.astype(float))
        largest *= np.maximum(noise.mult, 1)  # the sum must fit as well
        if np.any(~(largest < 2.0**31)):
            raise Unsupported("noise beyond 32 bits")
    return noise.mant_offset, noise.mult, noise.target_u.astype(np.uint8)


class _Pools:
    """The rows of all synapses, and the position of each synapse's rows.

    Attributes
    ----------
    shifts : list of int
        Exponent of the power of two by which the narrow weights of each block are divided.
    is_wide : list of bool
        True if a block has wide weights.
    narrow, largest : dict of Synapse
        True if a synapse is in the narrow pool, and the largest magnitude there.
    """

    def __init__(self, synapses, info, is_integer):
        self.first_row = {}
        self.atoms = {}
        self.reach = {}
        self.narrow = {}
        self.largest = {}
        self.shifts = []
        self.is_wide = []
        self._first_weight = {}
        self._runs = []
        self._runs_of_row = []
        self._pools = {True: [], False: []}
        self._sizes = {True: 0, False: 0}
        n_rows = 0
        for block in info.blocks:
            items = [_Rows(synapse, block, synapses.dtype) for synapse in block.synapses]
            fixed = [rows for rows in items if is_integer and not rows.synapse.learning]
            shift = _count_trailing_zeros(np.bitwise_or.reduce([0, *(rows.bits for rows in fixed)]))
            self.shifts.append(shift)
            self.is_wide.append(False)
            for rows in items:
                synapse = rows.synapse
                narrow = rows in fixed and rows.largest >> shift <= MAX_NARROW_WEIGHT
                self.narrow[synapse] = narrow
                self.largest[synapse] = max(1, rows.largest >> shift) if narrow else 1
                self.is_wide[-1] |= not narrow
                self.first_row[synapse] = n_rows
                self.atoms[synapse] = rows.n_atoms
                self.reach[synapse] = rows.lowest, rows.highest
                self._first_weight[synapse] = self._sizes[narrow]
                runs, per_row, pool = rows.cut(shift) if narrow else rows.cut(None)
                runs[:, 1] += self._sizes[narrow]
                self._sizes[narrow] += len(pool)
                self._pools[narrow].append(pool)
                self._runs.append(runs)
                self._runs_of_row.append(per_row)
                n_rows += len(per_row)
        if max(self._sizes.values()) >= 2**31:
            raise Unsupported("more than 2 ** 31 weights")

    def to_arrays(self, dtype):
        """``first_run, runs, narrow, wide``."""
        first_run = np.cumsum(np.concatenate([[0], *self._runs_of_row])).astype(np.int32)
        runs = np.concatenate([np.zeros((0, 3), np.int64), *self._runs]).astype(np.int32)
        return (
            first_run,
            runs,
            np.concatenate([np.zeros(0, np.int16), *self._pools[True]]).astype(np.int16),
            np.concatenate([np.zeros(0, dtype), *self._pools[False]]).astype(dtype),
        )

    def find_first_weight(self, synapse):
        """Position in the wide pool at which the weights of a learning synapse begin."""
        return self._first_weight[synapse]

    def view_weights(self, synapse, wide):
        """The weights of a synapse that learns, as parts of the wide pool."""
        width = len(synapse.weights[0].ravel()) if synapse.weights else 0
        first = self._first_weight[synapse]
        return [
            wide[first + i * width : first + (i + 1) * width].reshape(1, -1)
            for i in range(len(synapse.weights))
        ]


class _Rows:
    """The rows of a synapse, by its weights and by their atoms.

    Attributes
    ----------
    bits, largest : int
        Bitwise OR of all weights, and the largest magnitude.
    lowest, highest : (n_rows,) int array
        The first and last compartment of each row, 0 and -1 where there is none.
    """

    def __init__(self, synapse, block, dtype):
        self.synapse = synapse
        weights = synapse.weights
        indices = synapse.indices
        if not weights or any(w.dtype != dtype for w in weights):
            raise Unsupported(f"weights of a type other than {dtype}")
        self.n_atoms = weights[0].shape[0]
        if any(w.shape != i.shape or len(w) != self.n_atoms for w, i in zip(weights, indices)):
            raise Unsupported("weights and indices of different shapes")
        if any(i.dtype not in (np.int32, np.int64) for i in indices):
            raise Unsupported("indices of a type other than integers of 32 or 64 bits")
        self.lengths = np.repeat([w.shape[1] for w in weights], self.n_atoms)
        self.weights = np.concatenate([w.ravel() for w in weights])
        self.targets = np.concatenate([i.ravel() for i in indices]).astype(np.int64)
        self.row = np.repeat(np.arange(len(self.lengths)), self.lengths)
        if synapse.learning:
            self._require_learnable_weights(block)
        self._sort()
        starts = np.cumsum([0, *self.lengths[:-1]])
        self.lowest = np.zeros(len(self.lengths), np.int64)
        self.highest = np.full(len(self.lengths), -1)
        used = self.lengths > 0
        self.lowest[used] = self.targets[starts[used]]
        self.highest[used] = self.targets[starts[used] + self.lengths[used] - 1]
        self.bits = self.largest = 0
        if dtype == np.int32 and len(self.weights):
            values = self.weights.astype(np.int64)
            self.bits = int(np.bitwise_or.reduce(values))
            self.largest = int(np.abs(values).max())

    def _require_learnable_weights(self, block):
        """Refuse weights unless NengoLoihi's learning can change all weights of a row."""
        n = 2 * (block.n_neurons // 2)
        alone = all(w.shape == (1, n) and np.array_equal(i[0], np.arange(n)) for w, i in
                    zip(self.synapse.weights, self.synapse.indices))  # fmt: skip
        if not alone:
            raise Unsupported("learning on sparse weights")
        if len(self.synapse.weights) != self.synapse.n_axons:
            raise Unsupported("learning with a number of rows of weights other than one per axon")

    def _sort(self):
        """Sort by target; as in ``q[indices] += weights``, the last of equal targets counts."""
        rises = (self.row[1:] > self.row[:-1]) | (self.targets[1:] > self.targets[:-1])
        if np.all(rises):
            return
        order = np.lexsort((np.arange(len(self.row)), self.targets, self.row))
        row = self.row[order]
        targets = self.targets[order]
        last = np.ones(len(row), bool)
        last[:-1] = (row[1:] != row[:-1]) | (targets[1:] != targets[:-1])
        self.row = row[last]
        self.targets = targets[last]
        self.weights = self.weights[order][last]
        self.lengths = np.bincount(self.row, minlength=len(self.lengths))

    def cut(self, shift):
        """Runs (target, place, length), the number of runs of each row, and the weights.

        With a shift, weights are divided by that power of two, small gaps are filled with zeros,
        and lengths are multiples of `LANES`.
        """
        gap = LANES if shift is not None else 1
        begins_run = np.ones(len(self.row), bool)
        begins_row = self.row[1:] != self.row[:-1]
        begins_run[1:] = begins_row | (self.targets[1:] > self.targets[:-1] + gap)
        starts = np.flatnonzero(begins_run)
        ends = np.append(starts[1:], len(self.row)) - 1
        per_row = np.bincount(self.row[starts], minlength=len(self.lengths))
        if not len(starts):
            return np.zeros((0, 3), np.int64), per_row, self.weights
        first = self.targets[starts]
        lengths = self.targets[ends] + 1 - first
        if shift is None:
            return np.stack([first, starts, lengths], axis=1), per_row, self.weights
        lengths = -(-lengths // LANES) * LANES
        positions = np.cumsum(lengths) - lengths
        pool = np.zeros(int(lengths.sum()), np.int16)
        run = np.cumsum(begins_run) - 1
        pool[positions[run] + self.targets - first[run]] = self.weights >> shift
        return np.stack([first, positions, lengths], axis=1), per_row, pool


def _count_trailing_zeros(bits):
    bits = int(bits)
    return (bits & -bits).bit_length() - 1 if bits else 0


def _make_routes(emulator, pools):
    """Connections from each input and block to each synapse, in the order of the emulator."""
    synapses = emulator.synapses
    info = emulator.block_info
    inputs = emulator.inputs
    order = {synapse: i for i, synapse in enumerate(synapses.slices)}
    rule = {synapse: k for k, synapse in enumerate(synapses.traces)}
    trace0 = dict(zip(rule, np.cumsum([0, *(s.n_axons for s in rule)]).tolist()))
    sources = [(i, 0, item) for i, item in enumerate(inputs)]
    sources += [(len(inputs) + b, info.slices[k].start, k) for b, k in enumerate(info.blocks)]
    routes = [(axon.target, axon, *source) for source in sources for axon in source[2].axons]
    routes.sort(key=lambda route: order[route[0]])  # leaves a synapse's order unchanged
    number = {block: b for b, block in enumerate(info.blocks)}
    table = []
    columns = []
    size = 0
    for synapse, axon, source, start, sender in routes:
        for part, kind in ((synapse, Synapse), (axon, Axon)):
            if type(part) is not kind:
                raise Unsupported(f"the class {type(part).__name__}")
        index, atom = _map_axons(axon, sender.n_neurons)
        row, base = _find_rows(synapse, index, atom, pools)
        part = synapses.slices[synapse]
        reach = np.where(row >= 0, base + pools.reach[synapse][1][row], 0)
        depth = np.where(row >= 0, base + pools.reach[synapse][0][row], 0)
        if np.any(reach >= part.stop - part.start) or np.any(depth < 0):
            raise Unsupported("a weight to a compartment that its block does not have")
        traced = synapse in rule
        if traced and np.any(index >= synapse.n_axons):
            raise Unsupported("an axon that its synapse does not have")
        columns.append(
            (
                np.where(row >= 0, pools.first_row[synapse] + row, -1),
                base + part.start,
                np.where(index >= 0, trace0[synapse] + index, -1) if traced else index * 0 - 1,
            )
        )
        table.append(
            (
                source,
                size - start,
                number[synapses.block_map[synapse]],
                not pools.narrow[synapse],
                pools.largest[synapse],
                rule.get(synapse, -1),
            )
        )
        size += sender.n_neurons
    entries = np.concatenate([np.zeros((3, 0), np.int32), *columns], axis=1)
    return np.array(table, np.int64).reshape(-1, 6), entries.astype(np.int32)


def _map_axons(axon, n):
    """Axon and atom of the spike of each neuron of a source; a negative axon means none."""
    neurons = np.arange(n)
    axons = _convert_to_integers(axon.map_axon(neurons))
    return axons, _convert_to_integers(axon.map_atoms(neurons))


def _convert_to_integers(values):
    """Numbers of axons, atoms and the like as an array; others than integers are errors there."""
    values = np.asarray(values)
    if len(values) and values.dtype.kind not in "iu":
        raise Unsupported("axons that are not numbered by integers")
    return values.astype(np.int64)


def _find_rows(synapse, index, atom, pools):
    """The row of a synapse (-1: none) and the first compartment, for each axon and atom."""
    used = index >= 0
    base = np.zeros(len(index), np.int64)
    if synapse.axon_compartment_bases is not None:
        base[used] = _convert_to_integers(synapse.axon_compartment_bases)[index[used]]
        used = used & (base >= 0)
    row = np.full(len(index), -1)
    row_of_axon = synapse.axon_to_weight_map
    row[used] = index[used]
    if row_of_axon is not None:
        row[used] = _convert_to_integers([row_of_axon[i] for i in index[used].tolist()])
    n_atoms = pools.atoms[synapse]
    if np.any(used & (row < 0)):
        raise Unsupported("an axon that its synapse does not have")
    if np.any(used & ((atom < 0) | (atom >= n_atoms))):
        raise Unsupported("an atom that its synapse does not have")
    return np.where(used, row * n_atoms + atom, -1), np.where(used, base, 0)


def _make_learning(synapses, pools, is_integer):
    """``rules`` and ``rates``."""
    rules = []
    rates = []
    trace = error = 0
    for s in synapses.traces:
        n = s.n_axons
        n_errors = len(synapses.pes_errors[s])
        product_shift = old_shift = new_shift = fraction_bits = limit = 0
        rate = s._lr_int if is_integer else 0
        parameters = [s.train_epoch, s.learn_epoch]
        if is_integer:
            parameters += [rate, s._lr_exp, s.synapse_cfg.real_weight_exp, s.synapse_cfg.shift_bits]
        # NengoLoihi uses 64 bits for NumPy's integers.
        if any(type(value) is not int for value in parameters):
            raise Unsupported("a learning rule whose parameters are not Python's integers")
        if not (min(s.train_epoch, s.learn_epoch) > 0 and s.tracing_tau > 0):
            raise Unsupported("a learning rule with a period that is not positive")
        if is_integer:
            exponent = s.synapse_cfg.real_weight_exp
            spare = s.synapse_cfg.shift_bits
            product_shift = LEARN_FRAC + s._lr_exp - learn_overflow_bits(n_factors=2)
            old_shift = LEARN_FRAC - exponent
            new_shift = exponent + spare
            fraction_bits = LEARN_FRAC + spare
            limit = 2 ** (8 - spare) - 1
            shifts_fit = abs(product_shift) < 32 and abs(old_shift) < 32 and 0 <= new_shift < 32
            if not (shifts_fit and 0 < fraction_bits < 28):
                raise Unsupported("learning with shifts beyond 32 bits")
            if not -(2**31) <= rate < 2**31 or not 0 <= s.tracing_mag < 2**30:
                raise Unsupported("a learning rate beyond 32 bits")
        elif int(np.__version__.split(".")[0]) < 2:
            raise Unsupported("learning in floating point on NumPy 1, which rounds differently")
        product_type = (s.learning_rate * np.ones(1, np.float32)).dtype
        rules.append(
            (trace, trace + n, error, error + n_errors, pools.find_first_weight(s), s.train_epoch,
             s.learn_epoch, rate, product_shift, old_shift, fraction_bits, new_shift, limit,
             product_type == np.float64)
        )  # fmt: skip
        rates.append((np.exp(-s.train_epoch / s.tracing_tau), s.tracing_mag, s.learning_rate))
        trace = trace + n
        error = error + n_errors
    return np.array(rules, np.int64).reshape(-1, 14), np.array(rates, float).reshape(-1, 3)


def _plan_probes(probes):
    """The runs of compartments that are probed, the width of each key, each probe's columns."""
    runs = []
    columns = {}
    widths = [0] * len(KEYS)
    for probe, blocks in probes.probes.items():
        if probe.key not in KEYS:
            raise Unsupported(f"a probe of {probe.key!r}")
        key = KEYS.index(probe.key)
        parts = []
        for part, selected in zip(blocks.values(), probe.slice):
            compartments = np.arange(part.start, part.stop)[selected]
            if compartments.ndim != 1:
                raise Unsupported("a probe of a single compartment by its number")
            starts = np.flatnonzero(np.diff(compartments, prepend=-2) != 1)
            lengths = np.diff(np.append(starts, len(compartments)))
            runs += [
                (key, compartments[at], length, widths[key] + at)
                for at, length in zip(starts.tolist(), lengths.tolist())
            ]
            parts.append(slice(widths[key], widths[key] + len(compartments)))
            widths[key] += len(compartments)
        columns[probe] = (key, parts)
    return np.array(runs, np.int64).reshape(-1, 4), widths, columns
