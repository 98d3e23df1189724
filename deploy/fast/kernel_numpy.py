"""The kernel in NumPy and SciPy alone: one layer after the other, all streams and steps together.

The same integers, and the same decoded sums to the last bit, as `kernel_numba`, for hosts without
Numba.  A layer's input at all steps is known when the layers before it are done, so that only what
carries over from one step to the next is done step by step.
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

    bytes_per_spike = 12
    """Memory that a call takes for each compartment, stream and step, about."""

    def __init__(self, network: Network, decoders):
        self._network = network
        self._decoders = np.asarray(decoders, np.float64)
        self._layers = [_Layer(network, index) for index in range(len(network.layers))]

    def advance(self, state: State, inputs) -> Steps:
        """Advance several streams by some steps; see `kernel_numba.Kernel.advance`."""
        network = self._network
        n_streams, n_steps, _ = inputs.shape
        # Steps first, so that what is done step by step is in one piece.  Row 0 is in flight.
        arriving = np.concatenate([state.inputs[None], inputs.transpose(1, 0, 2)])
        spikes = np.empty((n_steps + 1, n_streams, network.n), np.uint8)
        spikes[0] = state.spikes
        overflows = np.zeros((len(network.layers), 3), np.int64)
        for layer, over in zip(self._layers, overflows):
            part = layer.compartments
            u, v, waiting = (
                np.ascontiguousarray(array[:, part])
                for array in (state.current, state.voltage, state.refractory)
            )
            total = layer.gather(arriving[:-1], spikes[:-1])
            layer.filter(total, u, over)
            layer.fire(total, v, waiting, spikes[1:, :, part])
            state.current[:, part] = u
            state.voltage[:, part] = v
            state.refractory[:, part] = waiting
        state.inputs, state.spikes = arriving[-1].copy(), spikes[-1].copy()
        by_stream = np.ascontiguousarray(spikes[1:].transpose(1, 0, 2))
        decoded, counts = self._decode(by_stream)
        return Steps(by_stream, decoded, counts, overflows)

    def _decode(self, spikes):
        # SciPy adds the decoders of a row's spikes in their order, whatever the other rows are.
        n_streams, n_steps, n = spikes.shape
        rows = _sparse(spikes.reshape(-1, n), np.float64)
        streams = np.repeat(np.arange(n_streams), np.diff(rows.indptr[::n_steps]))
        counts = np.bincount(streams * n + rows.indices, minlength=n_streams * n)
        decoded = (rows @ self._decoders).reshape(n_streams, n_steps, -1)
        return decoded, counts.reshape(n_streams, n).astype(np.int32)


class _Layer:
    """A layer's parameters and the steps of its update, on arrays (n_steps, n_streams, n)."""

    def __init__(self, network, index):
        self.compartments = network.slice_of(index)
        segments = network.segments
        mine = segments.layer == index
        lengths = (segments.stop - segments.start)[mine]
        for name in ("keep_u", "keep_v", "v_min", "v_max", "refractory", "shift"):
            values = getattr(segments, name)[mine]
            # A number where it is the same for all is quicker than an array.
            same = np.all(values == values[0])
            setattr(self, name, values[0] if same else np.repeat(values, lengths))
        self.bias = network.bias[self.compartments]
        self.threshold = network.threshold[self.compartments]
        self.can_overflow = bool(network.can_overflow[mine].any())
        columns = network.weights.tocsc()[:, self.compartments].tocsr()
        self.from_inputs = _in_use(columns[: network.n_inputs])
        self.from_chip = _in_use(columns[network.n_inputs :])

    def gather(self, arriving, spikes):
        """Sum of the weights of the spikes that arrive at each step, int32."""
        n_steps, n_streams, _ = arriving.shape
        n = self.compartments.stop - self.compartments.start
        total = np.zeros((n_steps, n_streams, n), np.int32)
        for source, (sources, weights) in ((arriving, self.from_inputs), (spikes, self.from_chip)):
            if len(weights):
                part = source[:, :, sources].reshape(n_steps * n_streams, -1)
                total += (_sparse(part, np.int32) @ weights).reshape(total.shape)
        total <<= self.shift
        return total

    def filter(self, total, u, overflows):
        """Replace the sums ``q`` by ``wrap(u + bias)``; ``u`` becomes the last current."""
        if self.can_overflow:
            overflows[0] += _wrap(total, Q_BITS)
        for q in total:
            _decay(u, self.keep_u, signed=True)
            u += q
            if self.can_overflow:
                overflows[1] += _wrap(u, U_BITS)
            q[:] = u
        total += self.bias
        if self.can_overflow:
            overflows[2] += _wrap(total, U_BITS)

    def fire(self, total, v, waiting, spikes):
        """Integrate ``total`` into the voltage ``v`` and write the spikes."""
        signed, waits = bool(np.any(self.v_min < 0)), bool(np.any(self.refractory))
        for u, out in zip(total, spikes):
            _decay(v, self.keep_v, signed)
            v += u
            np.maximum(v, self.v_min, out=v)
            np.minimum(v, self.v_max, out=v)
            if waits:
                np.copyto(v, 0, where=waiting > 0)
            fires = v > self.threshold
            np.copyto(v, 0, where=fires)
            if waits:
                waiting -= waiting > 0
                np.copyto(waiting, self.refractory, where=fires)
            out[:] = fires


def _in_use(weights):
    """The slice of the sources that reach a layer, and their weights as a dense array."""
    used = np.flatnonzero(np.diff(weights.indptr))
    sources = slice(int(used[0]), int(used[-1]) + 1) if len(used) else slice(0, 0)
    return sources, weights[sources].toarray()


def _sparse(spikes, dtype):
    """Spikes of 0 and 1, shape (rows, n), as a sparse matrix."""
    n_rows, n = spikes.shape
    places = np.flatnonzero(np.ascontiguousarray(spikes).view(bool).ravel())
    ends = np.searchsorted(places, np.arange(n_rows + 1) * n)
    columns = places - np.repeat(np.arange(n_rows) * n, np.diff(ends))
    return scipy.sparse.csr_matrix((np.ones(len(places), dtype), columns, ends), spikes.shape)


def _wrap(x, bits):
    """Two's complement with a sign, in place; returns how many numbers that changed."""
    if x.max() < 2**bits and x.min() >= -(2**bits):
        return 0
    spare = 31 - bits
    wrapped = (x << spare) >> spare
    over = np.count_nonzero(wrapped != x)
    x[:] = wrapped
    return over


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
