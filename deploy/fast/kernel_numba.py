"""The kernel with Numba: event-driven, one stream after the other, all its state in the cache.

What makes it fast:

- The targets of a spike are neighbours, so its weights are added as vectors: a spike is a few
  runs (place in a pool of weights, first target, length).  Lengths are padded with zero weights to
  whole blocks of `LANES`, and equal runs, of which a convolution has many, share their place in
  the pool, so that the pool stays in the fastest cache.
- Weights are int16 where no sum of weights can leave int16 (checked), else int32.
- A stream goes through all steps of a call before the next one starts.
- The update of the compartments is three loops of few arrays each: with more, the compiler gives
  up on proving that they don't overlap and stops using vector instructions.
- Numba makes int64 of int32 arithmetic; every intermediate is cast back, for twice the lanes.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import numba
import numpy as np
from numba import int32, uint64

from .arrays import Q_BITS, U_BITS, Network, State, Steps

LANES = 32  # weights in a block: one vector of 512 bits in int16
MAX_GAP = 64  # zeros that are cheaper to add than a new run
WORD = 8  # spikes, one byte each, looked at together

_Q = np.int32(31 - Q_BITS)
_U = np.int32(31 - U_BITS)


class Wiring(NamedTuple):
    """The weights as the kernel adds them.

    Attributes
    ----------
    pool : int16 or int32 array
        Weights of all runs, in blocks of `LANES`.
    first : (n_sources + 1,) int32 array
        The first run of each source of spikes.
    place, target, length : (n_runs,) int32 array
        Where in the pool a run starts, which compartment it starts at, how long it is.
    """

    pool: np.ndarray
    first: np.ndarray
    place: np.ndarray
    target: np.ndarray
    length: np.ndarray


def wiring(network: Network) -> Wiring:
    """Cut the rows of the weight matrix into runs and share the equal ones."""
    weights = network.weights
    dtype = network.weight_type
    pool, places, size = [], {}, 0
    first, place, target, length = [0], [], [], []
    for row in range(weights.shape[0]):
        part = slice(weights.indptr[row], weights.indptr[row + 1])
        columns, values = weights.indices[part], weights.data[part]
        for run in _runs(columns):
            start = columns[run.start]
            n_blocks = -(-(columns[run.stop - 1] + 1 - start) // LANES)
            padded = np.zeros(n_blocks * LANES, dtype)
            padded[columns[run] - start] = values[run]
            key = padded.tobytes()
            if key not in places:
                places[key] = size
                pool.append(padded)
                size += len(padded)
            place.append(places[key])
            target.append(start)
            length.append(len(padded))
        first.append(len(place))
    return Wiring(
        np.concatenate(pool) if pool else np.zeros(LANES, dtype),
        *(np.array(part, np.int32) for part in (first, place, target, length)),
    )


def _runs(columns):
    """Slices of sorted column numbers that leave no gap above `MAX_GAP`."""
    if len(columns) == 0:
        return []
    cuts = np.flatnonzero(np.diff(columns) > MAX_GAP) + 1
    edges = [0, *cuts.tolist(), len(columns)]
    return [slice(a, b) for a, b in zip(edges, edges[1:])]


class Kernel:
    """Advances the chip's part of a network.

    Parameters
    ----------
    network : Network
    decoders : (n, n_outputs) float64 array
    """

    bytes_per_spike = 1
    """Memory that a call takes for each compartment, stream and step, about."""

    def __init__(self, network: Network, decoders):
        self._network = network
        self._wiring = wiring(network)
        self._can_overflow = network.can_overflow
        self._decoders = np.ascontiguousarray(decoders, dtype=np.float64)
        decoding = np.flatnonzero(np.any(decoders != 0, axis=1))
        self._decoding = (decoding[0], decoding[-1] + 1) if len(decoding) else (0, 0)
        self._n_words = -(-network.n // WORD)
        self._n_input_words = -(-network.n_inputs // WORD)

    def advance(self, state: State, inputs) -> Steps:
        """Advance several streams by some steps.

        Parameters
        ----------
        state : State
            Replaced by the state after the last step.
        inputs : (n_streams, n_steps, n_inputs) uint8 array
            1 where a neuron on the host spikes; acts on the chip in the step after.

        Returns
        -------
        Steps
        """
        network = self._network
        n_streams, n_steps, n_inputs = inputs.shape
        # Row 0 holds the spikes in flight, and rows are padded to whole words.
        arriving = np.zeros((n_streams, n_steps + 1, self._n_input_words * WORD), np.uint8)
        arriving[:, 0, :n_inputs] = state.inputs
        arriving[:, 1:, :n_inputs] = inputs
        spikes = np.zeros((n_streams, n_steps + 1, self._n_words * WORD), np.uint8)
        spikes[:, 0, : network.n] = state.spikes
        decoded = np.zeros((n_streams, n_steps, self._decoders.shape[1]))
        counts = np.zeros((n_streams, network.n), np.int32)
        overflows = np.zeros((len(network.layers), 3), np.int64)
        advance(
            self._wiring,
            network.segments,
            self._can_overflow,
            network.bias,
            network.threshold,
            self._decoders,
            self._decoding,
            arriving.view(np.uint64),
            state.current,
            state.voltage,
            state.refractory,
            spikes,
            spikes.view(np.uint64),
            decoded,
            counts,
            overflows,
        )
        state.inputs = arriving[:, -1, :n_inputs].copy()
        state.spikes = spikes[:, -1, : network.n].copy()
        return Steps(spikes[:, 1:, : network.n], decoded, counts, overflows)


def _jit(**options):
    """`numba.njit`, cached on disk where the source is a file in a folder that can be written."""

    def decorate(function):
        try:
            return numba.njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # inside a zipapp Numba finds no place for its cache
            return numba.njit(nogil=True, **options)(function)

    return decorate


@_jit()
def _collect(words, in_use, events):
    """List the positions of the bytes that are 1; returns how many.

    Most words are 0; listing the others first, without a branch, leaves little to mispredict.
    """
    n_in_use = 0
    for w in range(len(words)):
        in_use[n_in_use] = w
        n_in_use += words[w] != 0
    n = 0
    for j in range(n_in_use):
        w = in_use[j]
        word = words[w]
        while word:
            lowest = word & (~word + uint64(1))
            # A multiplication by 2**(8 k) brings byte 7 - k of the constant, which is k, on top.
            events[n] = int32(8 * w) + int32((lowest * uint64(0x0001020304050607)) >> uint64(56))
            n += 1
            word ^= lowest
    return n


@_jit()
def _deliver(wiring, first_source, events, n_events, total):
    """Add the weights of each spike to the totals of its targets."""
    # Unsigned indices spare the check for negative ones, and with it the vectors are kept.
    for e in range(n_events):
        source = first_source + events[e]
        for run in range(wiring.first[source], wiring.first[source + 1]):
            to, place = uint64(wiring.target[run]), uint64(wiring.place[run])
            for i in range(uint64(wiring.length[run])):
                total[to + i] += wiring.pool[place + i]


@_jit(inline="always")
def _decay(x, keep):
    """sign(x) * floor(|x| * keep / 4096), without leaving 32 bits.

    x is 4096 times a high part (rounded down) plus a low part from 0 to 4095; adding 4095 to a
    negative product makes its rounding down a rounding towards zero.
    """
    high = int32(int32(x >> int32(12)) * keep)
    low = int32(int32(x & int32(4095)) * keep)
    return int32(high + int32(int32(low + int32(int32(x >> int32(31)) & int32(4095))) >> int32(12)))


@_jit(inline="always")
def _wrap(x, spare):
    """Two's complement with ``spare`` bits less than 32."""
    return int32(int32(x << spare) >> spare)


