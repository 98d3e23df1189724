"""The steps of the emulator, compiled by Numba: one function for integers, one for float32.

Every function that a step of NengoLoihi's emulator calls has a counterpart here with bit-identical
results: sums of float32 are taken in the emulator's order, integers wrap around like NumPy's, and
random numbers are those that its ``RandomState`` would draw.  `layout` makes the arrays.

All compiled functions are in this file, because Numba's cache on disk only notices changes of the
file of the called function.

Reasons for the form of the code, each measured:

- The loops over compartments read few arrays each, and values that are equal in a segment are
  scalars.  With more arrays, LLVM cannot prove that they do not overlap, and does not use vector
  instructions.
- Loops have a first and a last index instead of slices of arrays: a slice counts references, which
  costs more than the update of a small block.
- Numba promotes every operation on int32 to int64; the casts undo this, so that a vector has eight
  values instead of four.  Indices are unsigned, because a negative index would need a test.
- Arrays are passed one by one: passing a tuple takes twice as long, which is most of the time of a
  call for a single step.
"""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path

import numba
import numpy as np
from numba import float32, int16, int32, int64, uint8, uint32, uint64
from numba.core import event

CURRENT, VOLTAGE, INPUT, BIAS, THRESHOLD = range(5)  # rows of `cells`
WAITING, COUNT = range(2)  # rows of `counters`
START, STOP, REFRACTORY = range(3)  # columns of `segments`
KEEP_U, KEEP_V, SCALE_U, SCALE_V, V_MIN, V_MAX = range(6)  # columns of `constants`
SHIFT, WIDE, FIRST_SEGMENT, LAST_SEGMENT = range(2, 6)  # columns of `blocks`, after START and STOP
SOURCE, OFFSET, BLOCK, IS_WIDE, LARGEST, RULE = range(6)  # columns of `routes`
ROW, TARGET, AXON = range(3)  # rows of `entries`

SPENT, LOADED = range(2)  # columns of `blocks_now`: bound of the sums, whether there is input

# Columns of `rules`: a synapse's traces, its errors and its weights; when it learns, and how much.
TRACE0, TRACE1, ERROR0, ERROR1, WEIGHT0, TRACE_EPOCH, LEARN_EPOCH = range(7)
RATE, PRODUCT_SHIFT, OLD_SHIFT, FRACTION_BITS, NEW_SHIFT, LIMIT, IS_DOUBLE = range(7, 14)
DECAY, MAGNITUDE, REAL_RATE = range(3)  # columns of `rates`

# Kinds of warnings in the log.  The count of the last is a bit mask of the places of overflow.
LOST = np.int64(0)
TRACE = np.int64(1)
WEIGHTS = np.int64(2)
OVERFLOWS = np.int64(3)
UNSUPPORTED = -1  # returned instead of a number of steps; no step was run

MAX_NARROW_SUM = 32767  # the largest sum of 16 bits

# Bits of an int32 that the synaptic accumulator lacks (21 bits and a sign), and the current (23).
_SPARE_INPUT_BITS = np.int32(10)
_SPARE_CURRENT_BITS = np.int32(8)


def _copy_for_cache():
    """A copy of this file on disk, for which Numba can keep a cache; None if none can be written.

    Numba has no cache for a file in a zip archive, such as ``deploy.pyz``.  The copy is not
    executed: its path is the key of the cache, in a folder that the content of this file names.
    """
    content = __loader__.get_data(__file__)
    folder = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    name = hashlib.sha256(content).hexdigest()[:16]
    path = Path(os.path.expanduser(folder)) / "fastloihi" / name / "compiled.py"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not path.is_file() or path.read_bytes() != content:
            new = path.with_name(f"{path.name}.{os.getpid()}")
            new.write_bytes(content)
            os.replace(new, path)
    except OSError:
        return None
    return path


_COPY = None if os.path.exists(__file__) else _copy_for_cache()


