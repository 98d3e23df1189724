"""The NumPy and SciPy kernel: one layer after the other, all streams and steps together.

It computes the same integers and bit-identical decoded sums as `kernel_numba`, for hosts without
Numba.  The input of a layer at all steps is known once the previous layers are done, so that only
the state is computed step by step.

The integers are stored as float64, which represents them exactly; ``decay(x, r)``, which is
``trunc(x * r / 4096)``, then takes two operations: x has at most 31 bits and a sign, r 13 bits.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from .arrays import Q_BITS, U_BITS, Network, State, Steps


class Kernel:
    """The NumPy kernel for the chip's part of a network.

    Parameters
    ----------
    network : Network
    decoders : (n, n_outputs) float64 array
    """

    bytes_per_spike = 16
    """Approximate memory of a call per compartment, stream and step."""

    def __init__(self, network: Network, decoders):
        self._network = network
        self._decoders = np.asarray(decoders, np.float64)
        self._layers = [_LayerSteps(network, index) for index in range(len(network.layers))]

    def advance(self, state: State, inputs) -> Steps:
        """Advance several streams by some steps; see `kernel_numba.Kernel.advance`."""
        network = self._network
        n_streams, n_steps, _ = inputs.shape
        # Steps are the first axis, so that each step is contiguous.  Row 0 is the previous step.
        arriving = np.concatenate([state.inputs[None], inputs.transpose(1, 0, 2)])
        spikes = np.empty((n_steps + 1, n_streams, network.n), np.uint8)
        spikes[0] = state.spikes
        overflows = np.zeros((len(network.layers), 3), np.int64)
        for layer, over in zip(self._layers, overflows):
            part = layer.compartments
            u, v = state.current[:, part].astype(float), state.voltage[:, part].astype(float)
            waiting = state.refractory[:, part].astype(layer.refractory.dtype)
            totals = layer.gather(arriving[:-1], spikes[:-1])
            layer.steps(totals, u, v, waiting, spikes[1:, :, part].view(bool), over)
            state.current[:, part], state.voltage[:, part] = u, v
            state.refractory[:, part] = waiting
        state.inputs, state.spikes = arriving[-1].copy(), spikes[-1].copy()
        by_stream = np.ascontiguousarray(spikes[1:].transpose(1, 0, 2))
        decoded, counts = self._decode(by_stream)
        return Steps(by_stream, decoded, counts, overflows)

    def _decode(self, spikes):
        # SciPy adds the decoders of a row's spikes in their order, independently of other rows.
        n_streams, n_steps, n = spikes.shape
        rows = _sparse(spikes.reshape(-1, n), np.float64)
        streams = np.repeat(np.arange(n_streams), np.diff(rows.indptr[::n_steps]))
        counts = np.bincount(streams * n + rows.indices, minlength=n_streams * n)
        decoded = (rows @ self._decoders).reshape(n_streams, n_steps, -1)
        return decoded, counts.reshape(n_streams, n).astype(np.int32)


class _LayerSteps:
    """A layer's parameters and its update steps, on arrays (n_steps, n_streams, n)."""

    def __init__(self, network, index):
        self.compartments = network.slice_of(index)
        segments = network.segments
        mine = segments.layer == index
        lengths = (segments.stop - segments.start)[mine]

        def value(name, dtype=float):
            values = getattr(segments, name)[mine].astype(dtype)
            # Multiplying by a scalar is faster than by a row of equal values.
            return values[0] if np.all(values == values[0]) else np.repeat(values, lengths)

        self.keep_u, self.keep_v = value("keep_u") / 4096, value("keep_v") / 4096
        self.v_min, self.v_max = value("v_min"), value("v_max")
        longest = segments.refractory[mine].max()
        self.refractory = value("refractory", np.int8 if longest < 128 else np.int32)
        self.waits_once = bool(np.all(self.refractory == 1))
        self.scale = 2.0 ** value("shift")
        self.bias = network.bias[self.compartments].astype(float)
        self.threshold = network.threshold[self.compartments].astype(float)
        self.can_overflow = bool(network.can_overflow[mine].any())
        highest = self.threshold.max() + network.largest_inputs[mine].max()
        self.can_reach_v_max = self.can_overflow or bool(highest >= np.min(self.v_max))
        self.dtype = network.weight_type
        columns = network.weights.astype(self.dtype).tocsc()[:, self.compartments].tocsr()
        self.from_inputs = _in_use(columns[: network.n_inputs])
        self.from_chip = _in_use(columns[network.n_inputs :])

    def gather(self, arriving, spikes):
        """Sum of the weights of the spikes that arrive at each step."""
        shape = (*arriving.shape[:2], self.compartments.stop - self.compartments.start)
        total = np.zeros(shape, self.dtype)
        for source, (sources, weights) in ((arriving, self.from_inputs), (spikes, self.from_chip)):
            if len(weights):
                part = source[:, :, sources].reshape(shape[0] * shape[1], -1)
                total += (_sparse(part, self.dtype) @ weights).reshape(shape)
        return total

    def steps(self, totals, u, v, waiting, spikes, overflows):
        """Advance ``u``, ``v`` and ``waiting`` by the weighted sums; write the spikes."""

        def full(values):
            # Operations on two full arrays are faster than with a broadcast row or a scalar.
            return np.broadcast_to(values, u.shape).copy()

        bias, threshold, v_min = full(self.bias), full(self.threshold), full(self.v_min)
        q, fires = np.empty_like(u), waiting > 0
        for total, spike in zip(totals, spikes):
            np.multiply(total, self.scale, out=q)
            if self.can_overflow:
                overflows[0] += _wrap(q, Q_BITS)
            _decay(u, self.keep_u)
            u += q
            if self.can_overflow:
                overflows[1] += _wrap(u, U_BITS)
            np.add(u, bias, out=q)
            if self.can_overflow:
                overflows[2] += _wrap(q, U_BITS)
            _decay(v, self.keep_v)
            v += q
            np.maximum(v, v_min, out=v)
            if self.can_reach_v_max:
                np.minimum(v, self.v_max, out=v)
            if self.waits_once:
                # Refractory are the neurons that spiked last: this line also resets them.
                np.putmask(v, fires, 0)
                np.greater(v, threshold, out=fires)
            else:
                resting = waiting > 0
                np.putmask(v, resting, 0)
                np.greater(v, threshold, out=fires)
                np.putmask(v, fires, 0)
                waiting -= resting
                np.putmask(waiting, fires, self.refractory)
            spike[:] = fires
        if self.waits_once:
            np.putmask(v, fires, 0)
            waiting[:] = fires


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
    """Two's complement with a sign, in place; returns the number of changed values."""
    if x.max() < 2**bits and x.min() >= -(2**bits):
        return 0
    wrapped = (x + 2**bits) % 2 ** (bits + 1) - 2**bits
    over = np.count_nonzero(wrapped != x)
    x[:] = wrapped
    return over


def _decay(x, share):
    """x <- sign(x) * floor(|x| * share), exactly, for integers x and 4096 * share."""
    x *= share
    np.trunc(x, out=x)
