"""Stimuli: the input of a network as frames over time, and its silent gaps.

A stimulus defines how a sample becomes one frame of values for every step of its presentation, and
the spikes that the host makes of a frame, with one input neuron per value.  In the gap before a
sample the frame is zero and nothing spikes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Optional

import numpy as np

from .. import limits
from ..loading import Limit, between, limited_field, require_valid
from .chip import LOIHI


@dataclass(frozen=True)
class Stimulus:
    """Base class of all stimuli.

    Attributes
    ----------
    kind : str
        Name of the class in a bundle.
    is_static : bool
        True if a sample is one constant frame for all steps; else it has one frame per step.
    area : float
        Area of one spike of the input neurons.
    """

    kind: ClassVar[str] = ""
    is_static: ClassVar[bool] = True

    @property
    def area(self) -> float:
        """Area of one spike of the input neurons."""
        raise NotImplementedError

    @property
    def step_seconds(self) -> float:
        """Time in seconds of the recording that one step represents."""
        return LOIHI.dt

    @property
    def shortest_interval(self) -> int:
        """Minimum number of steps between two spikes of an input neuron."""
        return 1

    @property
    def spike_limits(self) -> tuple:
        """Limits of an input neuron in a sample: (refractory steps, maximum number of spikes).

        0 is no limit.
        """
        return (0, 0)

    def make_input_neurons(self) -> tuple:
        """The neurons that make the spikes in a Nengo network.

        Returns
        -------
        neuron_type : nengo.neurons.NeuronType
        gain : float
            Of each neuron.
        """
        raise NotImplementedError

    def compute_input_spikes(self, samples, n_steps: int) -> np.ndarray:
        """Spikes of the input neurons in a presentation that begins at rest.

        Parameters
        ----------
        samples : ndarray, shape (n_samples, ...)
        n_steps : int

        Returns
        -------
        ndarray of float, shape (n_samples, n_steps, size)
            0 or 1.
        """
        raise NotImplementedError

    def find_sample_shape(self, input_shape, n_steps: int) -> tuple:
        """Shape of one sample: (rows, columns, channels), with (steps,) before it unless static."""
        return tuple(input_shape) if self.is_static else (n_steps, *input_shape)

    def flatten(self, samples) -> np.ndarray:
        """Samples in the network's input format: (n_samples, size), or (n_samples, steps, size)."""
        samples = np.asarray(samples)
        if self.is_static:
            return samples.reshape(len(samples), -1).astype(float)
        return samples.reshape(*samples.shape[:2], -1)

    def find_problem(self, samples, input_shape, n_steps: int) -> Optional[str]:
        """The reason why samples cannot be presented with this stimulus, or None."""
        expected = self.find_sample_shape(input_shape, n_steps)
        if samples.shape[1:] != expected:
            return f"samples have shape {samples.shape[1:]}, not {expected}"
        if samples.dtype.kind not in "fiub":
            return "samples are not real numbers"
        # Only the extremes are converted: the frames of a test set are too large to copy.
        lowest = float(np.min(samples, initial=0))
        highest = float(np.max(samples, initial=0))
        if not -limits.MAGNITUDE <= lowest <= highest <= limits.MAGNITUDE:  # also refuses NaN
            return "samples have a value that is NaN or too large"
        return None


