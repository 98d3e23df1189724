"""A network that runs step by step, one presentation after the other, as a check presents samples.

A stream of a check starts from a fresh network; before each sample are the silent steps of the
gap, and after ``stream_length`` samples the next stream starts.  Here each touch is a sample.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..arithmetic import divide_up
from ..network.readout import RunningReadout
from ..targets.emulation import Emulation

# Maximum number of steps that are computed at once, which bounds the memory for their frames.
MAX_STEPS_AT_ONCE = 256


@dataclass(frozen=True)
class SharedNetwork:
    """A network that several streams share.

    Attributes
    ----------
    emulation : Emulation
    recorded : dict of str to int
        Number of neurons of each layer whose spikes are recorded for each presentation.
    """

    emulation: Emulation
    recorded: dict = field(default_factory=dict)


class TouchPresentation:
    """One touch as the network sees it.

    Attributes
    ----------
    readout : RunningReadout
    spikes : dict of str to ndarray of uint8, shape (gap + steps, n_bytes)
        Spikes of the recorded layers at each step, eight neurons per byte (`numpy.packbits`); zero
        for steps that have not been computed.
    """

    def __init__(self, readout: RunningReadout, spikes: dict):
        self.readout = readout
        self.spikes = spikes

    @property
    def n_steps(self) -> int:
        """Number of steps so far."""
        return self.readout.n_steps


class PresentingNetwork:
    """A network on the fast emulator for one stream of events.

    Parameters
    ----------
    network : SharedNetwork
    stream_length : int
        Number of presentations after which the network is reset.
    steps : int
        Maximum number of steps of a presentation.
    """

    def __init__(self, network: SharedNetwork, stream_length: int, steps: int):
        self._emulation = emulation = network.emulation
        self._recorded = network.recorded
        self._spec = emulation.spec
        self._stream_length = stream_length
        self._steps = steps
        self._size = int(np.prod(self._spec.input_shape))
        self._refractory_steps = self._spec.stimulus.refractory
        # Without a limit, as many as there are steps.
        self._max_spikes = self._spec.stimulus.max_spikes or steps
        self._presented = stream_length
        self._state = None
        # The first step compiles the emulator, which takes seconds the first time on a machine.
        emulation.advance(emulation.start(), np.zeros((1, 1, self._size), np.uint8))
        self.prepare()

    def prepare(self):
        """Present the gap before the next presentation, so that this starts without delay."""
        if self._presented == self._stream_length:
            self._state = self._emulation.start()
            self._presented = 0
        self._presented += 1
        gap = self._spec.presentation.gap
        spikes = {
            name: np.zeros((gap + self._steps, divide_up(neurons, 8)), np.uint8)
            for name, neurons in self._recorded.items()
        }
        self._next = TouchPresentation(RunningReadout(self._spec, self._steps), spikes)
        self._ready = np.zeros(self._size, int)
        self._n_spikes = np.zeros(self._size, int)
        for first in range(0, gap, MAX_STEPS_AT_ONCE):
            steps = min(MAX_STEPS_AT_ONCE, gap - first)
            silence = np.zeros((steps, self._size), np.uint8)
            self._compute(silence, self._next, first)

    def begin(self) -> TouchPresentation:
        """Begin the presentation that was prepared."""
        return self._next

    def advance(self, presentation: TouchPresentation, frames: np.ndarray):
        """Advance the current presentation by some steps.

        Parameters
        ----------
        presentation : TouchPresentation
            The presentation that :meth:`begin` has returned.
        frames : ndarray of uint8, shape (steps, size)
            1 where a taxel and polarity has an event; changed to what remains with the refractory
            period and the maximum number of spikes.
        """
        gap = self._spec.presentation.gap
        for first in range(0, len(frames), MAX_STEPS_AT_ONCE):
            next_frames = frames[first : first + MAX_STEPS_AT_ONCE]
            self._apply_limits(next_frames, presentation.n_steps)
            output = self._compute(next_frames, presentation, gap + presentation.n_steps)
            presentation.readout.append(output)

    def _apply_limits(self, frames, first_step):
        """Remove spikes that the stimulus leaves out; see `deploy.network.stimulus`."""
        for step, frame in enumerate(frames, first_step):
            if frame.any():
                frame *= (self._ready <= step) & (self._n_spikes < self._max_spikes)
                self._ready[frame != 0] = step + 1 + self._refractory_steps
                self._n_spikes += frame != 0

    def _compute(self, frames, presentation, row):
        """Output of the readout in some steps; records the spikes from a row on."""
        spikes, output, _ = self._emulation.advance(self._state, frames[None])
        for name, rows in presentation.spikes.items():
            compartments = self._emulation.positions.get(name)
            layer = frames if compartments is None else spikes[0][:, compartments]
            rows[row : row + len(frames)] = np.packbits(layer, axis=1)
        return output[0]