def _jit(from_python=False, **options):
    """`numba.njit`, cached on disk if there is a folder for it.

    Only functions that are called from Python get a wrapper, which takes a sixth of the compilation
    time.
    """
    common = {
        "nogil": True,
        "error_model": "numpy",  # which does not test for divisions by zero
        "no_cpython_wrapper": not from_python,
        "no_cfunc_wrapper": True,
    }

    def decorate(function):
        if _COPY is not None:
            function.__code__ = function.__code__.replace(co_filename=str(_COPY))
        try:
            return numba.njit(cache=True, **common, **options)(function)
        except RuntimeError:  # there is no folder that Numba can write to
            return numba.njit(**common, **options)(function)

    return decorate


# --- Random numbers -------------------------------------------------------------------------------
#
# The Mersenne Twister MT19937 (Matsumoto and Nishimura, ACM TOMACS 8(1), 1998).  `state` is the
# memory of NumPy's generator: 624 words and the position of the next one.


@_jit()
def _twist(state):
    """The next 624 words."""
    # In three loops, so that each can be vectorised.
    for i in range(uint64(227)):
        state[i] = _twist_word(state[i], state[i + uint64(1)], state[i + uint64(397)])
    for i in range(uint64(227), uint64(623)):
        state[i] = _twist_word(state[i], state[i + uint64(1)], state[i - uint64(227)])
    state[623] = _twist_word(state[623], state[0], state[396])
    state[624] = uint32(0)


@_jit(inline="always")
def _twist_word(word, after, far):
    y = uint32((word & uint32(0x80000000)) | (after & uint32(0x7FFFFFFF)))
    odd = uint32(uint32(0) - uint32(y & uint32(1)))
    return uint32(far ^ uint32(uint32(y >> uint32(1)) ^ uint32(odd & uint32(0x9908B0DF))))


@_jit(inline="always")
def _temper(y):
    y = uint32(y ^ uint32(y >> uint32(11)))
    y = uint32(y ^ uint32(uint32(y << uint32(7)) & uint32(0x9D2C5680)))
    y = uint32(y ^ uint32(uint32(y << uint32(15)) & uint32(0xEFC60000)))
    return uint32(y ^ uint32(y >> uint32(18)))


@_jit()
def _draw(state, n, into):
    """The next n words of 32 bits."""
    done = uint64(0)
    while done < uint64(n):
        if state[624] == uint32(624):
            _twist(state)
        first = uint64(state[624])
        count = min(uint64(n) - done, uint64(624) - first)
        for i in range(count):
            into[done + i] = _temper(state[first + i])
        done += count
        state[624] = uint32(first + count)


@_jit(from_python=True)
def skip_words(state, n):
    """Skip n words of 32 bits."""
    remaining = uint64(n)
    while remaining:
        if state[624] == uint32(624):
            _twist(state)
        count = min(remaining, uint64(624) - uint64(state[624]))
        state[624] += uint32(count)
        remaining -= count


@_jit(from_python=True)
def skip_noise(state, n):
    """Skip n numbers of ``RandomState.randint(-127, 128)``: bytes, where 255 is rejected."""
    remaining = uint64(n)
    while remaining:
        if state[624] == uint32(624):
            _twist(state)
        first = uint64(state[624])
        count = min(remaining, uint64(624) - first)
        rejected = uint32(0)
        for i in range(count):
            rejected += uint32(uint32(_temper(state[first + i]) & uint32(255)) == uint32(255))
        state[624] += uint32(count)
        remaining -= count - uint64(rejected)


@_jit()
def _draw_noise(state, into):
    """``RandomState.randint(-127, 128)``, as many as fit."""
    done = uint64(0)
    while done < uint64(len(into)):
        if state[624] == uint32(624):
            _twist(state)
        word = uint32(_temper(state[uint64(state[624])]) & uint32(255))
        state[624] += uint32(1)
        into[done] = int32(int32(word) - int32(127))
        done += uint64(word != uint32(255))


@_jit(inline="always")
def _draw_unit(high, low):
    """``RandomState.rand``, of two words."""
    a = float(int32(high >> uint32(5)))
    b = float(int32(low >> uint32(6)))
    return (a * 67108864.0 + b) / 9007199254740992.0


