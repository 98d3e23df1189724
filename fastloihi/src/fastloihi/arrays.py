"""The arrays of the compiled steps for one emulator, and the spikes of its inputs."""

from __future__ import annotations

import ctypes
from itertools import accumulate, chain, repeat
from operator import attrgetter
from types import SimpleNamespace
from typing import List

import numpy as np
from nengo_loihi.emulator.interface import CompartmentState, NoiseState, ProbeState, SynapseState

from .layout import Unsupported, make_layout

ROWS = ("current", "voltage", "input", "bias", "vth")  # of `cells`, by NengoLoihi's names
COUNTERS = ("ref_count", "spike_count")  # of `counters`

MAX_PROBED_BYTES = 32 << 20  # bytes of probed values in one call of the compiled function
MAX_UPDATES_PER_CALL = (
    1 << 28
)  # updates of compartments in one call: half a second, in which Ctrl-C waits
LOG_LINES = 256  # lines of the log of warnings

# Learning parameters of a synapse, in floating point and in integers.
PERIODS = ("train_epoch", "learn_epoch", "tracing_tau", "tracing_mag")
parameters_of_floats = attrgetter(*PERIODS, "learning_rate")
parameters_of_integers = attrgetter(*PERIODS, "_lr_int", "_lr_exp")

_NONE: List[int] = []  # the spikes of an input in a step without any
_NOTHING = np.zeros(0, np.int64)


class Random:
    """The random numbers of an emulator, which are drawn late where nothing depends on them.

    Attributes
    ----------
    words : (625,) uint32 array
        The memory of a `RandomState`: 624 words of 32 bits and the position of the next one.
    owed : int
        Number of steps whose random numbers were not drawn.
    is_shared : bool
        True if other code has the `RandomState`, so that no step may be owed after a call.
    """

    def __init__(self, rng, skip, n_each):
        self._skip = skip
        self._n_each = n_each
        self.draw_from(rng)

    def draw_from(self, rng):
        """Draw all further random numbers from a `RandomState`."""
        generator = getattr(rng, "_bit_generator", None)
        if not isinstance(generator, np.random.MT19937):
            raise Unsupported("random numbers of a generator other than MT19937")
        _, words, position, *_ = rng.get_state()
        address = generator.ctypes.state_address
        memory = np.ctypeslib.as_array((ctypes.c_uint32 * 625).from_address(address))
        if not np.array_equal(memory, np.append(words, position).astype(np.uint32)):
            raise Unsupported("random numbers that NumPy keeps in another way")
        self.words = memory
        self._rng = rng  # whose memory must not be freed
        self.owed = 0
        self.is_shared = False

    def share(self):
        """Draw the numbers that are owed; from now on, they are drawn after each call."""
        self.settle()
        self.is_shared = True

    def settle(self):
        """Draw the numbers that are owed."""
        if self.owed:
            self._skip(self.words, self._n_each * self.owed)
            self.owed = 0


