"""NengoLoihi's emulator with its steps done by a compiled kernel: same methods, same bits.

NengoLoihi's own class lays out the chip's state.  Its arrays become parts of those that the kernel
works on, so that whatever looks at them, or changes them in place, still can; what only NengoLoihi's
steps use (the spikes of the last step, random numbers that nothing depends on) is worked out when
somebody asks for it.

Two things are left to NengoLoihi's own steps, so that no answer can differ from theirs: a network
that `layout` calls unforeseen, for good, and a step that gives a warning which is to be an error.
"""

from __future__ import annotations

import ctypes
import warnings
from types import SimpleNamespace
from typing import Mapping

import numpy as np
from nengo_loihi.emulator import interface
from nengo_loihi.emulator.interface import (
    CompartmentState,
    EmulatorInterface,
    ProbeState,
    SynapseState,
)

from .layout import KEYS, LANES, Unforeseen, make_layout

ROWS = ("current", "voltage", "input", "bias", "vth")  # of `cells`
COUNTERS = ("ref_count", "spike_count")
FIXED = ("decay_u", "decay_v", "scale_u", "scale_v", "vmin", "vmax", "ref")

LOST, TRACE, WEIGHTS, OVERFLOWS = range(4)  # in the kernel's log

HISTORY = 32 << 20  # bytes of probed values in one call of the kernel
AT_ONCE = 1 << 28  # updates of compartments in one call, after which Ctrl-C is heard: half a second
LOG = 256  # lines of the kernel's log of warnings

_NOTHING = np.zeros(0, np.int64)


class NotAccelerated(UserWarning):
    """NengoLoihi's own code runs a network: the results are the same, but take their time."""


_said = set()


def say_once(message):
    """Warn, unless these words were said before in this process."""
    if message not in _said:
        _said.add(message)
        warnings.warn(message, NotAccelerated, stacklevel=3)


def find_kernel():
    """The module with the kernel; None, and a warning, where Numba is missing."""
    try:
        from . import kernel_numba
    except ImportError as error:
        say_once(f"NengoLoihi's own emulator is used: Numba is missing ({error})")
        return None
    return kernel_numba


class FastEmulator(EmulatorInterface):
    """As NengoLoihi's `EmulatorInterface`, for any of its models.

    Parameters
    ----------
    model : nengo_loihi.builder.Model
    seed : int, optional
    """

    def __init__(self, model, seed=None):
        super().__init__(model, seed=seed)
        take_over(self, type(self))

    @property
    def rng(self):
        """The random state after the last step."""
        link = self.__dict__.get("_link")
        if link is not None:
            link.settle_random(self.block_info.n_compartments)
        return self.__dict__["rng"]

    @rng.setter
    def rng(self, rng):
        self.__dict__["rng"] = rng
        if self.__dict__.get("_link") is not None:
            self._link.words = _words(rng)
            self._link.owed = 0

    def close(self):
        super().close()
        self._link = None

    def step(self):
        self.run_steps(1)

    def run_steps(self, steps):
        while steps > 0 and isinstance(self, FastEmulator) and self._link is not None:
            steps -= self._advance(min(steps, self._link.at_once))
        if steps > 0:
            EmulatorInterface.run_steps(self, steps)

    def _advance(self, steps):
        """Some steps, at least one if there is no error; how many."""
        link = self._link
        careful = bool(
            self.compartment.strict or self.synapses.strict or _warnings_are_errors()
        )
        kept = link.copy() if careful else None
        try:
            arriving = _Arriving(self.inputs, self.t, steps)
            done = link.run(self, steps, arriving, careful)
        except Unforeseen as reason:
            hand_over(self, reason)
            return 0
        if careful and link.log[0, 0]:
            link.restore(kept)
            if done > 1:
                link.run(self, done - 1, arriving, False)
                self._finish(done - 1, arriving)
            one_step_as_nengo_loihi(self)
            return done
        self._finish(done, arriving)
        return done

    def _finish(self, done, arriving):
        """Keep what was probed in some steps, and give the warnings of them."""
        link = self._link
        self.t += done
        arriving.forget(self.inputs, done)
        link.last_spikes = arriving.of_step(done - 1)
        link.owed += 0 if link.draws else done
        if link.has_probes:
            current, voltage, spikes = link.histories
            histories = (current, voltage, spikes.view(bool))
            self.probes.keep(link.layout.columns, histories, done)
        if link.log[0, 0]:
            for kind, count in link.log[1 : link.log[0, 0] + 1].tolist():
                _warn(self, kind, count)


