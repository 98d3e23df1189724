"""The host's part for many streams at once: neurons before the chip, output after it.

Neurons and filters use Nengo's own step functions on arrays of shape (n_streams, n).  These are
elementwise, so that the result of each stream is bit-identical to Nengo's.
"""

from __future__ import annotations

from typing import NamedTuple, Optional

import nengo
import numpy as np

from ...network.build import EvenSpikes, Relay


class HostNeurons(NamedTuple):
    """A population of spiking neurons on the host.

    Attributes
    ----------
    label : str
    neuron_type : nengo.neurons.NeuronType
    initial : dict of str to (n,) array
        State at the start of a stream.
    synapse : nengo.Lowpass or None
        Filter between the drive and the current.
    gain, bias : (n,) array
        With a filter the current is ``bias + gain * filtered``; without one the drive is the
        current.
    """

    label: str
    neuron_type: nengo.neurons.NeuronType
    initial: dict
    synapse: Optional[nengo.Lowpass]
    gain: np.ndarray
    bias: np.ndarray

    @property
    def n(self):
        """Number of neurons."""
        return len(self.bias)


class HostOutput(NamedTuple):
    """The output stage: from the chip's spikes to the value of the output probe.

    Attributes
    ----------
    decoders : (n, n_outputs) array
        Contribution of each compartment's spike to the output in its step.
    on_chip : bool
        True if the output is read on the chip, in the chip's own step and unfiltered.
    parts : tuple of (int array, (n_part, n_outputs) array)
        The same decoders by block, as NengoLoihi multiplies them; empty on the chip.
    synapse : nengo.Lowpass or None
    neurons : HostNeurons or None
        Neurons on the host that are driven by the output and probed instead.
    """

    decoders: np.ndarray
    on_chip: bool
    parts: tuple = ()
    synapse: Optional[nengo.Lowpass] = None
    neurons: Optional[HostNeurons] = None


class Filter:
    """A synapse, or none, with Nengo's delay of one step."""

    def __init__(self, synapse, shape, dt):
        self._value = np.zeros(shape)
        self._step = None
        if synapse is not None:
            state = synapse.make_state(shape, shape, dt, dtype=self._value.dtype)
            self._step = synapse.make_step(shape, shape, dt, rng=None, state=state)

    def __call__(self, value):
        """Output at this step, given its input; both (n_streams, n)."""
        if self._step is None:
            return value
        out = self._value
        self._value = np.array(self._step(None, value))
        return out


class Population:
    """The state of host neurons for several streams."""

    def __init__(self, neurons: HostNeurons, n_streams, dt):
        self.neurons, self._dt = neurons, dt
        shape = (n_streams, neurons.n)
        self._state = {k: np.tile(v, (n_streams, 1)) for k, v in neurons.initial.items()}
        self._output = np.zeros(shape)
        self._filter = Filter(neurons.synapse, shape, dt)

    def spikes(self, drive, n_steps, out):
        """Spikes of several steps with a constant drive.

        Parameters
        ----------
        drive : (n_streams, n) array
        n_steps : int
        out : (n_streams, n_steps, n) uint8 array
            Set to 1 where a neuron spikes, else to 0.
        """
        rectified = type(self.neurons.neuron_type) in (nengo.SpikingRectifiedLinear, EvenSpikes)
        if rectified and not self.filtered:
            self._rectified(drive, n_steps, out)
            return
        if type(self.neurons.neuron_type) is Relay and not self.filtered:
            out[:] = (drive > 0)[:, None]
            return
        for step in range(n_steps):
            current = self.current(self._filter(drive)) if self.filtered else drive
            np.not_equal(self.step(current), 0, out=out[:, step])

    def _rectified(self, drive, n_steps, out):
        """The step of `nengo.SpikingRectifiedLinear` and `EvenSpikes` for a constant drive."""
        voltage = self._state["voltage"]
        increase = np.maximum(drive, 0) * self._dt
        whole = np.empty_like(voltage)
        blank = phase = None
        if type(self.neurons.neuron_type) is EvenSpikes:
            blank, phase = drive <= 0, self.neurons.neuron_type.phase
        for step in range(n_steps):
            voltage += increase
            np.floor(voltage, out=whole)
            voltage -= whole
            np.not_equal(whole, 0, out=out[:, step])
            if blank is not None:
                np.putmask(voltage, blank, phase)

    @property
    def filtered(self):
        """True if the current is filtered."""
        return self.neurons.synapse is not None

    def step(self, current):
        """Advance one step.

        Parameters
        ----------
        current : (n_streams, n) array

        Returns
        -------
        (n_streams, n) array
            ``amplitude / dt`` for each spike in the step; overwritten in the next step.
        """
        with np.errstate(divide="ignore"):
            self.neurons.neuron_type.step(self._dt, current, self._output, **self._state)
        return self._output

    def current(self, value):
        """``bias + gain * value``."""
        return self.neurons.bias + self.neurons.gain * value


