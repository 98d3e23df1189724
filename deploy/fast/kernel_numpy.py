"""The kernel in NumPy and SciPy alone: all streams together, one step after the other.

The same integers, and the same decoded sums to the last bit, as `kernel_numba`, for hosts without
Numba.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from .arrays import Q_BITS, U_BITS, Network, State, Steps


class Kernel:
    """Advances the chip's part of a network.

    Parameters
    ----------
    network : Network
    decoders : (n, n_outputs) float64 array
    """

    def __init__(self, network: Network, decoders):
        self._network = network
        self._decoders = np.asarray(decoders, np.float64)
        segments = network.segments
        lengths = segments.stop - segments.start
        per_compartment = {
            name: np.repeat(getattr(segments, name), lengths)
            for name in ("keep_u", "keep_v", "v_min", "v_max", "refractory", "shift", "layer")
        }
        self._of = per_compartment
        self._can_overflow = bool(network.can_overflow.any())
        self._signed = bool((segments.v_min < 0).any())
        self._waits = bool((segments.refractory > 0).any())
        self._blocks = _blocks(network)

    def advance(self, state: State, inputs) -> Steps:
        """Advance several streams by some steps; see `kernel_numba.Kernel.advance`."""
        network = self._network
        n_streams, n_steps, _ = inputs.shape
        overflows = np.zeros((len(network.layers), 3), np.int64)
        spikes = np.empty((n_streams, n_steps, network.n), np.uint8)
        counts = np.zeros((n_streams, network.n), np.int32)
        total = np.empty((n_streams, network.n), np.int32)
        rows = [
            scipy.sparse.csr_matrix((n_streams, len(weights)), dtype=np.int32)
            for _, _, _, weights in self._blocks
        ]
        for step in range(n_steps):
            self._gather(state, rows, total)
            self._update(state, total, overflows)
            spikes[:, step] = state.spikes
            counts += state.spikes
            state.inputs = inputs[:, step]
        state.inputs = state.inputs.copy()
        return Steps(spikes, self._decode(spikes), counts, overflows)

    def _gather(self, state, rows, total):
        """Sum the weights of the spikes in flight."""
        total[:] = 0
        for spikes, (of_inputs, sources, targets, weights) in zip(rows, self._blocks):
            arriving = (state.inputs if of_inputs else state.spikes)[:, sources]
            total[:, targets] += _fill(spikes, arriving) @ weights
        total <<= self._of["shift"]

    def _update(self, state, q, overflows):
        of, u, v = self._of, state.current, state.voltage
        if self._can_overflow:
            self._wrap(q, Q_BITS, overflows[:, 0])
        _decay(u, of["keep_u"], signed=True)
        u += q
        if self._can_overflow:
            self._wrap(u, U_BITS, overflows[:, 1])
        np.add(u, self._network.bias, out=q)
        if self._can_overflow:
            self._wrap(q, U_BITS, overflows[:, 2])
        _decay(v, of["keep_v"], signed=self._signed)
        v += q
        np.maximum(v, of["v_min"], out=v)
        np.minimum(v, of["v_max"], out=v)
        waiting = state.refractory
        if self._waits:
            np.copyto(v, 0, where=waiting > 0)
        fires = v > self._network.threshold
        np.copyto(v, 0, where=fires)
        if self._waits:
            waiting -= waiting > 0
            np.copyto(waiting, of["refractory"], where=fires)
        state.spikes = fires.view(np.uint8)

    def _wrap(self, x, bits, overflows):
        """Two's complement with a sign, in place; adds up the overflows of each layer."""
        if x.max() < 2**bits and x.min() >= -(2**bits):
            return
        spare = 31 - bits
        wrapped = (x << spare) >> spare
        over = np.count_nonzero(wrapped != x, axis=0)
        np.add.at(overflows, self._of["layer"], over)
        x[:] = wrapped

    def _decode(self, spikes):
        # SciPy adds the decoders of a row's spikes in their order, whatever the other rows are.
        flat = spikes.reshape(-1, spikes.shape[2])
        rows = _fill(scipy.sparse.csr_matrix(flat.shape, dtype=np.float64), flat)
        return (rows @ self._decoders).reshape(*spikes.shape[:2], -1)


def _blocks(network):
    """The weights as dense blocks, one a layer and kind of source, cut to the sources in use.

    Yields (of inputs or of compartments, sources, targets, int32 weights).
    """
    blocks = []
    layer = np.repeat(network.segments.layer, network.segments.stop - network.segments.start)
    for of_inputs, rows in (
        (True, network.weights[: network.n_inputs]),
        (False, network.weights[network.n_inputs :]),
    ):
        columns = rows.tocsc()
        for index in range(len(network.layers)):
            mine = np.flatnonzero(layer == index)
            targets = slice(mine[0], mine[-1] + 1)
            part = columns[:, targets].tocsr()
            used = np.flatnonzero(np.diff(part.indptr))
            if len(used):
                sources = slice(used[0], used[-1] + 1)
                blocks.append((of_inputs, sources, targets, part[sources].toarray()))
    return blocks


def _fill(rows, spikes):
    """Put spikes of 0 and 1 into a sparse matrix of their shape, whatever it held."""
    n_rows, n = spikes.shape
    places = np.flatnonzero(np.ascontiguousarray(spikes).view(bool).ravel())
    # Set one by one: a constructor that takes them spends longer on checks than a product takes.
    rows.data = np.ones(len(places), rows.dtype)
    rows.indices = (places % n).astype(np.int32)
    rows.indptr = np.searchsorted(places, np.arange(n_rows + 1) * n).astype(np.int32)
    return rows


def _decay(x, keep, signed):
    """sign(x) * floor(|x| * keep / 4096) in place and within int32; see `kernel_numba._decay`."""
    low = x & 4095
    low *= keep
    if signed:
        towards_zero = x >> 31
        towards_zero &= 4095
        low += towards_zero
    low >>= 12
    x >>= 12
    x *= keep
    x += low