# --- From spikes to inputs ------------------------------------------------------------------------


@_jit()
def _list_spikes(words, blocks, events, ends, in_use):
    """List the compartments that spike, in order, and the end of each block in this list."""
    n_in_use = uint64(0)
    n = uint64(0)
    for w in range(uint64(len(words))):  # without a branch, which is faster
        in_use[n_in_use] = w
        n_in_use += uint64(words[w] != 0)
    for j in range(n_in_use):
        w = uint64(in_use[j])
        word = words[w]
        while word:
            lowest = word & (~word + uint64(1))
            # A multiplication by 2**(8 k) brings byte 7 - k of the constant, which is k, on top.
            byte = uint64(lowest * uint64(0x0001020304050607)) >> uint64(56)
            events[n] = int64(uint64(8) * w + byte)
            n += uint64(1)
            word ^= lowest
    e = uint64(0)
    for b in range(uint64(len(blocks))):
        while e < n and events[e] < blocks[b, STOP]:
            e += uint64(1)
        ends[b + uint64(1)] = e


@_jit()
def _add_weights(spikes, first, last, offset, entries, first_run, runs, pool, sums):
    """Add rows of weights, narrow ones to sums of 16 bits or wide ones to the input."""
    for e in range(uint64(first), uint64(last)):
        entry = uint64(spikes[e] + offset)
        row = entries[ROW, entry]
        if row < 0:
            continue
        base = entries[TARGET, entry]
        for r in range(uint64(first_run[row]), uint64(first_run[row + 1])):
            target = uint64(base + runs[r, 0])
            first_weight = uint64(runs[r, 1])
            for i in range(uint64(runs[r, 2])):
                sums[target + i] += pool[first_weight + i]


@_jit()
def _move_sums(block, block_now, sums, total):
    """Move the sums of 16 bits of a block to its input."""
    shift = int32(block[SHIFT])
    loaded = block_now[LOADED] != 0
    for i in range(uint64(block[START]), uint64(block[STOP])):
        value = int32(int32(sums[i]) << shift)
        total[i] = int32(total[i] + value) if loaded else value
        sums[i] = int16(0)
    block_now[LOADED] = 1
    block_now[SPENT] = 0


@_jit()
def _mark_axons(spikes, first, last, offset, entries, pending):
    """Mark the axons on which spikes arrive; return how many were marked already."""
    lost = 0
    for e in range(uint64(first), uint64(last)):
        axon = entries[AXON, uint64(spikes[e] + offset)]
        if axon >= 0:
            lost += int64(pending[axon])
            pending[axon] = uint8(1)
    return lost


@_jit()
def _are_spikes_of_inputs(arriving, arriving_ends, input_sizes):
    """True if every spike of an input belongs to one of its neurons."""
    n_inputs = len(input_sizes)
    for position in range(len(arriving_ends) - 1):
        size = input_sizes[position % n_inputs]
        for e in range(arriving_ends[position], arriving_ends[position + 1]):
            if arriving[e] < 0 or arriving[e] >= size:
                return False
    return True


# --- Integers -------------------------------------------------------------------------------------


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
    """Two's complement with ``spare`` bits fewer than 32."""
    return int32(int32(x << spare) >> spare)


@_jit()
def _update_currents(first, last, keep, shift, loaded, sums, total, current):
    """u <- wrap(decay(u) + wrap(q)); return the numbers of overflows of q and u."""
    over_q = int32(0)
    over_u = int32(0)
    if loaded:
        for i in range(first, last):
            total[i] = int32(total[i] + int32(int32(sums[i]) << shift))
            sums[i] = int16(0)
    else:
        for i in range(first, last):
            total[i] = int32(int32(sums[i]) << shift)
            sums[i] = int16(0)
    for i in range(first, last):
        q = total[i]
        arriving = _wrap(q, _SPARE_INPUT_BITS)
        u = int32(_decay(current[i], keep) + arriving)
        wrapped = _wrap(u, _SPARE_CURRENT_BITS)
        total[i] = arriving
        current[i] = wrapped
        over_q += int32(arriving != q)
        over_u += int32(wrapped != u)
    return over_q, over_u


