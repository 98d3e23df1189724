"""The equations of the chip in NumPy, which every target computes.

In each time step a layer of neurons computes (Davies et al. 2018, Section "Neuron model";
NengoLoihi 1.1, ``emulator/interface.py``, ``CompartmentState.update``)::

    u(t) = cut(keep_u u(t-1)) + input_scale * sums(t)        the current
    v(t) = max(cut(keep_v v(t-1)) + u(t) + bias, floor)      the voltage; 0 while the neuron waits
    s(t) = 1 where v(t) > threshold, and then v(t) = 0       the spikes

``sums(t)`` are the weighted sums (:meth:`deploy.network.layer.Layer.compute_sums`) of the spikes
that arrive; a spike arrives one step after it was sent, at the next layer and at the layer itself
if it is recurrent.  After a spike a neuron waits some steps, its refractory period.  In the chip's
integers ``cut`` rounds toward zero, and the shares that remain, keep_u and keep_v, are multiples of
1/4096; in real numbers there is no rounding.

:func:`run_reference` is a whole target of these equations in real numbers.  The chip's integers are
those that NengoLoihi's builder makes (``builder/discretize.py``); :func:`read_equations` takes them
from there, and :mod:`models.rounding` chooses them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, Union

import numpy as np

from .chip import DT, LOIHI
from .layer import Layer
from .output import TargetOutput
from .spec import NetworkSpec


@dataclass(frozen=True)
class NeuronEquations:
    """The numbers in the equations of a layer's neurons; see the module's docstring.

    Attributes
    ----------
    keep_u, keep_v : float
        Shares of current and voltage that remain after a step.
    bias, threshold : float or ndarray, shape (neurons,)
    floor : float
    input_scale : float
        Factor of the weighted sums.
    waiting_steps : int
        Refractory period in steps after that of the spike.
    is_integer : bool
        True if what remains is rounded toward zero.
    """

    keep_u: float
    keep_v: float
    bias: Union[float, np.ndarray]
    threshold: Union[float, np.ndarray] = 1.0
    floor: float = -np.inf
    input_scale: float = 1.0
    waiting_steps: int = 0
    is_integer: bool = False

    def compute_spikes(self, sums: np.ndarray, recurrent_kernel=None) -> np.ndarray:
        """Spikes of a layer from rest.

        Parameters
        ----------
        sums : ndarray, shape (steps, ..., neurons)
            Weighted sums of the spikes that arrive in each step.
        recurrent_kernel : ndarray, shape (neurons, neurons), optional
            Weights of the layer's own spikes, by sending and receiving neuron.

        Returns
        -------
        ndarray of bool, shape (steps, ..., neurons)
        """
        u = np.zeros(sums.shape[1:])
        v = np.zeros(sums.shape[1:])
        waiting = np.zeros(sums.shape[1:], int)
        spikes = np.zeros(sums.shape, bool)
        for t in range(len(sums)):
            u = self._cut(u * self.keep_u) + sums[t] * self.input_scale
            if recurrent_kernel is not None and t:
                u = u + spikes[t - 1].astype(float) @ recurrent_kernel * self.input_scale
            v = np.maximum(self._cut(v * self.keep_v) + u + self.bias, self.floor)
            v[waiting > 0] = 0
            spikes[t] = v > self.threshold
            v[spikes[t]] = 0
            waiting = np.where(spikes[t], self.waiting_steps, np.maximum(waiting - 1, 0))
        return spikes

    def _cut(self, values):
        return np.trunc(values) if self.is_integer else values


def derive_equations(layer: Layer, area: float) -> NeuronEquations:
    """The equations of a layer of neurons in real numbers, in units of its threshold.

    Parameters
    ----------
    layer : Layer
        A layer with neurons.
    area : float
        Area of a spike that arrives: the stimulus's, or the amplitude of the layer before.
    """
    neurons = layer.neurons
    assert neurons is not None, f"layer {layer.name!r}: has no neurons"
    keep_u = 0.0 if layer.synapse is None else float(np.exp(-DT / layer.synapse))
    keep_v = float(np.exp(-DT / neurons.tau_rc))
    return NeuronEquations(
        keep_u=keep_u,
        keep_v=keep_v,
        bias=(1 - keep_v) * np.tile(layer.bias, layer.size // len(layer.bias)),
        floor=neurons.min_voltage,
        input_scale=(1 - keep_u) * (1 - keep_v) * area / DT,
        waiting_steps=round(neurons.tau_ref / DT),
    )


def read_equations(compartment) -> NeuronEquations:
    """The equations of a block of neurons in the chip's integers.

    Parameters
    ----------
    compartment : nengo_loihi.block.Compartment
        Of a block that NengoLoihi's builder has discretised.  The sums are those of its integer
        weights.
    """
    return NeuronEquations(
        keep_u=(LOIHI.decay_levels - int(compartment.decay_u[0])) / LOIHI.decay_unit,
        keep_v=(LOIHI.decay_unit - int(compartment.decay_v[0])) / LOIHI.decay_unit,
        bias=compartment.bias.astype(float),
        threshold=compartment.vth.astype(float),
        floor=float(compartment.vmin),
        waiting_steps=int(compartment.refract_delay[0]) - 1,
        is_integer=True,
    )


class InputNeurons:
    """The neurons on the host that make spikes of images or frames, for several streams.

    A neuron of an image integrates ``max_rate`` times its pixel and spikes evenly
    (:class:`deploy.network.stimulus.ImageSpikes`); one of frames of events spikes in each step with
    an event.

    Parameters
    ----------
    stimulus : Stimulus
    n_streams, size : int
        Number of streams, and of values of a frame.
    """

    def __init__(self, stimulus, n_streams, size):
        self._is_static = stimulus.is_static
        self._max_rate = stimulus.max_rate if self._is_static else 0.0
        self._phase = stimulus.initial_phase if self._is_static else 0.0
        self._voltage = np.full((n_streams, size), self._phase, float)
        self._frames = None

    def set_samples(self, samples):
        """Set the current sample of each stream: (n_streams, size) or (..., steps, size)."""
        self._frames = samples

    def make_spikes(self, first, last):
        """Spikes of several steps of the sample.

        Parameters
        ----------
        first, last : int
            First step, and one past the last, counted from the start of the sample's presentation;
            negative in the gap before it.

        Returns
        -------
        (n_streams, last - first, size) uint8 array
        """
        n_streams, size = self._voltage.shape
        spikes = np.zeros((n_streams, last - first, size), np.uint8)
        n_silent_steps = min(max(-first, 0), last - first)
        if not self._is_static:
            frames = self._frames[:, first + n_silent_steps : last]
            np.greater(frames, 0, out=spikes[:, n_silent_steps:].view(bool))
            return spikes
        if n_silent_steps:  # no input resets the phase
            self._voltage[:] = self._phase
        self._make_even_spikes(self._frames, spikes[:, n_silent_steps:])
        return spikes

    def _make_even_spikes(self, frame, out):
        """The steps of a constant input, in Nengo's order of operations."""
        drive = self._max_rate * np.asarray(frame, float)
        voltage = self._voltage
        increase = np.maximum(drive, 0) * DT
        blank = drive <= 0
        crossings = np.empty_like(voltage)
        for step in range(out.shape[1]):
            voltage += increase
            np.floor(voltage, out=crossings)
            voltage -= crossings
            np.not_equal(crossings, 0, out=out[:, step].view(bool))
            np.putmask(voltage, blank, self._phase)