@dataclass(frozen=True)
class ImageSpikes(Stimulus):
    """A tactile image as evenly spaced spikes of host neurons without leak, one per pixel.

    A pixel of value v causes ``max_rate * v`` spikes per second, evenly spaced, each of area
    1 / ``max_rate``, so that the mean of the spike train is v.  A blank pixel is reset.  With a gap
    of at least one step, a sample's spikes therefore do not depend on the previous sample; without
    a gap, a pixel keeps its phase from one sample to the next.

    Attributes
    ----------
    max_rate : float
        Spikes per second of a pixel of value 1; at most 1 / dt, one spike per step.
    initial_phase : float
        Voltage of a blank pixel as a share of the threshold.  With 0.5 the number of spikes is the
        expected number rounded to the nearest, with 0 it is rounded down.
    """

    kind: ClassVar[str] = "image-spikes"
    max_rate: float = limited_field(between(1e-3, 1 / LOIHI.dt), 500.0)
    initial_phase: float = limited_field(
        Limit(lambda value: 0 <= value < 1, "from 0 to below 1"), 0.5
    )

    def __post_init__(self):
        require_valid(self)

    @property
    def area(self) -> float:
        """Area of one spike."""
        return 1 / self.max_rate

    @property
    def shortest_interval(self) -> int:
        """Minimum number of steps between two spikes of a pixel of at most 1."""
        return max(1, int(1 / (self.max_rate * LOIHI.dt)))

    def make_input_neurons(self) -> tuple:
        """Neurons that spike evenly; see :meth:`Stimulus.make_input_neurons`."""
        from .input_neurons import EvenSpikes  # Nengo is imported by targets only

        return EvenSpikes(self.initial_phase, amplitude=self.area), self.max_rate

    def compute_input_spikes(self, samples, n_steps: int) -> np.ndarray:
        """Evenly spaced spikes; see :meth:`Stimulus.compute_input_spikes`."""
        added = samples.reshape(len(samples), -1) * (self.max_rate * LOIHI.dt)
        voltage = np.full(added.shape, self.initial_phase)
        spikes = np.empty((len(samples), n_steps, added.shape[1]))
        for step in range(n_steps):
            voltage += added
            spikes[:, step] = voltage >= 1
            voltage -= spikes[:, step]
        return spikes

    def find_problem(self, samples, input_shape, n_steps: int) -> Optional[str]:
        """The reason why samples cannot be presented with this stimulus, or None."""
        problem = super().find_problem(samples, input_shape, n_steps)
        if problem is not None:
            return problem
        largest = np.max(samples, initial=0)
        largest_value = 1 / (self.max_rate * LOIHI.dt)
        if largest > largest_value:
            return (
                f"a pixel is {largest:g}; at {self.max_rate:g} spikes per second for a pixel of 1, "
                f"pixels above {largest_value:g} would spike more than once per step"
            )
        return None


@dataclass(frozen=True)
class EventFrames(Stimulus):
    """Events as spikes: at most one per taxel, polarity and step, with a refractory period.

    A sample has a frame of 0 and 1 for each step, zero after its last event.  An event makes a
    relay neuron on the host spike in its step, with a height of 1 for one step; without events
    there are no spikes.

    Attributes
    ----------
    seconds : float
        Time in seconds of the recording that one step represents.
    refractory : int
        Refractory period of a taxel and polarity, in steps after a spike.
    max_spikes : int
        Maximum number of spikes of a taxel and polarity in a sample; later ones are left out of
        every sample that is presented.  0 for no limit.
    """

    kind: ClassVar[str] = "events"
    is_static: ClassVar[bool] = False
    seconds: float = limited_field(between(1e-6, limits.SECONDS), 0.02)
    refractory: int = limited_field(between(0, limits.STEPS), 0)
    max_spikes: int = limited_field(between(0, limits.STEPS), 0)

    def __post_init__(self):
        require_valid(self)

    def flatten(self, samples) -> np.ndarray:
        """Samples in the network's input format, (n_samples, steps, size), with the limit."""
        frames = super().flatten(samples)
        if self.max_spikes == 0:
            return frames
        return np.stack([limit_spikes(sample, self.max_spikes) for sample in frames])

    @property
    def shortest_interval(self) -> int:
        """Minimum number of steps between two spikes of a taxel and polarity."""
        return 1 + self.refractory

    @property
    def area(self) -> float:
        """Area of one spike."""
        return LOIHI.dt

    @property
    def step_seconds(self) -> float:
        """Time in seconds of the recording that one step represents."""
        return self.seconds

    @property
    def spike_limits(self) -> tuple:
        """See :attr:`Stimulus.spike_limits`."""
        return self.refractory, self.max_spikes

    def make_input_neurons(self) -> tuple:
        """Neurons that relay events; see :meth:`Stimulus.make_input_neurons`."""
        from .input_neurons import Relay  # Nengo is imported by targets only

        return Relay(amplitude=self.area), 1.0

    def compute_input_spikes(self, samples, n_steps: int) -> np.ndarray:
        """A spike for each event; see :meth:`Stimulus.compute_input_spikes`."""
        return samples.reshape(*samples.shape[:2], -1).astype(float)

    def find_problem(self, samples, input_shape, n_steps: int) -> Optional[str]:
        """The reason why samples cannot be presented with this stimulus, or None."""
        problem = super().find_problem(samples, input_shape, n_steps)
        if problem is not None:
            return problem
        if not np.isin(samples, (0, 1)).all():
            return "frames of events contain values other than 0 and 1"
        in_time = np.moveaxis(samples, 1, 0)
        if not np.array_equal(apply_refractory_period(in_time, self.refractory), in_time):
            return f"a taxel spikes again within {self.refractory} steps"
        return None


