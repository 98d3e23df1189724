"""NengoLoihi's emulator with compiled steps: the same methods, bit-identical results.

NengoLoihi's own class makes the arrays of the chip's state.  They become views of the
arrays of the compiled steps, so that other code can still read them or change them in place.
Values that only NengoLoihi's steps use (the spikes of the last step, random numbers that nothing
depends on) are computed on request.

In two cases NengoLoihi's own steps run, so that no result can differ: for networks that `layout`
does not support (`Unsupported`), and for a step with a warning that should be an error.
"""

from __future__ import annotations

import copy
import warnings
from typing import Mapping, Set

import numpy as np
from nengo_loihi.emulator import interface
from nengo_loihi.emulator.interface import (
    CompartmentState,
    EmulatorInterface,
    NoiseState,
    ProbeState,
    SynapseState,
)

from .arrays import COUNTERS, ROWS, ArrivingSpikes, EmulatorArrays
from .layout import Unsupported

FIXED = ("decay_u", "decay_v", "scale_u", "scale_v", "vmin", "vmax", "ref")
FIXED_NOISE = ("mant_offset", "mult", "target_u")

LOST, TRACE, WEIGHTS, OVERFLOWS = range(4)  # in the log of the compiled steps


class NotAccelerated(UserWarning):
    """Warning: NengoLoihi's own, slower code runs a network; the results are the same."""


_warned: Set[str] = set()


def warn_once(message):
    """Warn, unless the same warning was given before in this process."""
    if message not in _warned:
        _warned.add(message)
        warnings.warn(message, NotAccelerated, stacklevel=3)


class FastEmulator(EmulatorInterface):
    """NengoLoihi's `EmulatorInterface` with compiled steps, for any of its models.

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
        random = self.__dict__.get("_random")
        if random is not None:
            random.share()
        return self.__dict__["rng"]

    @rng.setter
    def rng(self, rng):
        self.__dict__["rng"] = rng
        if self.__dict__.get("_arrays") is not None:
            try:
                self._random.draw_from(rng)
            except Unsupported as reason:
                hand_over(self, reason)
            else:
                self._random.share()

    def __deepcopy__(self, memo):
        """Copy the state as NengoLoihi keeps it; the copy has arrays of its own."""
        arrays = self._arrays
        kind = type(self)
        if arrays is None:
            raise TypeError("a closed emulator cannot be copied")
        _disconnect(self)
        try:
            other = copy.deepcopy(self, memo)
        finally:
            self.__class__ = kind
            _connect(self, arrays)
        take_over(other, kind)
        return other

    def close(self):
        if self._arrays is not None:
            _unlock(self._arrays)
        super().close()
        self._arrays = None

    def step(self):
        if self._arrays is not None:
            self.run_steps(1)
        else:
            super().step()

    def run_steps(self, steps):
        steps = len(range(steps))
        while steps > 0 and isinstance(self, FastEmulator) and self._arrays is not None:
            steps -= self._advance(min(steps, self._arrays.at_once))
        if steps > 0:
            EmulatorInterface.run_steps(self, steps)

    def _advance(self, steps):
        """Advance by some steps, at least one if there is no error; return their number."""
        arrays = self._arrays
        careful = bool(self.compartment.strict or self.synapses.strict or _warnings_are_errors())
        state = arrays.copy() if careful else None
        try:
            arriving = ArrivingSpikes(self.inputs, self.t, steps)
            done = arrays.run(self, steps, arriving, careful)
        except Unsupported as reason:
            hand_over(self, reason)
            return 0
        if careful and arrays.log[0, 0]:
            arrays.restore(state)
            if done > 1:
                arrays.run(self, done - 1, arriving, False)
                self._finish(done - 1, arriving)
            run_step_as_nengo_loihi(self)
            return done
        self._finish(done, arriving)
        return done

    def _finish(self, done, arriving):
        """Store the probed values of some steps, and issue the warnings of these steps."""
        arrays = self._arrays
        self.t += done
        arriving.forget(self.inputs, done)
        arrays.last_spikes = arriving.get_spikes(done - 1)
        if not arrays.draws:
            arrays.random.owed += done
            if arrays.random.is_shared:
                arrays.random.settle()
        if arrays.has_probes:
            current, voltage, spikes = arrays.histories
            histories = (current, voltage, spikes.view(bool))
            self.probes.keep(arrays.layout.columns, histories, done)
        if arrays.log[0, 0]:
            for kind, count in arrays.log[1 : arrays.log[0, 0] + 1].tolist():
                _warn(self, kind, count)


def _warn(emulator, kind, count):
    """Issue the warnings in the log of the compiled steps as NengoLoihi does, from its module."""
    if kind == OVERFLOWS:
        for bit, number in enumerate(("q0", "current", "u2")):
            if count & 1 << bit:
                emulator.compartment.error(f"Overflow in {number}")
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
    """True if a filter turns a `UserWarning` into an error."""
    for entry in warnings.filters:  # a loop is fast, and this runs before every call
        if entry[0] == "error" and issubclass(UserWarning, entry[2]):
            return True
    return False


# --- NengoLoihi's parts, which compute on request what is not stored ------------------------------


class _Compartments(CompartmentState):
    """State arrays: an array that is assigned to one of them is copied into it."""

    def __setattr__(self, name, value):
        if name in (*ROWS, *COUNTERS, "spiked"):
            self.__dict__[name][...] = value
        elif name in (*FIXED, "noise"):
            raise ValueError(f"{name} is compiled in and cannot be replaced")
        else:
            super().__setattr__(name, value)


class _Noise(NoiseState):
    """Parameters of noise, which cannot be replaced."""

    def __setattr__(self, name, value):
        if name in FIXED_NOISE:
            raise ValueError(f"{name} is compiled in and cannot be replaced")
        super().__setattr__(name, value)


class _Synapses(SynapseState):
    """Spikes of the last step, and those that wait for a trace, in NengoLoihi's format."""

    @property
    def trace_spikes(self):
        return self.fast_arrays.trace_spikes(self)

    @property
    def spikes_in(self):
        return self.fast_arrays.spikes_in(self)