@_jit()
def _currents(keep, shift, total, current):
    """u <- decay(u) + q, where nothing can overflow; clears the totals."""
    for i in range(len(current)):
        current[i] = int32(_decay(current[i], keep) + int32(int32(total[i]) << shift))
        total[i] = 0


@_jit()
def _wrapped_currents(keep, shift, total, current):
    """u <- wrap(decay(u) + wrap(q)); clears the totals; counts the overflows of q and of u."""
    over_q, over_u = int32(0), int32(0)
    for i in range(len(current)):
        q = int32(int32(total[i]) << shift)
        total[i] = 0
        arriving = _wrap(q, _Q)
        u = int32(_decay(current[i], keep) + arriving)
        wrapped = _wrap(u, _U)
        current[i] = wrapped
        over_q += int32(arriving != q)
        over_u += int32(wrapped != u)
    return over_q, over_u


@_jit()
def _voltages(keep, v_min, v_max, bias, current, voltage):
    """v <- clip(decay(v) + u + bias), where nothing can overflow."""
    for i in range(len(voltage)):
        v = int32(_decay(voltage[i], keep) + int32(current[i] + bias[i]))
        voltage[i] = min(max(v, v_min), v_max)


@_jit()
def _wrapped_voltages(keep, v_min, v_max, bias, current, voltage):
    """v <- clip(decay(v) + wrap(u + bias)); counts the overflows of the sum."""
    over = int32(0)
    for i in range(len(voltage)):
        u = int32(current[i] + bias[i])
        wrapped = _wrap(u, _U)
        v = int32(_decay(voltage[i], keep) + wrapped)
        voltage[i] = min(max(v, v_min), v_max)
        over += int32(wrapped != u)
    return over