def _warn(emulator, kind, count):
    """What the kernel's log says, as NengoLoihi would and from its module."""
    if kind == OVERFLOWS:
        for bit, place in enumerate(("q0", "current", "u2")):
            if count & 1 << bit:
                emulator.compartment.error(f"Overflow in {place}")
    for _ in range(count if kind != OVERFLOWS else 0):
        if kind == LOST:
            emulator.synapses.error("Synaptic trace spikes lost")
            continue
        warnings.warn_explicit(
            "Clipping synapse trace" if kind == TRACE else "Clipping learning weights",
            UserWarning,
            interface.__file__,
            SynapseState.__init__.__code__.co_firstlineno,
            module=interface.__name__,
            registry=interface.__dict__.setdefault("__warningregistry__", {}),
        )


def _warnings_are_errors():
    """Whether any filter makes an error of a `UserWarning`."""
    return any(
        entry[0] == "error" and issubclass(UserWarning, entry[2]) for entry in warnings.filters
    )


# --- NengoLoihi's parts, with what the kernel does not keep worked out on demand ------------------


class _Compartments(CompartmentState):
    """A new array put in the place of one of the state is copied into it."""

    def __setattr__(self, name, value):
        if name in (*ROWS, *COUNTERS, "spiked"):
            self.__dict__[name][...] = value
        else:
            super().__setattr__(name, value)


class _Synapses(SynapseState):
    """Spikes of the last step, and those that wait for a trace, as NengoLoihi keeps them."""

    @property
    def trace_spikes(self):
        return self.link.trace_spikes(self)

    @property
    def spikes_in(self):
        return self.link.spikes_in(self)


class _Probes(ProbeState):
    """Probed values of many steps are kept as one array, and not as a list of steps."""

    @property
    def outputs(self):
        return _Outputs(self.kept)

    def keep(self, columns, histories, steps):
        """Append the values of some steps, (steps, columns) arrays by key."""
        for probe, (key, parts) in columns.items():
            history = histories[key]
            for output, part in zip(self.kept[probe], parts):
                output.append(history[:steps, part])

    def clear_probe(self, probe):
        for output in self.kept[probe]:
            output.clear()


class _Outputs(Mapping):
    """Probe to the values of each of its blocks: a (steps, compartments) array, [] for no steps."""

    def __init__(self, kept):
        self._kept = kept

    def __getitem__(self, probe):
        return [_joined(output) for output in self._kept[probe]]

    def __iter__(self):
        return iter(self._kept)

    def __len__(self):
        return len(self._kept)


def _joined(parts):
    if len(parts) > 1:
        parts[:] = [np.concatenate(parts)]
    elif parts:
        parts[0] = np.ascontiguousarray(parts[0])
    return parts[0] if parts else []


# --- Taking over and handing over -----------------------------------------------------------------


def take_over(emulator, kind=FastEmulator):
    """Let an emulator of NengoLoihi's go on with the kernel, whatever steps it has done.

    It is left as it is, with one warning, where Numba is missing or its network has something that
    the kernel does not do.

    Parameters
    ----------
    emulator : EmulatorInterface
    kind : type
        `FastEmulator` or a class derived from it.
    """
    emulator.__dict__["_link"] = None
    kernel = find_kernel()
    try:
        if kernel is None:
            raise Unforeseen
        link = _Link(emulator, kernel)
    except Unforeseen as reason:
        emulator.__class__ = EmulatorInterface
        if kernel is not None:
            say_once(f"NengoLoihi's own emulator is used, for {reason}")
        return
    emulator.__class__ = kind
    _connect(emulator, link)