def make_input_spikes(spec: NetworkSpec, samples: np.ndarray) -> np.ndarray:
    """The spikes of the input neurons in a stream.

    Parameters
    ----------
    spec : NetworkSpec
    samples : ndarray
        Samples of the stream, as returned by `Stimulus.flatten`.

    Returns
    -------
    ndarray of uint8, shape (n_samples * period, inputs)
        Each sample with the silent gap before it.
    """
    presentation = spec.presentation
    neurons = InputNeurons(spec.stimulus, 1, samples.shape[-1])
    spikes = []
    for sample in samples:
        neurons.set_samples(sample[None])
        spikes.append(neurons.make_spikes(-presentation.gap, presentation.steps)[0])
    return np.concatenate(spikes)


def read_out(layer: Layer, spikes: np.ndarray, area: float) -> np.ndarray:
    """The output of a readout on the host at each step, without its bias.

    The sums arrive at the host one step late, and go through the low-pass filter of the layer's
    synapse, which takes another step.

    Parameters
    ----------
    layer : Layer
        A layer without neurons.
    spikes : ndarray, shape (steps, inputs)
        Spikes of the layer before.
    area : float
        Area of one of them.

    Returns
    -------
    ndarray, shape (steps, sections * units)
    """
    arrived = delay_one_step(layer.compute_sums(spikes) * (area / DT))
    if layer.synapse is None:
        return arrived
    keep = np.exp(-DT / layer.synapse)
    filtered = np.zeros_like(arrived)
    for t in range(1, len(arrived)):
        filtered[t] = keep * filtered[t - 1] + (1 - keep) * arrived[t - 1]
    return filtered


def delay_one_step(values: np.ndarray) -> np.ndarray:
    """The same values one step later, zeros in the first step, shape (steps, ...)."""
    return np.concatenate([np.zeros_like(values[:1]), values[:-1]])


def run_reference(spec: NetworkSpec, streams, seed=0, options=None) -> Iterator[TargetOutput]:
    """Run a network in real numbers: a target without Nengo, with which the others must agree.

    It is the ``run`` of a :class:`deploy.targets.registry.Target` without options.  Nothing in it
    is random.
    """
    for samples in streams:
        signal = make_input_spikes(spec, samples)
        area = spec.stimulus.area
        spikes = {"input": signal}
        for layer in spec.layers:
            if layer.neurons is None:
                output = read_out(layer, signal, area)
                break
            equations = derive_equations(layer, area)
            sums = layer.compute_sums(delay_one_step(signal))
            recurrent_kernel = None
            if layer.recurrent is not None:  # its own spikes have another area than its input's
                recurrent_kernel = layer.recurrent.T * (layer.neurons.amplitude / area)
            signal = equations.compute_spikes(sums, recurrent_kernel)
            area = layer.neurons.amplitude
            spikes[layer.name] = signal
            output = signal * (area / DT)
        yield TargetOutput.from_stream(spec, output, spikes)