class _Probes(ProbeState):
    """Probed values, stored as one array for many steps instead of a list of steps."""

    @property
    def outputs(self):
        return _Outputs(self.recorded)

    def keep(self, columns, histories, steps):
        """Append the values of some steps, (steps, columns) arrays by key."""
        for probe, (key, parts) in columns.items():
            history = histories[key]
            for output, part in zip(self.recorded[probe], parts):
                output.append(history[:steps, part])

    def clear_probe(self, probe):
        for output in self.recorded[probe]:
            output.clear()


class _Outputs(Mapping):
    """For each probe the values of its blocks: (steps, compartments) arrays, [] for no steps."""

    def __init__(self, recorded):
        self._recorded = recorded

    def __getitem__(self, probe):
        return [_concatenate(output) for output in self._recorded[probe]]

    def __iter__(self):
        return iter(self._recorded)

    def __len__(self):
        return len(self._recorded)


def _concatenate(parts):
    if len(parts) > 1:
        parts[:] = [np.concatenate(parts)]
    elif parts:
        parts[0] = np.ascontiguousarray(parts[0])
    return parts[0] if parts else []


# --- Taking over and handing over -----------------------------------------------------------------


def take_over(emulator, kind=FastEmulator):
    """Let an emulator of NengoLoihi continue with the compiled steps, after any number of its own.

    The emulator is not changed, and one warning is given, if its network has a feature that the
    compiled steps do not support.

    Parameters
    ----------
    emulator : EmulatorInterface
    kind : type
        `FastEmulator` or a class derived from it.
    """
    emulator.__dict__["_arrays"] = emulator.__dict__["_random"] = None
    try:
        arrays = EmulatorArrays(emulator)
    except Unsupported as reason:
        emulator.__class__ = EmulatorInterface
        warn_once(f"NengoLoihi's own emulator is used, because of {reason}")
        return
    emulator.__class__ = kind
    _connect(emulator, arrays)