def limit_spikes(frames, max_spikes: int) -> np.ndarray:
    """Spikes that remain with a maximum number of spikes of each taxel and polarity.

    Parameters
    ----------
    frames : ndarray, shape (steps, ...)
        1 where there is a spike, 0 elsewhere.
    max_spikes : int
        Number of spikes that remain, the first ones; 0 for all.

    Returns
    -------
    ndarray of the same shape and type
    """
    frames = np.asarray(frames)
    if max_spikes == 0:
        return frames
    return frames * (np.cumsum(frames != 0, axis=0, dtype=np.int32) <= max_spikes)


def apply_refractory_period(frames, refractory_steps: int) -> np.ndarray:
    """Spikes that remain with a refractory period.

    Parameters
    ----------
    frames : ndarray, shape (steps, ...)
        1 where there is a spike, 0 elsewhere.
    refractory_steps : int

    Returns
    -------
    ndarray of the same shape
    """
    if refractory_steps == 0:
        return frames
    frames = np.array(frames)
    ready = np.zeros(frames.shape[1:], int)  # first step in which each may spike again
    for step in range(len(frames)):
        frames[step] *= ready <= step
        ready[frames[step] != 0] = step + 1 + refractory_steps
    return frames


def find_last_steps(frames) -> np.ndarray:
    """Step of each sample's last event, from 0; 0 without events.

    Parameters
    ----------
    frames : ndarray, shape (n_samples, steps, ...)
        Nonzero where there is an event.

    Returns
    -------
    ndarray of int, shape (n_samples,)
    """
    frames = np.asarray(frames)
    busy = frames.reshape(*frames.shape[:2], -1).any(2)
    return np.where(busy.any(1), frames.shape[1] - 1 - np.argmax(busy[:, ::-1], 1), 0)


STIMULI = {stimulus.kind: stimulus for stimulus in (ImageSpikes, EventFrames)}


class Feed:
    """The frame at every step of a stream: a function of time for a ``nengo.Node``.

    Parameters
    ----------
    presentation : Presentation
        The presentation to follow.
    size : int
        Number of values of a frame.

    Attributes
    ----------
    samples : ndarray, shape (n_samples, size) or (n_samples, steps, size)
        The samples of the stream, see `Stimulus.flatten`; set before a run.
    """

    def __init__(self, presentation, size: int):
        self.period = presentation.period
        self.gap = presentation.gap
        self.blank = np.zeros(size)
        self.samples = self.blank[None]

    def __call__(self, t):
        sample, step = divmod(round(float(t) / LOIHI.dt) - 1, self.period)
        if step < self.gap:
            return self.blank
        values = self.samples[sample]
        return values if values.ndim == 1 else values[step - self.gap].astype(float)