def _connect(emulator, link):
    """Let an emulator use the arrays of a link, which have its state."""
    state, synapses, probes = emulator.compartment, emulator.synapses, emulator.probes
    vars(state).update(link.state_arrays())
    _set_writeable(emulator, False)
    link.learn_from(synapses)
    lists = vars(probes).pop("outputs")
    probes.kept = {
        probe: [[np.stack(part)] if len(part) else [] for part in parts]
        for probe, parts in lists.items()
    }
    vars(synapses).pop("spikes_in")
    vars(synapses).pop("trace_spikes")
    synapses.link = link
    state.__class__, synapses.__class__, probes.__class__ = _Compartments, _Synapses, _Probes
    emulator.__dict__["_link"] = link


def _disconnect(emulator):
    """The opposite: everything is where NengoLioihi's own steps look for it."""
    link = emulator._link
    link.settle_random(emulator.block_info.n_compartments)
    state, synapses, probes = emulator.compartment, emulator.synapses, emulator.probes
    trace_spikes, spikes_in = synapses.trace_spikes, synapses.spikes_in
    lists = {probe: [list(part) for part in parts] for probe, parts in probes.outputs.items()}
    state.__class__, synapses.__class__, probes.__class__ = (
        CompartmentState,
        SynapseState,
        ProbeState,
    )
    synapses.trace_spikes, synapses.spikes_in, probes.outputs = trace_spikes, spikes_in, lists
    del synapses.link, probes.kept
    _set_writeable(emulator, True)
    emulator.__class__ = EmulatorInterface
    emulator._link = None


def _set_writeable(emulator, is_so):
    """What the kernel has a copy of: to change it would have no effect."""
    for name in FIXED:
        getattr(emulator.compartment, name).flags.writeable = is_so
    for synapse in emulator.synapses.slices:
        if not synapse.learning:
            for weights in synapse.weights:
                weights.flags.writeable = is_so


def hand_over(emulator, reason):
    """Let an emulator go on with NengoLoihi's own steps, and say so once."""
    _disconnect(emulator)
    say_once(f"NengoLoihi's own emulator goes on, for {reason}")


def one_step_as_nengo_loihi(emulator):
    """A step of NengoLoihi's own, after which the kernel goes on; after an error it does not."""
    link, kind = emulator._link, type(emulator)
    spiked, t = emulator.compartment.spiked.copy(), emulator.t
    last = [(item, item.spikes.get(t, [])) for item in emulator.inputs]
    _disconnect(emulator)
    EmulatorInterface.step(emulator)
    link.last_spikes = [spikes for _, spikes in last]
    link.before[: len(spiked)] = spiked
    link.pending[:] = 0
    for synapse, first in link.first_trace.items():
        link.pending[[first + axon for axon in emulator.synapses.trace_spikes[synapse]]] = 1
    emulator.__class__ = kind
    _connect(emulator, link)


def _words(rng):
    """The memory of a `RandomState`: 624 words of 32 bits and the position of the next one."""
    name, words, position, *_ = rng.get_state()
    if name == "MT19937":
        address = rng._bit_generator.ctypes.state_address
        memory = np.ctypeslib.as_array((ctypes.c_uint32 * 625).from_address(address))
        if np.array_equal(memory, np.append(words, position).astype(np.uint32)):
            return memory
    raise Unforeseen("random numbers that NumPy keeps in another way")