def _connect(emulator, arrays):
    """Let an emulator use arrays that have its state."""
    state = emulator.compartment
    synapses = emulator.synapses
    probes = emulator.probes
    vars(state).update(arrays.list_state_arrays())
    _lock(emulator, arrays)
    arrays.learn_from(synapses)
    lists = vars(probes).pop("outputs")
    probes.recorded = {probe: _stack_parts(parts) for probe, parts in lists.items()}
    vars(synapses).pop("spikes_in")
    vars(synapses).pop("trace_spikes")
    synapses.fast_arrays = arrays
    state.__class__ = _Compartments
    synapses.__class__ = _Synapses
    probes.__class__ = _Probes
    state.noise.__class__ = _Noise
    emulator.__dict__["_arrays"] = arrays
    emulator.__dict__["_random"] = arrays.random


def _stack_parts(parts) -> list:
    """The outputs of a probe's parts, a list of at most one array for each."""
    return [[np.stack(part)] if len(part) else [] for part in parts]


def _disconnect(emulator):
    """The inverse of `_connect`: NengoLoihi's own steps find all arrays where they expect them."""
    arrays = emulator._arrays
    arrays.random.settle()
    state = emulator.compartment
    synapses = emulator.synapses
    probes = emulator.probes
    trace_spikes = synapses.trace_spikes
    spikes_in = synapses.spikes_in
    lists = {probe: list(map(list, parts)) for probe, parts in probes.outputs.items()}
    state.__class__ = CompartmentState
    synapses.__class__ = SynapseState
    probes.__class__ = ProbeState
    state.noise.__class__ = NoiseState
    synapses.trace_spikes = trace_spikes
    synapses.spikes_in = spikes_in
    probes.outputs = lists
    del synapses.fast_arrays, probes.recorded
    _unlock(arrays)
    emulator.__class__ = EmulatorInterface
    emulator._arrays = emulator._random = None


def _lock(emulator, arrays):
    """Protect the arrays that were copied: changing them would have no effect."""
    state = emulator.compartment
    copied = [getattr(state, name) for name in FIXED]
    copied += [getattr(state.noise, name) for name in FIXED_NOISE]
    for synapse in emulator.synapses.slices:
        copied += synapse.indices
        if not synapse.learning:
            copied += synapse.weights
    for source in (*emulator.inputs, *emulator.block_info.blocks):
        for axon in source.axons:
            maps = (axon.compartment_map, axon.compartment_atoms)
            copied += [array for array in maps if array is not None]
    arrays.locked = [array for array in copied if array.flags.writeable]
    for array in arrays.locked:
        array.flags.writeable = False


def _unlock(arrays):
    for array in arrays.locked:
        array.flags.writeable = True


def hand_over(emulator, reason):
    """Let an emulator continue with NengoLoihi's own steps, with one warning."""
    _disconnect(emulator)
    warn_once(f"NengoLoihi's own emulator continues, because of {reason}")


def run_step_as_nengo_loihi(emulator):
    """Run one step of NengoLoihi; the compiled ones continue afterwards, unless it failed."""
    arrays = emulator._arrays
    kind = type(emulator)
    spiked = emulator.compartment.spiked.copy()
    t = emulator.t
    last = [(item, item.spikes.get(t, [])) for item in emulator.inputs]
    _disconnect(emulator)
    EmulatorInterface.step(emulator)
    arrays.last_spikes = [spikes for _, spikes in last]
    arrays.before[: len(spiked)] = spiked
    arrays.pending[:] = 0
    for synapse, first in arrays.first_trace.items():
        arrays.pending[[first + axon for axon in emulator.synapses.trace_spikes[synapse]]] = 1
    emulator.__class__ = kind
    _connect(emulator, arrays)
