# ruff: noqa: E501  (a fault is a line)
"""Faults put into the fast emulator one at a time: which of them do its tests not notice?

    python -m faults          (all of them: about half an hour)
    python -m faults learn    (those whose name or file has the word)

Each fault replaces one piece of text in a copy of the project.  Exit status 1 if a fault survives
the tests.  This is a tool and not a test: pytest does not run it.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

import hypothesis  # noqa: F401  as all here, so that the children need not
import numba
import numpy as np
import pytest
import scipy.sparse  # noqa: F401

from deploy.network.loihi_import import nengo_loihi  # noqa: F401

ROOT = Path(__file__).resolve().parents[3]

PACKAGE = "fastloihi/src/fastloihi"
TESTS = "fastloihi/tests"
FIRST = ("test_hand_over", "test_life")  # as they are quick
COPIED = ("deploy", "models", "pipeline", "stmnist", "tests", "pyproject.toml")
PATIENCE = 120  # seconds of processor time, after which a loop is called endless; such a fault is caught too

NOISE_IS_DRAWN = """        if is_noisy:
            _sample(state, noisy)
        elif draws:
            skip_samples(state, n)
"""

KERNEL = [
    # Random numbers
    ("tempering shifts by one bit less", "uint32(y >> uint32(18))", "uint32(y >> uint32(17))"),
    ("the last word of a twist", "state[0], state[396])", "state[1], state[396])"),
    ("skipping forgets rejected numbers", "left -= now - uint64(rejected)", "left -= now"),
    ("skipping rejects another number", "== uint32(255))\n        state", "== uint32(254))\n        state"),
    ("samples are lower by one", "int32(int32(word) - int32(127))", "int32(int32(word) - int32(128))"),
    ("samples are never rejected", "done += uint64(word != uint32(255))", "done += uint64(1)"),
    ("doubles lose a bit", "low >> uint32(6)", "low >> uint32(7)"),
    ("skipping words moves too far", "state[624] += uint32(now)\n        left -= now\n", "state[624] += uint32(now)\n        left -= min(left, now + uint64(1))\n"),
    ("noise is drawn before traces", (NOISE_IS_DRAWN, ""), ("        # Synapses learn.\n", NOISE_IS_DRAWN)),
    ("the draws of two rules are interleaved", "_log(log, TRACE, int64(clipped))\n        for k in range(n_rules):\n", "_log(log, TRACE, int64(clipped))\n"),
    ("nothing is skipped where nothing is noisy", "            skip_samples(state, n)\n        over_q", "            pass\n        over_q"),
    # Spikes and sums
    ("a block gets the next one's first spike", "events[e] < blocks[b, STOP]", "events[e] <= blocks[b, STOP]"),
    ("the first row is none", "if row < 0:", "if row <= 0:"),
    ("the last run is left out", "uint64(first_run[row + 1])", "uint64(max(first_run[row], first_run[row + 1] - 1))"),
    ("a row is that of the next spike", "entry = uint64(spikes[e] + offset)", "entry = uint64(spikes[e] + offset + 1)"),
    ("emptied sums replace the input", "int32(total[i] + value) if loaded else value", "value"),
    ("emptied sums are added to an old input", "int32(total[i] + value) if loaded else value", "int32(total[i] + value)"),
    ("emptied sums stay", "loaded else value\n        sums[i] = int16(0)", "loaded else value"),
    ("emptied sums do not count as input", "    block_now[LOADED] = 1\n", ""),
    ("sums may reach 2**15", "ROOM = 32767", "ROOM = 32768"),
    ("sums are not watched", "(until - first) * largest", "(until - first)"),
    ("spikes are lost where sums are emptied", "first + rows)", "first + rows + 1)"),
    ("the first axon has no trace", "if axon >= 0:", "if axon > 0:"),
    ("a lost spike is not counted", "lost += int64(pending[axon])", "lost += int64(0)"),
    ("an input has a neuron more", "arriving[e] >= size", "arriving[e] > size"),
    ("negative neurons are foreseen", "arriving[e] < 0 or ", ""),
    ("all inputs get the first one's spikes", "s * n_inputs + source", "s * n_inputs", 1),
    ("all inputs get the first one's spikes (float)", "s * n_inputs + source", "s * n_inputs", 2),
    ("wide input is not emptied", "total[i] = int32(0)\n        for k", "pass\n        for k"),
    ("wide input is lost", "blocks_now[b, LOADED] = blocks[b, WIDE]", "blocks_now[b, LOADED] = 0"),
    ("lost spikes are kept", "            lost[k] = 0\n", "            pass\n", 1),
    ("lost spikes are kept (float)", "            lost[k] = 0\n", "            pass\n", 2),
    # Compartments
    ("decay rounds down", "int32(x >> int32(31)) & int32(4095)", "int32(x >> int32(31)) & int32(0)"),
    ("decay rounds up below 0", "int32(x >> int32(31)) & int32(4095)", "int32(x >> int32(31)) & int32(4096)"),
    ("the accumulator has a bit more", "_Q = np.int32(10)", "_Q = np.int32(9)"),
    ("the current has a bit more", "_U = np.int32(8)", "_U = np.int32(7)"),
    ("the current does not wrap", "current[i] = wrapped", "current[i] = u"),
    ("sums are not cleared after wide ones", "<< shift))\n            sums[i] = int16(0)\n", "<< shift))\n"),
    ("sums are not cleared", "total[i] = int32(int32(sums[i]) << shift)\n            sums[i] = int16(0)\n", "total[i] = int32(int32(sums[i]) << shift)\n"),
    ("overflows of q are not seen", "        over_q |= int32(arriving ^ q)\n", ""),
    ("overflows of u are not seen", "        over_u |= int32(wrapped ^ u)\n", ""),
    ("overflows of u2 are not seen", "        over |= int32(wrapped ^ u)\n", ""),
    ("overflows of the last segment only", "over_u |= u\n", "over_u = u\n"),
    ("the input is left unwrapped", "        total[i] = arriving\n", ""),
    ("no highest voltage", "voltage[i] = v if v < v_max else v_max", "voltage[i] = v"),
    ("no lowest voltage", "        v = v if v > v_min else v_min\n", ""),
    ("a voltage at the threshold fires", "fires = voltage[i] > threshold[i]", "fires = voltage[i] >= threshold[i]"),
    ("a voltage at the threshold fires (refractory)", "fires = v > threshold[i]", "fires = v >= threshold[i]"),
    ("no reset", "voltage[i] = 0 if fires else voltage[i]", "voltage[i] = voltage[i]"),
    ("no reset (refractory)", "voltage[i] = 0 if fires else v\n", "voltage[i] = v\n"),
    ("refractory for a step less", "v = 0 if wait > int32(0) else", "v = 0 if wait > int32(1) else"),
    ("a spike while waiting does not wait anew", "wait = period if fires else wait", "wait = period if fires and wait == int32(0) else wait"),
    ("a refractory period of two is none", "segments[g, REFRACTORY] > 1", "segments[g, REFRACTORY] > 2"),
    ("compartments that wait already are forgotten", "            waits[g] |= uint8(waiting[i] > 0)\n", "            pass\n"),
    ("-2**31 is foreseen in currents", "current[i] == int32(-2147483648) or ", ""),
    ("-2**31 is foreseen in voltages", " or voltage[i] == int32(-2147483648)", ""),
    ("noise at the membrane goes to the input", "int32(0) if noise_on_voltage[i] else noise\n", "noise\n"),
    ("noise at the membrane is left out", "int32(bias[i] + noise) if noise_on_voltage[i] else bias[i]", "bias[i]"),
    ("noise is rounded down", "int32((noisy[i] + noise_offset[i]) * noise_scale[i])", "int32(np.floor((noisy[i] + noise_offset[i]) * noise_scale[i]))"),
    ("noise has no offset", "(noisy[i] + noise_offset[i])", "(noisy[i])", 1),
    ("noise has no offset (float)", "float32(x + noise_offset[i])", "x"),
    ("noise is rounded early (float)", "float32(-1.0 + 2.0 * _unit(", "float32(-1.0) + float32(2.0) * float32(_unit("),
    ("noise at the membrane goes to the input (float)", "float32(0) if noise_on_voltage[i] else noisy[i]", "noisy[i]"),
    ("noise is added to the bias first (float)", "float32(current[i] + bias[i]) + noise", "current[i] + float32(bias[i] + noise)"),
    ("spikes are not counted", "count[events[e]] += int32(1)", "pass", 1),
    ("spikes are not counted (float)", "count[events[e]] += int32(1)", "pass", 2),
    ("what spiked before is of the first step", "if s == n_steps - 1:", "if s == 0:", 1),
    ("what spiked before is of the first step (float)", "if s == n_steps - 1:", "if s == 0:", 2),
    ("sums in double precision", "float32(keep * x[i]) + float32(scale * add[i])", "float32(1.0 * keep * x[i] + 1.0 * scale * add[i])"),
    ("no highest voltage (float)", "high if y >= high else y", "y"),
    ("what is no number becomes the lowest voltage", "low if x[i] <= low else x[i]", "x[i] if x[i] > low else low"),
    # Learning
    ("steps are counted from 0", "t = t0 + s + 1", "t = t0 + s", 1),
    ("steps are counted from 0 (float)", "t = t0 + s + 1", "t = t0 + s", 2),
    ("a trace does not decay", "x = decay * traces[first + i]", "x = 1.0 * traces[first + i]"),
    ("a trace does not decay (float)", "x = decay * traces[i]", "x = traces[i]"),
    ("a trace forgets its spikes", "x = x + magnitude if pending[first + i] else x", "x = x + 0.0"),
    ("a spike is added to a trace again and again", "        pending[first + i] = uint8(0)\n", ""),
    ("a spike is added to a trace again and again (float)", "        pending[i] = uint8(0)\n", ""),
    ("a trace is clipped at 126", "y = int32(127) if y > int32(127)", "y = int32(126) if y > int32(126)"),
    ("a trace of 127 is called clipped", "int32(y > int32(127))", "int32(y >= int32(127))"),
    ("traces are rounded down", "whole + int32(above)", "whole"),
    ("traces are rounded to the nearest", "size - whole > _unit(", "size - whole > 0.5 + 0.0 * _unit("),
    ("clipped traces are not told", "_log(log, TRACE, int64(clipped))", "pass"),
    ("lost spikes are not told", "_log(log, LOST, lost[k])", "pass", 1),
    ("lost spikes are not told (float)", "_log(log, LOST, lost[k])", "pass", 2),
    ("the halves of a row learn the same", "int32(int32(-product) * rate)", "int32(product * rate)"),
    ("the halves of a row learn the same (float)", "-errors[error0 + j] if j < half", "errors[error0 + j] if j < half"),
    ("errors of the first rule", "errors[error0 + j])\n            scratch", "errors[j])\n            scratch"),
    ("traces of the first rule", "int32(traces[trace0 + r])", "int32(traces[r])"),
    ("products are not shifted", "    _shift(scratch, n_rows * width, rule[PRODUCT_SHIFT])\n", ""),
    ("products are shifted towards 0", "values[i] >> int32(-by)", "int32(values[i] / int32(1 << -by))"),
    ("products are not shifted up", "values[i] << int32(by)", "values[i]"),
    ("weights are not shifted down", "int32(weight >> int32(-old))", "weight"),
    ("weights are rounded up too often", ") > int32(drawn[uint64(2) * i] >> rest)", ") >= int32(drawn[uint64(2) * i] >> rest)"),
    ("weights are rounded by the second word", "int32(drawn[uint64(2) * i] >> rest)", "int32(drawn[uint64(2) * i + uint64(1)] >> rest)"),
    ("weights are rounded down", "int32(size >> bits) + int32(above)", "int32(size >> bits)"),
    ("the count of clipped rows takes in the largest", "found |= scratch[r * width + j] > limit", "found |= scratch[r * width + j] >= limit"),
    ("weights are not clipped", "y = limit if y > limit else y", "y = y"),
    ("weights lose their sign", "int32(int32(y ^ negative) - negative) << up", "y << up"),
    ("one warning for all clipped rows", "rows += found", "rows = 1"),
    ("clipped weights are not told", "_log(log, WEIGHTS, _learn(rules[k], traces, errors, wide, drawn, scratch))", "_learn(rules[k], traces, errors, wide, drawn, scratch)"),
    ("learning as with NumPy's scalars (float)", "if rule[IS_DOUBLE]:", "if not rule[IS_DOUBLE]:"),
    # Records and the log
    ("a probe records from the first compartment", "currents[s, column + i] = current[start + i]", "currents[s, column + i] = current[i]"),
    ("a probe of voltages records into the first column", "voltages[s, column + i]", "voltages[s, i]"),
    ("a probe of spikes records the next step's place", "spikes[s, column + i] = spiked[start + i]", "spikes[s, column + i] = spiked[start]"),
    ("a full log does not stop", "log[0, 0] + 3 * n_rules + 2 > len(log)", "log[0, 0] + 3 * n_rules - 8 > len(log)", 1),
    ("nothing stops at a warning", "(stop_at_warning or ", "(", 1),
    ("nothing stops at a warning (float)", "(stop_at_warning or ", "(", 2),
    ("overflows are told before clipped weights", ("        _log(log, OVERFLOWS, over)\n", ""), ("        # Compartments are updated.\n", "        _log(log, OVERFLOWS, int64(0))\n")),
]  # fmt: skip

LAYOUT = [
    ("currents decay as voltages do", "(4095 if integers else 1)", "(4096 if integers else 1)"),
    ("decays of 13 bits are foreseen", "(keep > 4096)", "(keep > 8192)"),
    ("negative decays are foreseen", "(keep < 0) | ", ""),
    ("any lowest voltage is foreseen", "state.vmin <= -(2**31)", "state.vmin < -(2**31)"),
    ("segments do not look at limits", "table[1:] != table[:-1]", "table[1:, [0, 1, 6]] != table[:-1, [0, 1, 6]]"),
    ("segments do not look at refractory periods", "table[1:] != table[:-1]", "table[1:, :-1] != table[:-1, :-1]"),
    ("segments do not end with a block", "    edge[[part.start for part in info.slices.values()]] = True\n", ""),
    ("large noise is foreseen", "~(largest < 2.0**31)", "~(largest < 2.0**40)"),
    ("sums of noise beyond 32 bits are foreseen", "np.maximum(noise.mult, 1)", "noise.mult"),
    ("noise goes to the other place", "noise.target_u.astype(np.uint8)", "(~noise.target_u).astype(np.uint8)"),
    ("narrow weights of 17 bits", "LARGEST_NARROW = 4095", "LARGEST_NARROW = 65535"),
    ("the largest weight is the largest positive one", "int(np.abs(values).max())", "int(values.max())"),
    ("the largest weight is halved", "max(1, rows.largest >> shift)", "max(1, rows.largest >> shift + 1)"),
    ("the common power of two is that of the last synapse", "[0, *(rows.bits for rows in fixed)]", "[rows.bits for rows in fixed][-1:] or [0]"),
    ("the common power of two is doubled", ".bit_length() - 1 if bits", ".bit_length() if bits"),
    ("a block has wide weights if its last synapse has", "self.is_wide[-1] |= not narrow", "self.is_wide[-1] = not narrow"),
    ("wide runs span a gap", "if shift is not None else 1\n", "if shift is not None else 2\n"),
    ("narrow runs are cut off", "-(-lengths // LANES) * LANES", "lengths // LANES * LANES"),
    ("no room after the last sum", "info.n_compartments + LANES", "info.n_compartments"),
    ("the first of equal targets counts", "last[:-1] = (row[1:] != row[:-1]) | (targets[1:] != targets[:-1])", "last[1:] = (row[1:] != row[:-1]) | (targets[1:] != targets[:-1])"),
    ("weights are not sorted", "        if np.all(rises):\n", "        if True:\n"),
    ("a compartment more is foreseen", "reach >= part.stop", "reach > part.stop"),
    ("negative compartments are foreseen", " or np.any(depth < 0)", ""),
    ("traces of more axons are foreseen", "traced and np.any(index >= synapse.n_axons)", "False"),
    ("sparse weights that learn are foreseen", "if not alone:", "if False:"),
    ("axons and synapses of any class are foreseen", "if type(part) is not kind:", "if False:"),
    ("a synapse that learns may lack rows", "len(self.synapse.weights) != self.synapse.n_axons", "False"),
    ("weights of another type are foreseen", "any(w.dtype != dtype for w in weights)", "False"),
    ("weights may have a shape of their own", "w.shape != i.shape or ", ""),
    ("rows may have atoms of their own", " or len(w) != self.n_atoms for", " for"),
    ("indices of any type are foreseen", "any(i.dtype not in (np.int32, np.int64) for i in indices)", "False"),
    ("a compartment of a block is one of the chip", "base + part.start", "base"),
    ("a block's spikes are those of the first", "size - start,", "size,"),
    ("synapses are fed in the order of sources", "    found.sort(key=lambda route: order[route[0]])  # leaves", "    # leaves"),
    ("blocks come before inputs", "sources += [", "sources[:0] = ["),
    ("numbers of axons in floating point are foreseen", "if len(values) and values.dtype.kind not in \"iu\":", "if False:"),
    ("a base of 0 is none", "used & (base >= 0)", "used & (base > 0)"),
    ("a base below 0 is one", "    used = used & (base >= 0)\n", "    pass\n"),
    ("what cannot be read is an error", "except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:", "except EOFError as error:"),
    ("what cannot be read for ArithmeticError is an error", "ArithmeticError, ", ""),
    ("what cannot be read for AttributeError is an error", "AttributeError, ", ""),
    ("what cannot be read for LookupError is an error", "LookupError, ", ""),
    ("what cannot be read for TypeError is an error", "TypeError, ", ""),
    ("what cannot be read for ValueError is an error", ", ValueError)", ")"),
    ("negative rows are foreseen", "if np.any(used & (row < 0)):", "if False:"),
    ("more atoms are foreseen", " | (atom >= n_atoms)", ""),
    ("negative atoms are foreseen", "(atom < 0) | ", ""),
    ("atoms are left out", "row * n_atoms + atom", "row * n_atoms"),
    ("the epochs are swapped", "s.train_epoch,\n             s.learn_epoch", "s.learn_epoch,\n             s.train_epoch"),
    ("traces decay for one step", "-s.train_epoch / s.tracing_tau", "-1 / s.tracing_tau"),
    ("errors of the second rule are those of the first", "trace + n, error + n_errors\n    return", "trace + n, error\n    return"),
    ("learned weights have a bit more", "2 ** (8 - spare) - 1", "2 ** (9 - spare) - 1"),
    ("learned weights lose no spare bits", "LEARN_FRAC + spare, 2", "LEARN_FRAC, 2"),
    ("products are shifted by one less", "learn_overflow_bits(n_factors=2)\n", "learn_overflow_bits(n_factors=2) + 1\n"),
    ("any shifts are foreseen", "abs(product) < 32 and abs(old) < 32 and 0 <= new < 32 and 0 < bits < 28", "True"),
    ("any learning rate is foreseen", "not -(2**31) <= rate < 2**31 or ", ""),
    ("learning parameters of any type are foreseen", "any(type(value) is not int for value in whole)", "False"),
    ("parameters of the product may have any type", "whole += [rate, s._lr_exp, ", "whole += ["),
    ("epochs of 0 are foreseen", "min(s.train_epoch, s.learn_epoch) > 0 and ", ""),
    ("traces that grow are foreseen", " and s.tracing_tau > 0", ""),
    ("any trace is foreseen", " or not 0 <= s.tracing_mag < 2**30", ""),
    ("learning as NumPy 1 rounds it is foreseen", "elif int(np.__version__.split(\".\")[0]) < 2:", "elif False:"),
    ("runs of a probe miss compartment 0", "prepend=-2", "prepend=-1"),
    ("blocks of a probe share columns", "parts.append(slice(widths[key], widths[key] + len(where)))", "parts.append(slice(0, len(where)))"),
    ("any probe is foreseen", "if probe.key not in KEYS:\n            raise Unsupported(f\"a probe of {probe.key!r}\")\n        key = KEYS.index(probe.key)", "key = KEYS.index(probe.key) if probe.key in KEYS else 1"),
    ("a probe of one number is foreseen", "[chosen]\n            if where.ndim != 1:", "[chosen].reshape(-1)\n            if False:"),
    ("any input is foreseen", "if type(item) is not SpikeInput:", "if False:"),
]  # fmt: skip

LINK = [
    ("any generator is foreseen", "if not np.array_equal(memory, np.append(words, position).astype(np.uint32)):", "if False:"),
    ("a new generator owes the old one's numbers", "        self.owed = 0\n        self.is_shared = False\n", "        self.owed = getattr(self, \"owed\", 0)\n        self.is_shared = False\n"),
    ("a shared generator is behind", "        self.is_shared = True\n", "        pass\n"),
    ("a generator is shared before its numbers are drawn", "        self.settle()\n        self.is_shared", "        self.is_shared"),
    ("another kind of generator is foreseen", "isinstance(generator, np.random.MT19937)", "True"),
    ("states of any class are foreseen", "if type(part) is not kind:", "if False:"),
    ("noise of any class is foreseen", "state.noise: NoiseState, ", ""),
    ("taking over forgets the state", "            self.cells[row] = getattr(state, name).reshape(n)\n", "            if name in (\"bias\", \"vth\"):\n                self.cells[row] = getattr(state, name).reshape(n)\n"),
    ("taking over forgets the counters", "            self.counters[row] = getattr(state, name)\n", "            pass\n"),
    ("taking over forgets the last spikes", "        self.spiked[:n] = state.spiked\n", ""),
    ("taking over forgets traces", "            self.traces[first : first + s.n_axons] = synapses.traces[s]\n", ""),
    ("taking over forgets spikes that wait for a trace", "            self.pending[[first + axon for axon in synapses.trace_spikes[s]]] = 1\n", ""),
    ("taking over forgets errors", "            self.errors[error : error + len(synapses.pes_errors[s])] = synapses.pes_errors[s]\n", ""),
    ("random numbers are left out while something learns", "layout.is_noisy or (integers and sizes)", "layout.is_noisy"),
    ("the random numbers of floats are those of integers", "else (kernel.skip_words, 2 * n)", "else (kernel.skip_words, n)"),
    ("too little room for products", "len(e) * 2)", "len(e))"),
    ("too little room for random numbers", "np.zeros(2 * most, np.uint32)", "np.zeros(most, np.uint32)"),
    ("learned weights stay NengoLoihi's", "            s.weights[:] = self.layout.weights[s]\n", ""),
    ("new learning parameters are not seen", "self._parameters_of(s) == parameters\n", "True\n"),
    ("a learning rate is no parameter", "\"learning_rate\")", "\"learning\")"),
    ("a learning rate is no parameter of integers", "\"_lr_int\", \"_lr_exp\")", "\"_lr_exp\")"),
    ("new weights are not seen", "                and s.weights[0] is weights\n", ""),
    ("new traces are not seen", "                and synapses.traces[s] is trace\n", ""),
    ("new errors are not seen", "                and synapses.pes_errors[s] is errors\n", ""),
    ("the log is not emptied", "        self.log[0, 0] = 0\n", ""),
    ("a step that is done again has new counters", "(self.cells, self.counters, self.spiked,", "(self.cells, self.spiked,", 0),
    ("a step that is done again has new random numbers", "learned, self.random.words", "learned", 0),
    ("a step that is done again has new traces", "self.before, self.traces, self.pending)", "self.before, self.pending)", 0),
    ("a step that is done again has new weights", "learned = self.wide if len(self.traces) else _NOTHING", "learned = _NOTHING", 0),
    ("spikes that wait for a trace are those of the first rule", "self.pending[first : first + s.n_axons])", "self.pending[: s.n_axons])"),
    ("spikes of before are those of the last step", "self.before[: self._n].view(bool)", "self.spiked[: self._n].view(bool)"),
    ("inputs are not among the spikes of before", "spike_idxs=lambda t, spikes=spikes: spikes", "spike_idxs=lambda t: []"),
    ("spikes for step 0 arrive", "if t == 0:", "if False:"),
    ("spikes arrive a step early", "range(t, t + steps)", "range(t + 1, t + 1 + steps)"),
    ("spikes of any type are foreseen", " or spikes.dtype.kind not in \"iu\":", ":"),
    ("spikes in any object are foreseen", "        spikes = np.asarray(spikes) if spikes else _NOTHING\n", "        spikes = np.asarray(spikes) if spikes else _NOTHING\n    spikes = _NOTHING if spikes is None else np.asarray(spikes)\n"),
    ("an empty list is of no integers", "np.asarray(spikes) if spikes else _NOTHING", "np.asarray(spikes)"),
    ("spikes of any shape are foreseen", " or spikes.ndim != 1", ""),
    ("of the spikes that arrived the first step's are kept", "self._lists[step * self._n : (step + 1) * self._n]", "self._lists[: self._n]"),
    ("used spikes stay", "                    del spikes[sent]\n", "                    pass\n"),
    ("permanent spikes go", " and sent not in permanent:", ":"),
    ("spikes of a step that is to come go", "self._t + done):", "self._t + done + 1):"),
]  # fmt: skip

EMULATOR = [
    ("random numbers are not made up for", "            random.share()\n", "            pass\n"),
    ("a new generator is not used", "                self._random.draw_from(rng)\n", "                pass\n"),
    ("a new generator is not shared", "                self._random.share()\n", "                pass\n"),
    ("a shared generator is behind after a call", "            if link.random.is_shared:\n", "            if False:\n"),
    ("a call is not cut", "min(steps, self._link.at_once)", "steps"),
    ("a strict emulator is as any", "self.compartment.strict or self.synapses.strict or ", ""),
    ("strict synapses do not count", " or self.synapses.strict or", " or"),
    ("warnings that are errors do not count", " or _warnings_are_errors()", ""),
    ("a step that fails is not undone", "            link.restore(kept)\n", ""),
    ("steps before the one that fails are left out", "            if done > 1:\n", "            if False:\n"),
    ("the step that fails is not done again", "            one_step_as_nengo_loihi(self)\n", ""),
    ("the clock stands still", "        self.t += done\n", ""),
    ("spikes are never forgotten", "        arriving.forget(self.inputs, done)\n", ""),
    ("the last spikes are the first step's", "arriving.of_step(done - 1)", "arriving.of_step(0)"),
    ("nothing is owed", "            link.random.owed += done\n", "            pass\n"),
    ("one overflow is told for three", "            if count & 1 << bit:\n", "            if count & 1 << bit and not count & (1 << bit) - 1:\n"),
    ("a warning is given once for each kind", "range(count if kind != OVERFLOWS else 0)", "range(1 if kind != OVERFLOWS else 0)"),
    ("traces are told as weights", "if kind == TRACE else", "if kind != TRACE else"),
    ("a new array is not copied", "if name in (*ROWS, *COUNTERS, \"spiked\"):", "if name in ROWS[:1]:"),
    ("probed values of before are dropped", "[[np.stack(part)] if len(part) else [] for part in parts]", "[[] for part in parts]"),
    ("cleared probes stay", "            output.clear()\n", "            pass\n"),
    ("fixed arrays may be written to", "        array.flags.writeable = False\n", "        pass\n"),
    ("decays may be written to", "    arrays = [getattr(state, name) for name in FIXED]\n", "    arrays = []\n"),
    ("noise may be written to", "    arrays += [getattr(state.noise, name) for name in FIXED_NOISE]\n", ""),
    ("indices may be written to", "        arrays += synapse.indices\n", ""),
    ("weights may be written to", "            arrays += synapse.weights\n", "            pass\n"),
    ("maps may be written to", "            arrays += [given for given in maps if given is not None]\n", "            pass\n"),
    ("what was read-only can be written to", "for array in arrays if array.flags.writeable]", "for array in arrays]"),
    ("decays may be replaced", "elif name in (*FIXED, \"noise\"):", "elif name == \"noise\":"),
    ("noise may be replaced", "elif name in (*FIXED, \"noise\"):", "elif name in FIXED:"),
    ("parameters of noise may be replaced", "if name in FIXED_NOISE:", "if False:"),
    ("a closed emulator keeps arrays read-only", "            _unlock(self._link)\n", "            pass\n"),
    ("a closed emulator calls itself", "            super().step()\n", "            self.run_steps(1)\n"),
    ("steps are not counted as NengoLoihi does", "        steps = len(range(steps))\n", ""),
    ("a copy is NengoLoihi's", "        take_over(other, kind)\n        return", "        return"),
    ("the original of a copy is NengoLoihi's", "            self.__class__ = kind\n            _connect(self, link)\n", "            pass\n"),
    ("handing over owes random numbers", "    link.random.settle()\n    state, synapses", "    state, synapses"),
    ("handing over forgets spikes of before", "synapses.trace_spikes, synapses.spikes_in, probes.outputs = trace_spikes, spikes_in, lists", "synapses.trace_spikes, synapses.spikes_in, probes.outputs = trace_spikes, {s: [] for s in synapses.slices}, lists"),
    ("handing over forgets spikes that wait for a trace", "synapses.trace_spikes, synapses.spikes_in, probes.outputs = trace_spikes, spikes_in, lists", "synapses.trace_spikes, synapses.spikes_in, probes.outputs = {s: set() for s in synapses.traces}, spikes_in, lists"),
    ("handing over forgets probed values", "[list(part) for part in parts]", "[[] for part in parts]"),
    ("handed over arrays stay read-only", "    _unlock(link)\n    emulator", "    emulator"),
    ("handing over is silent", "    say_once(f\"NengoLoihi's own emulator continues, because of {reason}\")\n", ""),
    ("after a step of NengoLoihi's the spikes of before are older", "    link.before[: len(spiked)] = spiked\n", ""),
    ("after a step of NengoLoihi's the inputs' spikes are older", "    link.last_spikes = [spikes for _, spikes in last]\n", ""),
    ("after a step of NengoLoihi's spikes wait for traces still", "    link.pending[:] = 0\n", ""),
    ("after a step of NengoLoihi's no spikes wait for traces", "        link.pending[[first + axon for axon in emulator.synapses.trace_spikes[synapse]]] = 1\n", "        pass\n"),
]  # fmt: skip

FAULTS = [
    (file, *fault)
    for file, faults in (
        ("kernel_numba.py", KERNEL),
        ("layout.py", LAYOUT),
        ("link.py", LINK),
        ("emulator.py", EMULATOR),
    )
    for fault in faults
]


def faulty(text, changes):
    """The text with some changes.

    Each is a pair of an old and a new piece.  A single pair may have a third member: which of
    several places that the old piece is in (0: all of them); without it there must be one.
    """
    if isinstance(changes[0], str):
        old, new, *which = changes
        places = text.split(old)
        n = len(places) - 1
        if n < max(which[0], 1) if which else n != 1:
            raise SystemExit(f"{n} places have this text: {old}")
        if which == [0]:
            return new.join(places)
        k = which[0] if which else 1
        return old.join(places[:k]) + new + old.join(places[k:])
    for change in changes:
        text = faulty(text, change)
    return text


def fails(folder, kernel_is_new):
    """What fails first, or None, with a copy of the project.

    To compile a kernel takes longer than most faults survive, so that it runs as Python first.
    """
    if kernel_is_new:
        found = first_failure(folder, folder, True)
        if found is not None:
            return found
        with tempfile.TemporaryDirectory(dir=folder) as cache:
            return first_failure(folder, cache, False)
    return first_failure(folder, folder / "numba", False)


def first_failure(folder, cache, as_python):
    """Run the tests in a child of this process, which has imported what takes long."""
    temporary = Path(tempfile.mkdtemp(dir=folder))
    child = os.fork()
    if child == 0:
        with open(temporary / "output", "w") as output:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE, PATIENCE))
        sys.dont_write_bytecode = True  # of two sources of one second
        os.chdir(folder)
        sys.path.insert(0, str(folder))
        for name in [name for name in sys.modules if name.split(".")[0] in COPIED]:
            del sys.modules[name]
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = str(temporary / "hypothesis")
        numba.config.CACHE_DIR = str(cache)
        files = sorted(Path(TESTS).glob("test_*.py"), key=lambda path: path.stem not in FIRST)
        chosen = list(map(str, files))
        if as_python:
            numba.config.DISABLE_JIT = 1
            np.seterr(all="ignore")  # Python tells of integers that wrap
            chosen = [f"{TESTS}/test_{name}.py" for name in ("block_models", "hand_over")]
            chosen += ["-k", "taken or hand_over"]
        status = pytest.main(["-x", "-q", "-n0", "--tb=no", *chosen])
        sys.stdout.flush()
        os._exit(status)
    status = os.waitpid(child, 0)[1]
    lines = (temporary / "output").read_text(errors="replace").splitlines()
    shutil.rmtree(temporary)
    if status == 0:
        return None
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split("::")[-1].split(" - ")[0] if failed else f"wait status {status}"


def main(*words):
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
            copy(ROOT / name, folder / name)
        before = fails(folder, False)
        if before is not None:
            raise SystemExit(f"without a fault: {before}")
        for file, name, *changes in FAULTS:
            if words and not any(word in f"{file}: {name}" for word in words):
                continue
            path = folder / PACKAGE / file
            kept = path.with_suffix(".kept")
            shutil.copy2(path, kept)
            path.write_text(faulty(path.read_text(), changes))
            began = time.monotonic()
            found = fails(folder, file == "kernel_numba.py")
            os.replace(kept, path)  # with its time, by which Numba knows its cache
            seconds = time.monotonic() - began
            print(f"{file}: {name}: {found or 'SURVIVES'} ({seconds:.0f} s)", flush=True)
            if found is None:
                survivors.append(name)
    print(f"{len(survivors)} survive: {survivors}")
    return bool(survivors)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