class HostSide:
    """The state of the input neurons for several streams.

    Parameters
    ----------
    program : Program
    n_streams : int
    size : int
        Number of values of a frame.
    """

    def __init__(self, program, n_streams, size):
        self._program = program
        self._populations = [
            Population(neurons, n_streams, program.dt) for neurons in program.inputs
        ]
        self._blank = np.repeat(program.drive(np.zeros((1, size))), n_streams, axis=0)
        self._frames = self._drive = None

    def take(self, samples):
        """Set the current sample of each stream: (n_streams, size) or (..., steps, size)."""
        static = samples.ndim == 2
        self._frames = None if static else samples
        self._drive = self._program.drive(samples) if static else None

    def spikes(self, first, last):
        """Spikes of several steps of the sample.

        Parameters
        ----------
        first, last : int
            First step, and one past the last, counted from the start of the sample's presentation;
            negative in the gap before it.

        Returns
        -------
        (n_streams, last - first, n_inputs) uint8 array
        """
        n_streams, n_inputs = self._blank.shape
        spikes = np.empty((n_streams, last - first, n_inputs), np.uint8)
        dark = min(max(-first, 0), last - first)
        self._advance(self._blank, spikes[:, :dark])
        if self._frames is None:
            self._advance(self._drive, spikes[:, dark:])
        elif self._program.relays:
            np.greater(self._frames[:, first + dark : last], 0, out=spikes[:, dark:].view(bool))
        else:
            for step in range(first + dark, last):
                drive = self._program.drive(self._frames[:, step])
                self._advance(drive, spikes[:, step - first : step - first + 1])
        return spikes

    def _advance(self, drive, out):
        """Run steps with a constant drive."""
        column = 0
        for population in self._populations:
            part = slice(column, column + population.neurons.n)
            population.spikes(drive[:, part], out.shape[1], out[:, :, part])
            column = part.stop


class OutputStage:
    """The state of the output stage for several streams."""

    def __init__(self, output: HostOutput, n_streams, dt):
        self._output = output
        self._last = None
        self._filter = Filter(output.synapse, (n_streams, output.decoders.shape[1]), dt)
        self._neurons = output.neurons and Population(output.neurons, n_streams, dt)

    def advance(self, spikes, decoded):
        """Values of the output probe in several steps.

        Parameters
        ----------
        spikes : (n_streams, n_steps, n) uint8 array
            The chip's spikes.
        decoded : (n_streams, n_steps, n_outputs) array
            The same spikes times the decoders.

        Returns
        -------
        (n_streams, n_steps, n_outputs) array
        """
        if self._output.on_chip:
            return decoded
        if self._neurons is not None:
            decoded = self._as_nengo_loihi_adds(spikes)
        # The host receives the chip's step k - 1 in its own step k.  Only its first step, which has
        # no predecessor, receives the chip's first (nengo_loihi.builder.inputs.EmptyQueueStep).
        first = decoded[:, :1] if self._last is None else self._last
        self._last = decoded[:, -1:].copy()
        values = np.concatenate([first, decoded[:, :-1]], axis=1)
        if self._output.synapse is None and self._neurons is None:
            return values
        for step in range(values.shape[1]):
            value = self._filter(np.ascontiguousarray(values[:, step]))
            if self._neurons is not None:
                value = self._neurons.step(self._neurons.current(value))
            values[:, step] = value
        return values

    def _as_nengo_loihi_adds(self, spikes):
        """Decoded values that are bit-identical to NengoLoihi's: one product per stream and block.

        The last bit matters: it can change the spikes of a spiking neuron on the host.
        """
        streams = []
        for stream in spikes.astype(bool):
            blocks = [(np.ascontiguousarray(stream[:, i]), w) for i, w in self._output.parts]
            streams.append(sum(block.dot(weights) for block, weights in blocks))
        return np.stack(streams)