@_jit()
def _fire(threshold, voltage, spikes):
    """Spikes of compartments without a refractory period."""
    for i in range(len(voltage)):
        fires = voltage[i] > threshold[i]
        spikes[i] = fires
        voltage[i] = int32(0) if fires else voltage[i]


@_jit()
def _fire_refractory(period, threshold, voltage, waiting, spikes):
    """Spikes of compartments that are held at 0 for some steps after each."""
    for i in range(len(voltage)):
        wait = waiting[i]
        v = int32(0) if wait > int32(0) else voltage[i]
        fires = v > threshold[i]
        spikes[i] = fires
        voltage[i] = int32(0) if fires else v
        wait = int32(wait - int32(1)) if wait > int32(0) else int32(0)
        waiting[i] = period if fires else wait


@_jit()
def advance(
    wiring,
    segments,
    can_overflow,
    bias,
    threshold,
    decoders,
    decoding,
    arriving,
    current,
    voltage,
    refractory,
    spikes,
    words,
    decoded,
    counts,
    overflows,
):
    """All streams through all steps; `Kernel.advance` says what the arrays are."""
    n_streams, n_steps = decoded.shape[0], decoded.shape[1]
    n_inputs = len(wiring.first) - 1 - len(bias)
    total = np.zeros(len(bias) + LANES, wiring.pool.dtype)
    events = np.empty(spikes.shape[2], np.int32)
    input_events = np.empty(8 * arriving.shape[2], np.int32)
    in_use = np.empty(max(arriving.shape[2], words.shape[2]), np.int32)
    for b in range(n_streams):
        u, v, waiting = current[b], voltage[b], refractory[b]
        n_events = _collect(words[b, 0], in_use, events)
        for t in range(n_steps):
            n_arriving = _collect(arriving[b, t], in_use, input_events)
            _deliver(wiring, 0, input_events, n_arriving, total)
            _deliver(wiring, n_inputs, events, n_events, total)
            row = spikes[b, t + 1]
            for s in range(len(segments.start)):
                layer, period = segments.layer[s], segments.refractory[s]
                part = slice(segments.start[s], segments.stop[s])
                keep_u, keep_v = segments.keep_u[s], segments.keep_v[s]
                v_min, v_max = segments.v_min[s], segments.v_max[s]
                q_part, u_part, v_part = total[part], u[part], v[part]
                if can_overflow[s]:
                    over_q, over_u = _wrapped_currents(keep_u, segments.shift[s], q_part, u_part)
                    over = _wrapped_voltages(keep_v, v_min, v_max, bias[part], u_part, v_part)
                    overflows[layer, 0] += over_q
                    overflows[layer, 1] += over_u
                    overflows[layer, 2] += over
                else:
                    _currents(keep_u, segments.shift[s], q_part, u_part)
                    _voltages(keep_v, v_min, v_max, bias[part], u_part, v_part)
                if period:
                    _fire_refractory(period, threshold[part], v_part, waiting[part], row[part])
                else:
                    _fire(threshold[part], v_part, row[part])
            n_events = _collect(words[b, t + 1], in_use, events)
            for e in range(n_events):
                counts[b, events[e]] += 1
                if decoding[0] <= events[e] < decoding[1]:
                    for k in range(decoders.shape[1]):
                        decoded[b, t, k] += decoders[events[e], k]


def is_compiled():
    """Whether the next call of the kernel finds it compiled, in memory or on disk."""
    if advance.signatures:
        return True
    try:
        source = os.path.getmtime(__file__)
        return any(
            entry.name.startswith("kernel_numba.advance-") and entry.stat().st_mtime >= source
            for entry in os.scandir(advance.stats.cache_path)
        )
    except OSError:  # inside a zipapp, or nothing was ever cached
        return False