@_jit()
def _update_voltages(first, last, keep, v_min, v_max, bias, current, voltage):
    """v <- clip(decay(v) + wrap(u + bias)); return the number of overflows of the sum."""
    over = int32(0)
    for i in range(first, last):
        u = int32(current[i] + bias[i])
        wrapped = _wrap(u, _SPARE_CURRENT_BITS)
        v = int32(_decay(voltage[i], keep) + wrapped)
        v = v if v > v_min else v_min
        voltage[i] = v if v < v_max else v_max
        over += int32(wrapped != u)
    return over


@_jit()
def _fire(first, last, threshold, voltage, spiked):
    """Spikes of compartments without a refractory period."""
    for i in range(first, last):
        fires = voltage[i] > threshold[i]
        spiked[i] = fires
        voltage[i] = 0 if fires else voltage[i]


@_jit()
def _fire_and_wait(first, last, period, threshold, voltage, waiting, spiked):
    """Spikes of compartments with a refractory period, in which the voltage stays at 0."""
    for i in range(first, last):
        wait = waiting[i]
        v = 0 if wait > int32(0) else voltage[i]
        fires = v > threshold[i]
        spiked[i] = fires
        voltage[i] = 0 if fires else v
        wait = period if fires else wait
        waiting[i] = int32(wait - int32(1)) if wait > int32(0) else int32(0)


@_jit()
def _log(log, kind, count):
    """Append a warning and its number of occurrences to the log."""
    if count:
        n = log[0, 0] + 1
        log[n, 0] = kind
        log[n, 1] = count
        log[0, 0] = n


@_jit()
def _round_traces(rule, rate, traces, pending, drawn):
    """Advance the traces of a synapse, rounded at random; return whether one was clipped."""
    first = uint64(rule[TRACE0])
    last = uint64(rule[TRACE1])
    decay = rate[DECAY]
    magnitude = rate[MAGNITUDE]
    clipped = int32(0)
    for i in range(last - first):
        x = decay * traces[first + i]
        x = x + magnitude if pending[first + i] else x
        size = abs(x)
        integer = int32(size)
        above = size - integer > _draw_unit(drawn[uint64(2) * i], drawn[uint64(2) * i + uint64(1)])
        y = int32(integer + int32(above))
        clipped |= int32(y > int32(127))
        y = int32(127) if y > int32(127) else y
        traces[first + i] = y if x > 0 else int32(-y)
        pending[first + i] = uint8(0)
    return clipped


@_jit()
def _learn(rule, traces, errors, wide, drawn, scratch):
    """PES in integers, rounded at random; return the number of clipped rows."""
    half = uint64(rule[ERROR1] - rule[ERROR0])
    width = uint64(2) * half
    error0 = uint64(rule[ERROR0])
    n_rows = uint64(rule[TRACE1] - rule[TRACE0])
    trace0 = uint64(rule[TRACE0])
    rate = int32(rule[RATE])
    weight0 = uint64(rule[WEIGHT0])
    for r in range(n_rows):
        trace = int32(traces[trace0 + r])
        for j in range(half):
            product = int32(trace * errors[error0 + j])
            scratch[r * width + j] = int32(int32(-product) * rate)
            scratch[r * width + half + j] = int32(product * rate)
    _shift(scratch, n_rows * width, rule[PRODUCT_SHIFT])
    shift = int32(rule[OLD_SHIFT])
    bits = uint32(rule[FRACTION_BITS])
    mask = int32((1 << rule[FRACTION_BITS]) - 1)
    draw_shift = uint32(32 - rule[FRACTION_BITS])
    limit = int32(rule[LIMIT])
    new_shift = int32(rule[NEW_SHIFT])
    clipped = int32(0)
    for i in range(n_rows * width):
        weight = wide[weight0 + i]
        weight = int32(weight << shift) if shift >= int32(0) else int32(weight >> int32(-shift))
        changed = int32(weight + scratch[i])
        negative = int32(changed >> int32(31))
        size = uint32(int32(int32(changed ^ negative) - negative))
        # The fraction exceeds the random number of 53 bits if it exceeds that number's first bits.
        above = int32(int32(size) & mask) > int32(drawn[uint64(2) * i] >> draw_shift)
        y = int32(int32(size >> bits) + int32(above))
        scratch[i] = y
        clipped |= int32(y > limit)
        y = limit if y > limit else y
        wide[weight0 + i] = int32(int32(int32(y ^ negative) - negative) << new_shift)
    if not clipped:
        return 0
    rows = 0
    for r in range(n_rows):
        is_clipped = False
        for j in range(width):
            is_clipped |= scratch[r * width + j] > limit
        rows += is_clipped
    return rows


