"""The Numba kernel: event-driven, one stream after the other, with its state in the cache.

Its speed has these reasons:

- The network is feed-forward, so that a segment of compartments runs through all steps of a call
  before the next segment starts: its state stays in the L1 cache, and the loop over steps uses
  array slices made before it, which avoids Numba's reference counting.
- The targets of a spike are neighbours, so its weights are added as vectors (`wiring`).
- Where nothing can overflow and no voltage is negative (`Network.is_plain`), a decay is one
  multiplication and nothing is wrapped or counted.
- The update of the compartments consists of three loops over few arrays each: with more arrays the
  compiler cannot prove that they do not overlap, and does not vectorise.  It does not vectorise
  ``min`` and ``max`` either, which are calls, nor indices that might be negative, nor Numba's
  promotion of int32 arithmetic to int64; hence the conditions, unsigned indices and casts.
"""

from __future__ import annotations

import sys

import numba
import numpy as np
from numba import int32, uint64
from numba.core import event

from .arrays import Q_BITS, U_BITS, Network, State, Steps
from .wiring import LANES, wiring

WORD = 8  # number of spikes, of one byte each, that are tested at once

_Q = np.int32(31 - Q_BITS)
_U = np.int32(31 - U_BITS)


class Kernel:
    """The Numba kernel for the chip's part of a network.

    Parameters
    ----------
    network : Network
    decoders : (n, n_outputs) float64 array
    """

    bytes_per_spike = 1
    """Approximate memory of a call per compartment, stream and step; the list of one stream's
    spikes takes up to 4 more per compartment and step."""

    def __init__(self, network: Network, decoders):
        self._network = network
        self._wiring = wiring(network)
        segments = network.segments
        # Runs are padded and therefore reach beyond the end of the widest segment.
        self._n_totals = int((segments.stop - segments.start).max()) + LANES
        self._is_plain = network.is_plain
        self._decoders = np.ascontiguousarray(decoders, dtype=np.float64)

    def advance(self, state: State, inputs) -> Steps:
        """Advance several streams by some steps.

        Parameters
        ----------
        state : State
            Updated to the state after the last step.
        inputs : (n_streams, n_steps, n_inputs) uint8 array
            1 where a neuron on the host spikes; it acts on the chip in the next step.

        Returns
        -------
        Steps
        """
        network = self._network
        n_streams, n_steps, n_inputs = inputs.shape
        # Row 0 has the spikes of the previous step, and rows are padded to whole words.
        arriving = np.zeros((n_streams, n_steps + 1, -(-n_inputs // WORD) * WORD), np.uint8)
        arriving[:, 0, :n_inputs] = state.inputs
        arriving[:, 1:, :n_inputs] = inputs
        spikes = np.empty((n_streams, n_steps, network.n), np.uint8)
        decoded = np.zeros((n_streams, n_steps, self._decoders.shape[1]))
        counts = np.zeros((n_streams, network.n), np.int32)
        overflows = np.zeros((len(network.layers), 3), np.int64)
        advance(
            self._wiring,
            network.segments,
            self._is_plain,
            network.bias,
            network.threshold,
            self._decoders,
            arriving.view(np.uint64),
            state.current,
            state.voltage,
            state.refractory,
            state.spikes,
            spikes,
            decoded,
            counts,
            overflows,
            np.zeros(self._n_totals, self._wiring.pool.dtype),
        )
        state.inputs = arriving[:, -1, :n_inputs].copy()
        state.spikes = spikes[:, -1].copy()
        return Steps(spikes, decoded, counts, overflows)


def _jit(**options):
    """`numba.njit`, cached on disk if the source is a file in a writable folder."""

    def decorate(function):
        try:
            return numba.njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # in a zip archive there is no place for Numba's cache
            return numba.njit(nogil=True, **options)(function)

    return decorate


@_jit()
def _list(words, row, first_source, in_use, events, n):
    """Append the sources whose bytes are 1 in a row; returns the new length of the list.

    Most words are 0; listing the others first, without a branch, avoids branch mispredictions.
    """
    n, n_in_use = uint64(n), uint64(0)
    for w in range(uint64(words.shape[1])):
        in_use[n_in_use] = w
        n_in_use += uint64(words[row, w] != 0)
    for j in range(n_in_use):
        w = uint64(in_use[j])
        word = words[row, w]
        first = int32(first_source + int32(WORD * w))
        while word:
            lowest = word & (~word + uint64(1))
            # Multiplying by 2**(8 k) moves byte 7 - k of the constant, which is k, to the top.
            events[n] = first + int32((lowest * uint64(0x0001020304050607)) >> uint64(56))
            n += uint64(1)
            word ^= lowest
    return n


@_jit()
def _deliver(wiring, segment, events, begin, end, total):
    """Add the weights of some spikes to the totals of a segment's compartments."""
    segment = uint64(segment)
    for e in range(uint64(begin), uint64(end)):
        source = uint64(events[e])
        first, last = wiring.first[segment, source], wiring.first[segment, source + uint64(1)]
        for run in range(uint64(first), uint64(last)):
            to, place = uint64(wiring.target[run]), uint64(wiring.place[run])
            for i in range(uint64(wiring.length[run])):
                total[to + i] += wiring.pool[place + i]


@_jit(inline="always")
def _decay(x, keep):
    """sign(x) * floor(|x| * keep / 4096) in 32-bit arithmetic.

    x is 4096 times a high part (rounded down) plus a low part from 0 to 4095; adding 4095 to a
    negative product turns rounding down into rounding towards zero.
    """
    high = int32(int32(x >> int32(12)) * keep)
    low = int32(int32(x & int32(4095)) * keep)
    return int32(high + int32(int32(low + int32(int32(x >> int32(31)) & int32(4095))) >> int32(12)))


@_jit(inline="always")
def _wrap(x, spare):
    """Two's complement with ``spare`` bits less than 32."""
    return int32(int32(x << spare) >> spare)


@_jit()
def _plain_currents(lose, scale, total, current):
    """u <- decay(u) + q in a plain segment; clears the totals.

    decay(u) is u minus ``|u| * lose / 4096`` rounded away from 0, one multiplication.
    """
    for i in range(len(current)):
        u = current[i]
        lost = int32(int32(u * lose) + int32(int32(4095) & ~int32(u >> int32(31)))) >> int32(12)
        current[i] = int32(int32(u - lost) + int32(int32(total[i]) * scale))
        total[i] = 0


@_jit()
def _plain_voltages(lose, v_min, bias, current, voltage):
    """v <- max(decay(v) + u + bias, v_min) in a plain segment, where v is never below 0."""
    for i in range(len(voltage)):
        v = voltage[i]
        lost = int32(int32(v * lose) + int32(4095)) >> int32(12)
        v = int32(int32(v - lost) + int32(current[i] + bias[i]))
        voltage[i] = v if v > v_min else v_min


@_jit()
def _currents(keep, scale, total, current):
    """u <- wrap(decay(u) + wrap(q)); clears the totals; counts the overflows of q and of u."""
    over_q, over_u = int32(0), int32(0)
    for i in range(len(current)):
        q = int32(int32(total[i]) * scale)
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
    """v <- clip(decay(v) + wrap(u + bias)); counts the overflows of the sum."""
    over = int32(0)
    for i in range(len(voltage)):
        u = int32(current[i] + bias[i])
        wrapped = _wrap(u, _U)
        v = int32(_decay(voltage[i], keep) + wrapped)
        v = v if v > v_min else v_min
        voltage[i] = v if v < v_max else v_max
        over += int32(wrapped != u)
    return over


@_jit()
def _fire(threshold, voltage, spikes):
    """Spikes of compartments without a refractory period."""
    for i in range(len(voltage)):
        fires = voltage[i] > threshold[i]
        spikes[0, i] = fires
        voltage[i] = int32(0) if fires else voltage[i]


@_jit()
def _fire_once(threshold, voltage, spikes):
    """Spikes of compartments with a refractory period of one more step.

    ``spikes`` has the spikes of the previous step on entry, whose compartments are refractory.
    """
    for i in range(len(voltage)):
        v = int32(0) if spikes[0, i] else voltage[i]
        fires = v > threshold[i]
        spikes[0, i] = fires
        voltage[i] = int32(0) if fires else v


@_jit()
def _fire_refractory(period, threshold, voltage, waiting, spikes):
    """Spikes of compartments with a refractory period of several steps."""
    for i in range(len(voltage)):
        wait = waiting[i]
        v = int32(0) if wait > int32(0) else voltage[i]
        fires = v > threshold[i]
        spikes[0, i] = fires
        voltage[i] = int32(0) if fires else v
        wait = int32(wait - int32(1)) if wait > int32(0) else int32(0)
        waiting[i] = period if fires else wait


@_jit()
def _copy(values, into):
    """Copy values to the start of an array.

    NumPy's assignment makes Numba compile the error message for wrong shapes, which takes a third
    of its compilation time.
    """
    for i in range(len(values)):
        into[i] = values[i]


@_jit()
def advance(
    wiring,
    segments,
    is_plain,
    bias,
    threshold,
    decoders,
    arriving,
    current,
    voltage,
    refractory,
    in_flight,
    spikes,
    decoded,
    counts,
    overflows,
    total,
):
    """Run all streams through all steps; `Kernel.advance` describes the arrays.

    A segment runs through all steps before the next one starts, so that all its arriving spikes are
    known: lists of sources for each step, for the inputs and the previous segments.
    """
    n_streams, n_steps = decoded.shape[0], decoded.shape[1]
    n_inputs = wiring.first.shape[1] - 1 - len(bias)
    widest = 0
    for s in range(len(segments.start)):
        widest = max(widest, segments.stop[s] - segments.start[s])
    row = np.zeros((1, -(-widest // WORD) * WORD), np.uint8)
    in_use = np.empty(max(arriving.shape[2], row.shape[1] // WORD), np.int32)
    # Spikes of the inputs, then of each segment; those of row t are from ends[t] to ends[t + 1].
    events = np.empty((n_steps + 1) * wiring.first.shape[1], np.int32)
    ends = np.zeros((len(segments.start) + 1, n_steps + 2), np.int64)
    for b in range(n_streams):
        for t in range(n_steps + 1):
            ends[0, t + 1] = _list(arriving[b], uint64(t), int32(0), in_use, events, ends[0, t])
        for s in range(len(segments.start)):
            part = slice(segments.start[s], segments.stop[s])
            row[:] = 0
            _copy(in_flight[b, part], row[0])
            _advance_segment(
                wiring,
                segments,
                s,
                is_plain[s],
                bias[part],
                threshold[part],
                current[b, part],
                voltage[b, part],
                refractory[b, part],
                total,
                row,
                row.view(np.uint64),
                in_use,
                events,
                ends,
                spikes[b, :, part],
                overflows[segments.layer[s]],
            )
            for t in range(n_steps):
                for e in range(ends[s + 1, t + 1], ends[s + 1, t + 2]):
                    neuron = uint64(events[e] - n_inputs)
                    counts[b, neuron] += 1
                    for k in range(uint64(decoders.shape[1])):
                        decoded[b, t, k] += decoders[neuron, k]


@_jit()
def _advance_segment(
    wiring,
    segments,
    s,
    is_plain,
    bias,
    threshold,
    current,
    voltage,
    waiting,
    total,
    row,
    words,
    in_use,
    events,
    ends,
    spikes,
    overflows,
):
    """Run one segment of one stream through all steps; appends its spikes to the list.

    ``row`` and ``words`` share memory: the last step's spikes as bytes and as words of 8.
    """
    n_inputs = wiring.first.shape[1] - 1 - segments.stop[-1]
    first_source = int32(n_inputs + segments.start[s])
    period, scale = segments.refractory[s], int32(int32(1) << segments.shift[s])
    keep_u, keep_v = segments.keep_u[s], segments.keep_v[s]
    lose_u, lose_v = int32(4096 - keep_u), int32(4096 - keep_v)
    v_min, v_max = segments.v_min[s], segments.v_max[s]
    nearest, farthest = wiring.reach[s]
    ends[s + 1, 0] = ends[s, -1]
    ends[s + 1, 1] = _list(words, uint64(0), first_source, in_use, events, ends[s + 1, 0])
    for t in range(spikes.shape[0]):
        for source in range(nearest, farthest):
            _deliver(wiring, s, events, ends[source, t], ends[source, t + 1], total)
        if is_plain:
            _plain_currents(lose_u, scale, total, current)
            _plain_voltages(lose_v, v_min, bias, current, voltage)
        else:
            over_q, over_u = _currents(keep_u, scale, total, current)
            over = _voltages(keep_v, v_min, v_max, bias, current, voltage)
            overflows[0] += over_q
            overflows[1] += over_u
            overflows[2] += over
        if period == 1:
            _fire_once(threshold, voltage, row)
        elif period:
            _fire_refractory(period, threshold, voltage, waiting, row)
        else:
            _fire(threshold, voltage, row)
        end = ends[s + 1, t + 1]
        ends[s + 1, t + 2] = _list(words, uint64(0), first_source, in_use, events, end)
        for i in range(uint64(spikes.shape[1])):
            spikes[t, i] = row[0, i]
    if period == 1:
        _copy(row[0, : len(waiting)], waiting)


class _Announcer(event.Listener):
    """Prints a message when `advance` is compiled, once per weight type, unless it is cached."""

    def on_start(self, event):
        if event.data["dispatcher"] is advance:
            print("fast: compiling; this takes about five seconds", file=sys.stderr, flush=True)

    def on_end(self, event):
        pass


event.register("numba:compile", _Announcer())
