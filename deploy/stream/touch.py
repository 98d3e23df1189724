"""A touch on a running sensor: its events, its presentation step by step, and its decision."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Optional

import numpy as np

NANOSECONDS_PER_MS = 1e6

# Share of a step near its end in which the rounding of single precision decides.
STEP_ROUNDING = 1e-6


@dataclass(frozen=True)
class Decision:
    """The network's decision on one touch.

    Attributes
    ----------
    label : str
        Name of the class.
    number : int
        The class, from 0.
    probability : float or None
        Estimated probability that the class is right, from 0 to 1, or the softmax of the outputs if
        the network has no confidence estimator.  None without an estimate: no spike has reached the
        readout, so that the class means nothing, or the touch has lasted longer than the samples of
        the training, on which probabilities are estimated.
    time : float
        Time at which the decision was due, in the unit and on the clock of the events.
    start : float
        Time of the first event of the touch.
    early : bool
        True if the threshold of the bundle was reached before the end.
    ended : bool
        True if the touch had ended at that time.  Otherwise the decision is preliminary: later
        events may change the class.
    events : int
        Number of events of the touch until the decision.
    """

    label: str
    number: int
    probability: Optional[float]
    time: float
    start: float
    early: bool
    ended: bool
    events: int

    def to_dict(self) -> dict:
        """The decision as plain values, for JSON."""
        return asdict(self)


class Touch:
    """A touch: its events and the network's presentation of them.

    Attributes
    ----------
    start_ns, last_ns : int
        Time of the first and the last event, on the stream's clock.
    events : ndarray of int, shape (steps,)
        Number of events in each step.
    end_ns : int or None
        Time at which the touch ended, by silence; None before.
    presentation : TouchPresentation
    decision : Decision or None
        None until the network has decided.
    checked : int
        Number of values of the confidence that were compared with the threshold.
    """

    def __init__(self, start_ns, presentation, steps):
        self.start_ns = start_ns
        self.last_ns = start_ns
        self.end_ns: Optional[int] = None
        self.events = np.zeros(steps, int)
        self.presentation = presentation
        self.decision: Optional[Decision] = None
        self.checked = 0

    @property
    def has_ended(self) -> bool:
        """True after silence."""
        return self.end_ns is not None


class TouchSteps:
    """The steps of a touch's presentation, in the time of the stream.

    Parameters
    ----------
    spec : NetworkSpec
    longest : float or None
        Time in seconds for which a touch that does not end is presented; None for the
        presentation of the network.

    Attributes
    ----------
    step_ms : float
        Duration of a step.
    usual, longest : int
        Number of steps of the network's presentation, and of the longest one.
    """

    def __init__(self, spec, longest: Optional[float]):
        step_s = spec.stimulus.step_seconds
        self.step_ms = 1000 * step_s
        self.usual = spec.presentation.steps
        self.longest = self.usual
        if longest is not None:
            self.longest = max(self.usual, round(longest / step_s))
        self._certain_step_ns = (1 - STEP_ROUNDING) * self.step_ms * NANOSECONDS_PER_MS
        self._settling_steps = len(spec.layers) + 2

    def find_step(self, touch: Touch, time_ns):
        """Step of the touch, with the rounding of `pipeline.recordings.spike_frames.EventTable`."""
        since_ms = ((time_ns - touch.start_ns) / NANOSECONDS_PER_MS).astype(np.float32)
        return np.floor(since_ms / np.float32(self.step_ms)).astype(np.int64)

    def find_end_ns(self, touch: Touch, n_steps: int) -> int:
        """Time at which some number of steps of a touch are over."""
        return touch.start_ns + round(n_steps * self.step_ms * NANOSECONDS_PER_MS)

    def find_certain_end_ns(self, touch: Touch) -> float:
        """A time at which the present step is certainly not over.

        The last millionth of a step is left to :meth:`find_step`, which rounds as the check does.
        """
        return touch.start_ns + (touch.presentation.n_steps + 1) * self._certain_step_ns

    def find_last_step(self, touch: Touch) -> int:
        """Number of steps after which nothing happens any more, unless there are other events.

        A touch whose events are within the usual presentation ends with it, as in the check.  A
        longer one ends when the spikes of its last event have reached the output.
        """
        if self.longest == self.usual or not self.exceeds_training(touch):
            return self.usual
        last_ms = (touch.last_ns - touch.start_ns) / NANOSECONDS_PER_MS
        end = round(last_ms / self.step_ms + self._settling_steps)
        return min(max(end, self.usual), self.longest)

    def exceeds_training(self, touch: Touch) -> bool:
        """True if the touch is longer than the samples of the training."""
        return bool(self.find_step(touch, np.int64(touch.last_ns)) >= self.usual)