@_jit()
def _shift(values, n, by):
    if by >= 0:
        for i in range(uint64(n)):
            values[i] = int32(values[i] << int32(by))
    else:
        for i in range(uint64(n)):
            values[i] = int32(values[i] >> int32(-by))


# --- float32 --------------------------------------------------------------------------------------


@_jit()
def _decay_and_add(first, last, keep, scale, add, x):
    for i in range(first, last):
        x[i] = float32(keep * x[i]) + float32(scale * add[i])


@_jit()
def _clip(first, last, low, high, x):
    """Clip as `numpy.clip` does, which keeps NaN."""
    for i in range(first, last):
        y = low if x[i] <= low else x[i]
        x[i] = high if y >= high else y


@_jit()
def _update_float_traces(rule, rate, traces, pending):
    decay = rate[DECAY]
    magnitude = rate[MAGNITUDE]
    for i in range(uint64(rule[TRACE0]), uint64(rule[TRACE1])):
        x = decay * traces[i]
        traces[i] = x + magnitude if pending[i] else x
        pending[i] = uint8(0)


@_jit()
def _learn_floats(rule, rate, traces, errors, wide):
    half = uint64(rule[ERROR1] - rule[ERROR0])
    error0 = uint64(rule[ERROR0])
    weight = uint64(rule[WEIGHT0])
    for t in range(uint64(rule[TRACE0]), uint64(rule[TRACE1])):
        for j in range(uint64(2) * half):
            error = -errors[error0 + j] if j < half else errors[error0 + j - half]
            change = float32(traces[t] * error)
            if rule[IS_DOUBLE]:
                wide[weight] = float32(float(wide[weight]) + rate[REAL_RATE] * change)
            else:
                wide[weight] += float32(float32(rate[REAL_RATE]) * change)
            weight += uint64(1)


# --- A step ---------------------------------------------------------------------------------------


@_jit()
def _record(recorded, s, current, voltage, spiked, currents, voltages, spikes):
    """Store a step's values of the probed compartments."""
    for r in range(len(recorded)):
        key = recorded[r, 0]
        start = uint64(recorded[r, 1])
        length = uint64(recorded[r, 2])
        column = uint64(recorded[r, 3])
        if key == 0:
            for i in range(length):
                currents[s, column + i] = current[start + i]
        elif key == 1:
            for i in range(length):
                voltages[s, column + i] = voltage[start + i]
        else:
            for i in range(length):
                spikes[s, column + i] = spiked[start + i]


@_jit()
def _copy(values, into):
    for i in range(uint64(len(into))):
        into[i] = values[i]