class _Link:
    """The arrays of the kernel for one emulator.

    Attributes
    ----------
    layout : Layout
    cells, counters, spiked, before, traces, pending, errors, wide : ndarray
        The state: see the kernel.  ``before`` are the spikes before the last step.
    last_spikes : list
        Of each input, the spikes that arrived in the last step.
    draws : bool
        Whether anything depends on random numbers; else the kernel leaves them out.
    owed : int
        Steps whose random numbers were left out.
    """

    def __init__(self, emulator, kernel):
        if type(emulator.compartment) is not CompartmentState:
            raise Unforeseen(f"compartments of the class {type(emulator.compartment).__name__}")
        self.layout = layout = make_layout(emulator)
        self.words = _words(vars(emulator)["rng"])
        state, synapses = emulator.compartment, emulator.synapses
        n, dtype = emulator.block_info.n_compartments, state.dtype
        integers = dtype == np.int32
        self._kernel = kernel
        self._advance = kernel.advance_integers if integers else kernel.advance_floats
        self._skip = (kernel.skip_samples, n) if integers else (kernel.skip_words, 2 * n)
        self.cells = np.zeros((len(ROWS), n), dtype)
        self.counters = np.zeros((len(COUNTERS), n), np.int32)
        for row, name in enumerate(ROWS):
            self.cells[row] = getattr(state, name).reshape(n)
        for row, name in enumerate(COUNTERS):
            self.counters[row] = getattr(state, name)
        # The kernel looks at eight spikes at a time.
        self.spiked, self.before = (np.zeros(-(-n // 8) * 8, np.uint8) for _ in range(2))
        self.spiked[:n] = state.spiked
        self._n = n
        sizes = [s.n_axons for s in synapses.traces]
        self.first_trace = dict(zip(synapses.traces, np.cumsum([0, *sizes]).tolist()))
        self.traces, self.pending = np.zeros(sum(sizes), dtype), np.zeros(sum(sizes), np.uint8)
        self.errors = np.zeros(sum(map(len, synapses.pes_errors.values())), dtype)
        error = 0
        for s, first in self.first_trace.items():
            self.traces[first : first + s.n_axons] = synapses.traces[s]
            self.pending[[first + axon for axon in synapses.trace_spikes[s]]] = 1
            self.errors[error : error + len(synapses.pes_errors[s])] = synapses.pes_errors[s]
            error += len(synapses.pes_errors[s])
        self.wide = layout.network[8]
        self.draws = bool(layout.is_noisy or (integers and sizes))
        self.owed = 0
        self.has_probes = bool(layout.columns)
        self._spikes_in = synapses.spikes_in  # of a step before the first of ours
        self.last_spikes = None
        self.at_once = max(
            1, min(AT_ONCE // max(n, 1000), HISTORY // max(1, 4 * sum(layout.widths)))
        )
        self.log = np.zeros((LOG + 3 * len(sizes), 2), np.int64)
        self._types = [dtype, dtype, np.uint8]
        self._empty = [np.zeros((1, 0), kind) for kind in self._types]
        self.histories = self._empty
        self._inputs, self._axons = list(emulator.inputs), emulator.axons
        most = max([s.n_axons * max(1, len(e) * 2) for s, e in synapses.pes_errors.items()] + [n])
        scratch = (
            np.zeros(n, np.int64),  # events
            np.zeros(len(emulator.block_info.blocks) + 1, np.int64),  # their ends
            np.zeros(len(self.spiked) // 8 + 1, np.int32),  # words in use
            np.zeros((len(emulator.block_info.blocks), 2), np.int64),
            np.zeros(len(sizes), np.int64),  # spikes lost
            np.zeros(len(layout.network[0]), np.uint8),  # whether a segment waits
            np.zeros(2 * most, np.uint32),  # random numbers
            np.zeros(most, dtype),
            np.zeros(n, dtype),
        )
        self._arguments = (
            self.cells, self.counters, self.spiked, self.spiked.view(np.uint64), self.before,
            *layout.network, *layout.learning, self.traces, self.pending, self.errors,
            *layout.noise, *scratch,
        )  # fmt: skip

    def state_arrays(self):
        """The arrays of the compartments, by their names in NengoLoihi."""
        arrays = dict(zip(ROWS, self.cells))
        arrays.update(zip(COUNTERS, self.counters))
        arrays["input"] = arrays["input"].reshape(1, -1)
        arrays["spiked"] = self.spiked[: self._n].view(bool)
        return arrays

    def learn_from(self, synapses):
        """Make traces, errors and weights of the synapses that learn parts of ours."""
        error = 0
        for s, first in self.first_trace.items():
            n_errors = len(synapses.pes_errors[s])
            synapses.traces[s] = self.traces[first : first + s.n_axons]
            synapses.pes_errors[s] = self.errors[error : error + n_errors]
            error += n_errors
            s.weights[:] = self.layout.weights[s]

    def run(self, emulator, steps, arriving, careful):
        """Call the kernel; how many steps it did."""
        layout = self.layout
        if self.has_probes:
            self.histories = [
                np.empty((steps, width), kind) if width else empty
                for width, kind, empty in zip(layout.widths, self._types, self._empty)
            ]
        self.log[0, 0] = 0
        done = self._advance(
            *self._arguments, self.words, layout.recorded, layout.is_noisy, self.draws,
            emulator.t, steps, arriving.spikes, arriving.ends, *self.histories, self.log, careful,
        )  # fmt: skip
        if done < 0:
            raise Unforeseen("spikes of neurons that an input does not have, or a voltage of -2**31")
        return done

    def copy(self):
        """What a call of the kernel changes."""
        learned = self.wide if len(self.traces) else _NOTHING
        changed = (self.cells, self.counters, self.spiked, self.before, self.traces, self.pending)
        return [array.copy() for array in (*changed, learned, self.words)]

    def restore(self, kept):
        learned = self.wide if len(self.traces) else _NOTHING
        changed = (self.cells, self.counters, self.spiked, self.before, self.traces, self.pending)
        for array, before in zip((*changed, learned, self.words), kept):
            array[...] = before

    def settle_random(self, n):
        """Draw the random numbers that were left out."""
        if self.owed:
            skip, each = self._skip
            skip(self.words, each * self.owed)
            self.owed = 0

    def trace_spikes(self, synapses):
        return {
            s: set(np.flatnonzero(self.pending[first : first + s.n_axons]).tolist())
            for s, first in self.first_trace.items()
        }

    def spikes_in(self, synapses):
        """Worked out by NengoLoihi's own method, from the spikes before the last step."""
        if self.last_spikes is None:
            return self._spikes_in
        sources = [
            SimpleNamespace(axons=item.axons, spike_idxs=lambda t, spikes=spikes: spikes)
            for item, spikes in zip(self._inputs, self.last_spikes)
        ]
        found = SimpleNamespace(spikes_in={s: [] for s in synapses.slices})
        spiked = self.before[: self._n].view(bool)
        SynapseState.inject_current(found, 2, sources, self._axons, spiked)
        return found.spikes_in


class _Arriving:
    """The spikes of the inputs that arrive in some steps; those sent in a step do in the next.

    Attributes
    ----------
    spikes : int64 array
        Of all steps, one input after the other in each.
    ends : (n_steps * n_inputs + 1,) int64 array
        Where those of each step and input end, after a 0.
    """

    def __init__(self, inputs, t, steps):
        self._t, self._n = t, len(inputs)
        self._lists = [
            item.spikes.get(sent, []) if sent else []
            for sent in range(t, t + steps)
            for item in inputs
        ]
        self.ends = np.zeros(len(self._lists) + 1, np.int64)
        self.ends[1:] = np.cumsum([len(spikes) for spikes in self._lists])
        found = [np.asarray(spikes) for spikes in self._lists if len(spikes)]
        if any(spikes.dtype.kind not in "iu" or spikes.ndim != 1 for spikes in found):
            raise Unforeseen("spikes of an input that are not numbered by integers")
        spikes = found[0] if len(found) == 1 else np.concatenate(found) if found else _NOTHING
        self.spikes = np.ascontiguousarray(spikes, np.int64)

    def of_step(self, step):
        """The spikes of each input in a step."""
        return self._lists[step * self._n : (step + 1) * self._n]

    def forget(self, inputs, done):
        """Delete the spikes of the first steps, as NengoLoihi does after use."""
        for item in inputs:
            for sent in range(max(self._t, 1), self._t + done):
                if sent not in item.permanent:
                    item.spikes.pop(sent, None)
