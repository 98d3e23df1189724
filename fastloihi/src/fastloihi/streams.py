"""One discretised network for several independent streams of input spikes, side by side.

>>> streams = StreamEmulator(model)  # a built nengo_loihi.builder.Model
>>> state = streams.start(n_streams=20)
>>> spikes, overflows = streams.advance(state, inputs)

It uses the compiled steps of `FastEmulator`; the network's arrays are shared by all streams.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from nengo_loihi.emulator.interface import EmulatorInterface

from . import compiled
from .arrays import EmulatorArrays
from .layout import Unsupported

_CONSTANTS = ("keep_u", "keep_v", "v_min", "v_max")
_SPIKED = 2  # index of the key "spiked" in `layout.KEYS`


class StreamState(NamedTuple):
    """State of several streams between two steps.

    Attributes
    ----------
    cells, counters, spiked : ndarray
        The arrays of `EmulatorArrays`, with the streams as their first axis.
    arriving : (n_streams, n_inputs) array
        Spikes that arrive in the next step.
    """

    cells: np.ndarray
    counters: np.ndarray
    spiked: np.ndarray
    arriving: np.ndarray


class StreamEmulator:
    """NengoLoihi's emulator for several streams, with bit-identical spikes.

    An object must not be used by two threads at a time.

    Parameters
    ----------
    model : nengo_loihi.builder.Model
        A discretised model.  Learning and noise are not supported.

    Attributes
    ----------
    n : int
        Number of compartments, in the order of the model's blocks.
    input_sizes : list of int
        Number of neurons of each of the model's inputs.
    blocks : dict of LoihiBlock to slice
        The compartments of each block.
    network : tuple of ndarray
        See `layout.Layout`.

    Raises
    ------
    Unsupported
        The model needs NengoLoihi's own emulator.
    """

    def __init__(self, model):
        emulator = EmulatorInterface(model)
        self._arrays = arrays = EmulatorArrays(emulator)
        if arrays.draws or emulator.compartment.dtype != np.int32:
            raise Unsupported("learning, noise, or a model that is not discretised")
        self.n = emulator.block_info.n_compartments
        self.blocks = dict(emulator.block_info.slices)
        self.input_sizes = [item.n_neurons for item in emulator.inputs]
        self.network = arrays.layout.network
        self._edges = np.cumsum([0, *self.input_sizes])
        self._record = np.array([[_SPIKED, 0, self.n, 0]], np.int64)

    def start(self, n_streams) -> StreamState:
        """The state of a fresh network, for some streams."""

        def repeat(array):
            return np.tile(array, (n_streams, *[1] * array.ndim))

        return StreamState(
            cells=repeat(self._arrays.cells),
            counters=repeat(self._arrays.counters),
            spiked=repeat(self._arrays.spiked),
            arriving=np.zeros((n_streams, self._edges[-1]), np.uint8),
        )

    def advance(self, state, inputs):
        """Advance all streams by some steps.

        Parameters
        ----------
        state : StreamState
            Changed to the state after the last step.
        inputs : (n_streams, n_steps, n_inputs) uint8 array
            Not 0 where a neuron of an input spikes; the inputs of the model are one after the
            other.  A spike arrives one step later.

        Returns
        -------
        spikes : (n_streams, n_steps, n) uint8 array
        overflows : (n_blocks, 3) int64 array
            Number of overflows in each block of the synaptic input, the current, and the sum of
            current and bias: ``q0``, ``current``, ``u2`` in NengoLoihi.
        """
        n_streams, n_steps, n_inputs = inputs.shape
        arriving = np.zeros((n_streams, n_steps, _pad_to_8(n_inputs)), np.uint8)
        arriving[:, 0, :n_inputs] = state.arriving
        arriving[:, 1:, :n_inputs] = inputs[:, :-1]
        state.arriving[:] = inputs[:, -1]
        spikes = np.empty((n_streams, n_steps, self.n), np.uint8)
        sent = np.empty(max(1, n_steps * n_inputs), np.int64)
        ends = np.zeros(n_steps * len(self.input_sizes) + 1, np.int64)
        log = np.zeros((n_steps + 4, 2), np.int64)  # so that it cannot fill up
        empty = np.zeros((1, 0), np.int32)
        arrays = self._arrays
        arrays.overflows[:] = 0
        for b in range(n_streams):
            compiled.list_inputs(arriving[b].view(np.uint64), self._edges, sent, ends)
            log[0, 0] = 0
            done = arrays.advance(
                state.cells[b], state.counters[b], state.spiked[b],
                state.spiked[b].view(np.uint64), arrays.before, *arrays.fixed_arguments,
                arrays.random.words, self._record, False, False, 0, n_steps,
                sent, ends, empty, empty, spikes[b], log, False,
            )  # fmt: skip
            if done < 0:
                raise Unsupported("a voltage of -2**31")
        return spikes, arrays.overflows.copy()

    def read_constants(self):
        """Integers of the compartments.

        Returns
        -------
        dict of str to (n,) int64 array
            ``bias``, ``threshold``, the decays' ``keep_u`` and ``keep_v`` (see `compiled`),
            ``v_min``, ``v_max``, and the steps after a spike in which the voltage stays at 0,
            ``refractory``.
        """
        segments, table = self.network[:2]
        lengths = segments[:, compiled.STOP] - segments[:, compiled.START]
        columns = {name: table[:, getattr(compiled, name.upper())] for name in _CONSTANTS}
        columns["refractory"] = np.maximum(segments[:, compiled.REFRACTORY] - 1, 0)
        values = {name: np.repeat(column, lengths) for name, column in columns.items()}
        values["bias"] = self._arrays.cells[compiled.BIAS]
        values["threshold"] = self._arrays.cells[compiled.THRESHOLD]
        return {name: value.astype(np.int64) for name, value in values.items()}

    def set_constants(self, refractory, v_min):
        """Give all compartments other refractory steps and another lower bound of the voltage."""
        segments, table = self.network[:2]
        segments[:, compiled.REFRACTORY] = refractory + 1
        table[:, compiled.V_MIN] = v_min

    def read_weights(self):
        """All weights on the chip: (source, target, value) of each, int64 arrays.

        Sources are the neurons of the inputs, followed by the compartments; targets are
        compartments.  Several values of a source and target are added.
        """
        _, _, blocks, routes, entries, first_run, runs, narrow, wide, _, sizes = self.network
        ranges = [(0, size) for size in sizes] + [tuple(block[:2]) for block in blocks]
        firsts = [*self._edges[:-1], *[self._edges[-1]] * len(blocks)]
        weights = [np.zeros((3, 0), np.int64)]
        for source, offset, block, is_wide, *_ in routes.tolist():
            pool, shift = (wide, 0) if is_wide else (narrow, int(blocks[block, compiled.SHIFT]))
            for neuron in range(*ranges[source]):
                row, base, _ = entries[:, neuron + offset].tolist()
                if row < 0:
                    continue
                for target, first_weight, length in runs[
                    first_run[row] : first_run[row + 1]
                ].tolist():
                    values = pool[first_weight : first_weight + length].astype(np.int64) << shift
                    used = np.flatnonzero(values)
                    sender = np.full(len(used), firsts[source] + neuron)
                    weights.append(np.stack([sender, base + target + used, values[used]]))
        return tuple(np.concatenate(weights, axis=1))


def sum_rows(spikes, matrix):
    """The product of spikes and a matrix, added in the order of the matrix's rows.

    Parameters
    ----------
    spikes : (..., n) uint8 array
        0 or 1.
    matrix : (n, n_outputs) float64 array

    Returns
    -------
    (..., n_outputs) float64 array
    """
    n, n_outputs = matrix.shape
    rows = np.zeros((spikes.size // max(n, 1), _pad_to_8(n)), np.uint8)
    rows[:, :n] = spikes.reshape(len(rows), n)
    sums = np.zeros((len(rows), n_outputs))
    compiled.sum_rows(rows.view(np.uint64), np.ascontiguousarray(matrix), sums)
    return sums.reshape(*spikes.shape[:-1], n_outputs)


def _pad_to_8(n):
    """The next multiple of 8, but not 0."""
    return max(8, -(-n // 8) * 8)