@_jit(from_python=True)
def advance_integers(  # noqa: C901, PLR0915 - one loop over time, on all arrays of a network
    cells, counters, spiked, words, before, segments, constants, blocks, routes, entries,
    first_run, runs, narrow, wide, sums, input_sizes, rules, rates, traces, pending, errors,
    noise_offset, noise_scale, noise_on_voltage, overflows, events, ends, in_use, blocks_now, lost,
    waits, drawn, scratch, noisy, state, recorded, is_noisy, draws,
    t0, n_steps, arriving, arriving_ends, currents, voltages, spikes, log, stop_at_warning,
):  # fmt: skip
    """Advance a discretised network.

    Returns
    -------
    int
        Number of steps: fewer than requested if the log of warnings is full, or if it has a warning
        that should be an error; `UNSUPPORTED`, without a step, if NengoLoihi's own code should run.
    """
    current = cells[CURRENT]
    voltage = cells[VOLTAGE]
    total = cells[INPUT]
    bias = cells[BIAS]
    threshold = cells[THRESHOLD]
    waiting = counters[WAITING]
    count = counters[COUNT]
    n = len(current)
    n_inputs = len(input_sizes)
    n_blocks = len(blocks)
    n_rules = len(rules)
    if not _are_spikes_of_inputs(arriving, arriving_ends, input_sizes):
        return UNSUPPORTED
    for i in range(uint64(n)):
        if current[i] == int32(-2147483648) or voltage[i] == int32(-2147483648):
            return UNSUPPORTED  # -2**31 has no positive counterpart
    for g in range(len(segments)):
        waits[g] = uint8(segments[g, REFRACTORY] > 1)
        for i in range(segments[g, START], segments[g, STOP]):
            waits[g] |= uint8(waiting[i] > 0)
    if not is_noisy:
        _copy(bias, noisy)
    _list_spikes(words, blocks, events, ends, in_use)
    for s in range(n_steps):
        if log[0, 0] and (stop_at_warning or log[0, 0] + 3 * n_rules + 2 > len(log)):
            return s
        if s == n_steps - 1:
            _copy(spiked, before)
        # Spikes arrive.
        for b in range(n_blocks):
            blocks_now[b, SPENT] = 0
            blocks_now[b, LOADED] = blocks[b, WIDE]
            if blocks[b, WIDE]:
                for i in range(uint64(blocks[b, START]), uint64(blocks[b, STOP])):
                    total[i] = int32(0)
        for k in range(n_rules):
            lost[k] = 0
        for r in range(len(routes)):
            source = routes[r, SOURCE]
            offset = routes[r, OFFSET]
            b = routes[r, BLOCK]
            if source < n_inputs:
                arrived = arriving
                position = s * n_inputs + source
                first = arriving_ends[position]
                last = arriving_ends[position + 1]
            else:
                arrived = events
                first = ends[source - n_inputs]
                last = ends[source - n_inputs + 1]
            if first == last:
                continue
            if routes[r, RULE] >= 0:
                lost[routes[r, RULE]] += _mark_axons(arrived, first, last, offset, entries, pending)
            if routes[r, IS_WIDE]:
                _add_weights(arrived, first, last, offset, entries, first_run, runs, wide, total)
                continue
            largest = routes[r, LARGEST]
            while first < last:
                rows = int64(uint64(MAX_NARROW_SUM - blocks_now[b, SPENT]) // uint64(largest))
                if rows == 0:
                    _move_sums(blocks[b], blocks_now[b], sums, total)
                    continue
                until = min(last, first + rows)
                _add_weights(arrived, first, until, offset, entries, first_run, runs, narrow, sums)
                blocks_now[b, SPENT] += (until - first) * largest
                first = until
        # Synapses learn.
        t = t0 + s + 1
        for k in range(n_rules):
            _log(log, LOST, lost[k])
            if t % rules[k, TRACE_EPOCH] == 0:
                _draw(state, 2 * (rules[k, TRACE1] - rules[k, TRACE0]), drawn)
                clipped = _round_traces(rules[k], rates[k], traces, pending, drawn)
                _log(log, TRACE, int64(clipped))
        for k in range(n_rules):
            if t % rules[k, LEARN_EPOCH] == 0:
                width = 2 * (rules[k, ERROR1] - rules[k, ERROR0])
                _draw(state, 2 * width * (rules[k, TRACE1] - rules[k, TRACE0]), drawn)
                _log(log, WEIGHTS, _learn(rules[k], traces, errors, wide, drawn, scratch))
        # Compartments are updated.
        if is_noisy:
            _draw_noise(state, noisy)
        elif draws:
            skip_noise(state, n)
        over_q = int32(0)
        over_u = int32(0)
        over_u2 = int32(0)
        for b in range(n_blocks):
            shift = int32(blocks[b, SHIFT])
            if is_noisy:
                _move_sums(blocks[b], blocks_now[b], sums, total)
                for i in range(uint64(blocks[b, START]), uint64(blocks[b, STOP])):
                    noise = int32((noisy[i] + noise_offset[i]) * noise_scale[i])
                    total[i] += int32(0) if noise_on_voltage[i] else noise
                    noisy[i] = int32(bias[i] + noise) if noise_on_voltage[i] else bias[i]
            loaded = blocks_now[b, LOADED] != 0
            for g in range(blocks[b, FIRST_SEGMENT], blocks[b, LAST_SEGMENT]):
                first = uint64(segments[g, START])
                last = uint64(segments[g, STOP])
                keep_u = constants[g, KEEP_U]
                keep_v = constants[g, KEEP_V]
                v_min = constants[g, V_MIN]
                v_max = constants[g, V_MAX]
                q, u = _update_currents(first, last, keep_u, shift, loaded, sums, total, current)
                u2 = _update_voltages(first, last, keep_v, v_min, v_max, noisy, current, voltage)
                over_q |= q
                over_u |= u
                over_u2 |= u2
                overflows[b, 0] += q
                overflows[b, 1] += u
                overflows[b, 2] += u2
                if waits[g]:
                    period = int32(segments[g, REFRACTORY])
                    _fire_and_wait(first, last, period, threshold, voltage, waiting, spiked)
                else:
                    _fire(first, last, threshold, voltage, spiked)
        over = int64(over_q != 0) + 2 * int64(over_u != 0) + 4 * int64(over_u2 != 0)
        _log(log, OVERFLOWS, over)
        _list_spikes(words, blocks, events, ends, in_use)
        for e in range(uint64(ends[n_blocks])):
            count[events[e]] += int32(1)
        _record(recorded, s, current, voltage, spiked, currents, voltages, spikes)
    return n_steps


@_jit(from_python=True)
def advance_floats(  # noqa: C901, PLR0915 - one loop over time, on all arrays of a network
    cells, counters, spiked, words, before, segments, constants, blocks, routes, entries,
    first_run, runs, narrow, wide, sums, input_sizes, rules, rates, traces, pending, errors,
    noise_offset, noise_scale, noise_on_voltage, overflows, events, ends, in_use, blocks_now, lost,
    waits, drawn, scratch, noisy, state, recorded, is_noisy, draws,
    t0, n_steps, arriving, arriving_ends, currents, voltages, spikes, log, stop_at_warning,
):  # fmt: skip
    """Advance a network that was not discretised; as `advance_integers`."""
    current = cells[CURRENT]
    voltage = cells[VOLTAGE]
    total = cells[INPUT]
    bias = cells[BIAS]
    threshold = cells[THRESHOLD]
    waiting = counters[WAITING]
    count = counters[COUNT]
    n = len(current)
    n_inputs = len(input_sizes)
    n_blocks = len(blocks)
    n_rules = len(rules)
    if not _are_spikes_of_inputs(arriving, arriving_ends, input_sizes):
        return UNSUPPORTED
    _list_spikes(words, blocks, events, ends, in_use)
    for s in range(n_steps):
        if log[0, 0] and (stop_at_warning or log[0, 0] + 3 * n_rules + 2 > len(log)):
            return s
        if s == n_steps - 1:
            _copy(spiked, before)
        for i in range(uint64(n)):
            total[i] = float32(0)
        for k in range(n_rules):
            lost[k] = 0
        for r in range(len(routes)):
            source = routes[r, SOURCE]
            offset = routes[r, OFFSET]
            if source < n_inputs:
                arrived = arriving
                position = s * n_inputs + source
                first = arriving_ends[position]
                last = arriving_ends[position + 1]
            else:
                arrived = events
                first = ends[source - n_inputs]
                last = ends[source - n_inputs + 1]
            if first == last:
                continue
            if routes[r, RULE] >= 0:
                lost[routes[r, RULE]] += _mark_axons(arrived, first, last, offset, entries, pending)
            _add_weights(arrived, first, last, offset, entries, first_run, runs, wide, total)
        t = t0 + s + 1
        for k in range(n_rules):
            _log(log, LOST, lost[k])
            if t % rules[k, TRACE_EPOCH] == 0:
                _update_float_traces(rules[k], rates[k], traces, pending)
        for k in range(n_rules):
            if t % rules[k, LEARN_EPOCH] == 0:
                _learn_floats(rules[k], rates[k], traces, errors, wide)
        if is_noisy:
            _draw(state, 2 * n, drawn)
            for i in range(uint64(n)):
                x = float32(-1.0 + 2.0 * _draw_unit(drawn[uint64(2) * i], drawn[uint64(2) * i + 1]))
                noisy[i] = float32(x + noise_offset[i]) * noise_scale[i]
                total[i] += float32(0) if noise_on_voltage[i] else noisy[i]
        for g in range(len(segments)):
            first = uint64(segments[g, START])
            last = uint64(segments[g, STOP])
            constant = constants[g]
            _decay_and_add(first, last, constant[KEEP_U], constant[SCALE_U], total, current)
            for i in range(first, last):
                noise = noisy[i] if is_noisy and noise_on_voltage[i] else float32(0)
                scratch[i] = float32(current[i] + bias[i]) + noise
            _decay_and_add(first, last, constant[KEEP_V], constant[SCALE_V], scratch, voltage)
            _clip(first, last, constant[V_MIN], constant[V_MAX], voltage)
            period = int32(segments[g, REFRACTORY])
            _fire_and_wait(first, last, period, threshold, voltage, waiting, spiked)
        _list_spikes(words, blocks, events, ends, in_use)
        for e in range(uint64(ends[n_blocks])):
            count[events[e]] += int32(1)
        _record(recorded, s, current, voltage, spiked, currents, voltages, spikes)
    return n_steps


# --- For several streams --------------------------------------------------------------------------


@_jit(from_python=True)
def list_inputs(words, edges, spikes, ends):
    """List the spikes of inputs in the form that `advance_integers` takes.

    ``words`` has a row of bytes for each step, eight in a word; ``edges`` are the first columns of
    the inputs and the end of the last one.
    """
    n = uint64(0)
    n_inputs = len(edges) - 1
    for s in range(len(words)):
        i = 0
        for w in range(uint64(words.shape[1])):
            word = words[s, w]
            while word:
                lowest = word & (~word + uint64(1))
                byte = uint64(lowest * uint64(0x0001020304050607)) >> uint64(56)
                column = int64(uint64(8) * w + byte)
                while column >= edges[i + 1]:
                    i += 1
                    ends[s * n_inputs + i] = n
                spikes[n] = column - edges[i]
                n += uint64(1)
                word ^= lowest
        while i < n_inputs:
            i += 1
            ends[s * n_inputs + i] = n


@_jit(from_python=True)
def sum_rows(words, matrix, sums):
    """Add to each row of ``sums`` the rows of the matrix of the bytes that are 1, in order."""
    for s in range(len(words)):
        for w in range(uint64(words.shape[1])):
            word = words[s, w]
            while word:
                lowest = word & (~word + uint64(1))
                byte = uint64(lowest * uint64(0x0001020304050607)) >> uint64(56)
                row = uint64(8) * w + byte
                for k in range(uint64(matrix.shape[1])):
                    sums[s, k] += matrix[row, k]
                word ^= lowest


def _has_cache(dispatcher):
    """True if Numba has a folder for the compiled code of a function."""
    return getattr(dispatcher._cache, "cache_path", None) is not None


class _Announcer(event.Listener):
    """Prints a message when one of the two functions is compiled, not when it is in the cache."""

    def on_start(self, event):
        dispatcher = event.data["dispatcher"]
        if dispatcher in (advance_integers, advance_floats):
            each = "" if _has_cache(dispatcher) else " at each start, since no cache can be written"
            print(
                f"fastloihi: compiling the emulator; this takes some five seconds{each}",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event):
        pass


event.register("numba:compile", _Announcer())