class EmulatorArrays:
    """The arrays of the compiled steps for one emulator.

    Attributes
    ----------
    layout : Layout
    cells, counters, spiked, before, traces, pending, errors, wide : ndarray
        The state: see :mod:`fastloihi.compiled`.  ``before`` are the spikes before the last step.
    last_spikes : list
        Spikes of each input that arrived in the last step.
    draws : bool
        True if anything depends on random numbers; otherwise they are not drawn.
    random : Random
    overflows : (n_blocks, 3) int64 array
        Number of overflows since the start in integers.
    advance : callable
        The compiled function, whose arguments after those of the state are `fixed_arguments`.
    """

    def __init__(self, emulator):
        from . import compiled  # Numba takes long to import, and not everyone runs a network

        _refuse_other_classes(emulator)
        state = emulator.compartment
        synapses = emulator.synapses
        self.layout = layout = make_layout(emulator)
        self._n = n = emulator.block_info.n_compartments
        dtype = state.dtype
        is_integer = dtype == np.int32
        self.advance = compiled.advance_integers if is_integer else compiled.advance_floats
        skip = (compiled.skip_noise, n) if is_integer else (compiled.skip_words, 2 * n)
        self.random = Random(vars(emulator)["rng"], *skip)
        self._copy_state(state)
        self._copy_learning(synapses, dtype)
        n_rules = len(self.first_trace)
        self.wide = layout.network[8]
        self.draws = bool(layout.is_noisy or (is_integer and n_rules))
        self._parameters_of = parameters_of_integers if is_integer else parameters_of_floats
        self.has_probes = bool(layout.columns)
        self._spikes_in = synapses.spikes_in  # of the step before the first
        self.last_spikes = None
        probed_bytes = max(1, 4 * sum(layout.widths))
        self.at_once = max(
            1, min(MAX_UPDATES_PER_CALL // max(n, 1000), MAX_PROBED_BYTES // probed_bytes)
        )
        self.log = np.zeros((LOG_LINES + 3 * n_rules, 2), np.int64)
        self._types = [dtype, dtype, np.uint8]
        self._empty = [np.zeros((1, 0), kind) for kind in self._types]
        self.histories = self._empty
        self._inputs = list(emulator.inputs)
        self._axons = emulator.axons
        learned = [s.n_axons * max(1, len(e) * 2) for s, e in synapses.pes_errors.items()]
        scratch_size = max([*learned, n])
        n_blocks = len(emulator.block_info.blocks)
        self.overflows = np.zeros((n_blocks, 3), np.int64)
        self.fixed_arguments = (
            *layout.network, *layout.learning, self.traces, self.pending, self.errors,
            *layout.noise, self.overflows, *self._make_scratch(n_blocks, scratch_size, dtype),
        )  # fmt: skip
        self._arguments = (
            self.cells, self.counters, self.spiked, self.spiked.view(np.uint64), self.before,
            *self.fixed_arguments,
        )  # fmt: skip

    def _copy_state(self, state):
        """Take the state of the compartments, whose spikes are padded to a multiple of eight."""
        n = self._n
        self.cells = np.zeros((len(ROWS), n), state.dtype)
        self.counters = np.zeros((len(COUNTERS), n), np.int32)
        for row, name in enumerate(ROWS):
            self.cells[row] = getattr(state, name).reshape(n)
        for row, name in enumerate(COUNTERS):
            self.counters[row] = getattr(state, name)
        # Eight spikes are looked at together.
        self.spiked, self.before = (np.zeros(-(-n // 8) * 8, np.uint8) for _ in range(2))
        self.spiked[:n] = state.spiked

    def _copy_learning(self, synapses, dtype):
        """Take the traces, the pending spikes and the errors of the synapses that learn."""
        sizes = [synapse.n_axons for synapse in synapses.traces]
        self.first_trace = dict(zip(synapses.traces, np.cumsum([0, *sizes]).tolist()))
        self.traces = np.zeros(sum(sizes), dtype)
        self.pending = np.zeros(sum(sizes), np.uint8)
        self.errors = np.zeros(sum(map(len, synapses.pes_errors.values())), dtype)
        error = 0
        for synapse, first in self.first_trace.items():
            errors = synapses.pes_errors[synapse]
            self.traces[first : first + synapse.n_axons] = synapses.traces[synapse]
            self.pending[[first + axon for axon in synapses.trace_spikes[synapse]]] = 1
            self.errors[error : error + len(errors)] = errors
            error += len(errors)

    def _make_scratch(self, n_blocks, scratch_size, dtype) -> tuple:
        """Arrays in which the compiled function works."""
        return (
            np.zeros(self._n, np.int64),  # events
            np.zeros(n_blocks + 1, np.int64),  # their ends
            np.zeros(len(self.spiked) // 8 + 1, np.int32),  # words in use
            np.zeros((n_blocks, 2), np.int64),
            np.zeros(len(self.first_trace), np.int64),  # spikes lost
            np.zeros(len(self.layout.network[0]), np.uint8),  # whether a segment waits
            np.zeros(2 * scratch_size, np.uint32),  # random numbers
            np.zeros(scratch_size, dtype),
            np.zeros(self._n, dtype),
        )

    def list_state_arrays(self):
        """The arrays of the compartments, by their names in NengoLoihi."""
        arrays = dict(zip(ROWS, self.cells))
        arrays.update(zip(COUNTERS, self.counters))
        arrays["input"] = arrays["input"].reshape(1, -1)
        arrays["spiked"] = self.spiked[: self._n].view(bool)
        return arrays

    def learn_from(self, synapses):
        """Make traces, errors and weights of learning synapses views of these arrays."""
        error = 0
        self._learning = []
        for s, first in self.first_trace.items():
            n_errors = len(synapses.pes_errors[s])
            synapses.traces[s] = self.traces[first : first + s.n_axons]
            synapses.pes_errors[s] = self.errors[error : error + n_errors]
            error += n_errors
            s.weights[:] = self.layout.weights[s]
            views = s.weights[0], synapses.traces[s], synapses.pes_errors[s]
            self._learning.append((s, self._parameters_of(s), *views))

    def _require_unchanged_learning(self, synapses):
        """Refuse synapses that learn if other code has replaced their parameters or arrays."""
        for s, parameters, weights, trace, errors in self._learning:
            if not (
                self._parameters_of(s) == parameters
                and s.weights[0] is weights
                and synapses.traces[s] is trace
                and synapses.pes_errors[s] is errors
            ):
                raise Unsupported("a learning rule or its arrays, which were replaced")

    def run(self, emulator, steps, arriving, careful):
        """Call the compiled function; return the number of steps that it ran."""
        layout = self.layout
        self._require_unchanged_learning(emulator.synapses)
        if self.has_probes:
            self.histories = [
                np.empty((steps, width), kind) if width else empty
                for width, kind, empty in zip(layout.widths, self._types, self._empty)
            ]
        self.log[0, 0] = 0
        done = self.advance(
            *self._arguments, self.random.words, layout.recorded, layout.is_noisy, self.draws,
            emulator.t, steps, arriving.spikes, arriving.ends, *self.histories, self.log, careful,
        )  # fmt: skip
        if done < 0:
            raise Unsupported(
                "spikes of neurons that an input does not have, or a voltage of -2**31"
            )
        return done

    def copy(self):
        """Copy the state that a call changes."""
        learned = self.wide if len(self.traces) else _NOTHING
        changed = (self.cells, self.counters, self.spiked, self.before, self.traces, self.pending)
        return [array.copy() for array in (*changed, learned, self.random.words)]

    def restore(self, copies):
        """Give the state back that :meth:`copy` returned."""
        learned = self.wide if len(self.traces) else _NOTHING
        changed = (self.cells, self.counters, self.spiked, self.before, self.traces, self.pending)
        for array, copy in zip((*changed, learned, self.random.words), copies):
            array[...] = copy

    def trace_spikes(self, synapses):
        """Axons of each synapse on which a spike waits for its trace."""
        return {
            s: set(np.flatnonzero(self.pending[first : first + s.n_axons]).tolist())
            for s, first in self.first_trace.items()
        }

    def spikes_in(self, synapses):
        """Input spikes, computed by NengoLoihi's method from the spikes before the last step."""
        if self.last_spikes is None:
            return self._spikes_in
        sources = [
            SimpleNamespace(axons=item.axons, spike_idxs=lambda t, spikes=spikes: spikes)
            for item, spikes in zip(self._inputs, self.last_spikes)
        ]
        receiver = SimpleNamespace(spikes_in={s: [] for s in synapses.slices})
        spiked = self.before[: self._n].view(bool)
        SynapseState.inject_current(receiver, 2, sources, self._axons, spiked)
        return receiver.spikes_in


def _refuse_other_classes(emulator):
    """Refuse an emulator whose parts are not NengoLoihi's own classes."""
    state = emulator.compartment
    kinds = {
        state: CompartmentState,
        state.noise: NoiseState,
        emulator.synapses: SynapseState,
        emulator.probes: ProbeState,
    }
    for part, kind in kinds.items():
        if type(part) is not kind:
            raise Unsupported(f"a state of the class {type(part).__name__}")


class ArrivingSpikes:
    """Input spikes that arrive in some steps; a spike arrives one step after it was sent.

    Attributes
    ----------
    spikes : int64 array
        Spikes of all steps, in each step one input after the other.
    ends : (n_steps * n_inputs + 1,) int64 array
        Ends of the spikes of each step and input, after a 0.
    """

    def __init__(self, inputs, t, steps):
        self._t = t
        self._n = len(inputs)
        columns = [
            list(map(item.spikes.get, range(t, t + steps), repeat(_NONE))) for item in inputs
        ]
        if t == 0:
            for column in columns:
                column[0] = _NONE  # NengoLoihi's first step has no spikes of inputs
        self._lists = columns[0] if self._n == 1 else list(chain.from_iterable(zip(*columns)))
        numbers = [_convert_spikes(spikes) for spikes in self._lists if spikes is not _NONE]
        self.ends = np.array(list(accumulate(map(len, self._lists), initial=0)), np.int64)
        self.spikes = _NOTHING
        if self.ends[-1]:
            joined = numbers[0] if len(numbers) == 1 else np.concatenate(numbers)
            self.spikes = np.ascontiguousarray(joined, np.int64)

    def get_spikes(self, step):
        """The spikes of each input in a step."""
        return self._lists[step * self._n : (step + 1) * self._n]

    def forget(self, inputs, done):
        """Delete the spikes of the first steps, as NengoLoihi does after use."""
        for item in inputs:
            spikes = item.spikes
            permanent = item.permanent
            for sent in range(max(self._t, 1), self._t + done):
                if sent in spikes and sent not in permanent:
                    del spikes[sent]


def _convert_spikes(spikes):
    """Spikes of an input in a step as an array, if NengoLoihi would accept them."""
    if type(spikes) is list:
        spikes = np.asarray(spikes) if spikes else _NOTHING
    if type(spikes) is not np.ndarray or spikes.ndim != 1 or spikes.dtype.kind not in "iu":
        raise Unsupported("spikes of an input in another form than a list of integers")
    return spikes
