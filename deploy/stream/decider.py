"""The network's work on a touch: its frames step by step, and when to decide."""

from __future__ import annotations

from typing import Callable, NamedTuple, Optional

import numpy as np

from ..network.spec import NetworkSpec
from .presentation import PresentingNetwork
from .touch import Touch, TouchSteps


class Verdict(NamedTuple):
    """The decision of the network about a touch.

    Attributes
    ----------
    number : int
        Number of the class.
    probability : float or None
        None without an estimate.
    n_steps : int
        Number of steps of the touch on which it is made.
    time_ns : float
        When it is made, on the stream's clock.
    is_early : bool
        True if it is made before the end, because the confidence is sufficient.
    """

    number: int
    probability: Optional[float]
    n_steps: int
    time_ns: float
    is_early: bool


class Decider:
    """Presents touches to a network, one after the other, and decides once on each.

    Parameters
    ----------
    network : PresentingNetwork
    spec : NetworkSpec
    steps : TouchSteps
    report : callable
        ``report(touch, verdict)`` is called with each `Verdict`, and sets ``touch.decision``.
    """

    def __init__(
        self, network: PresentingNetwork, spec: NetworkSpec, steps: TouchSteps, report: Callable
    ):
        self._network = network
        self._presentation = spec.presentation
        self._steps = steps
        self._report = report
        self._frame = np.zeros(int(np.prod(spec.input_shape)), np.uint8)  # of the present step

    def begin(self, start_ns: int) -> Touch:
        """Begin a touch, after the end of the one before."""
        self._frame[:] = 0
        return Touch(start_ns, self._network.begin(), self._steps.longest)

    def present_now(self, touch: Touch, cell: int):
        """Present an event in the present step."""
        self._frame[cell] = 1
        touch.events[touch.presentation.n_steps] += 1

    def present(self, touch: Touch, step: np.ndarray, cell: np.ndarray):
        """Present events; the step of the last one is computed later, when it is over.

        Parameters
        ----------
        touch : Touch
        step, cell : ndarray of int, shape (n_events,)
            Rising steps of the touch, none before the present one, and indices of the input.
        """
        np.add.at(touch.events, step, 1)
        first = touch.presentation.n_steps
        if step[-1] > first:
            frames = np.zeros((step[-1] - first + 1, len(self._frame)), np.uint8)
            frames[0] = self._frame
            frames[step - first, cell] = 1
            self._frame = frames[-1].copy()
            self._compute(touch, frames[:-1])
        else:
            self._frame[cell] = 1

    def advance(self, touch: Touch, now_ns: int):
        """Compute the steps that are over."""
        n_over = int(self._steps.find_step(touch, np.int64(now_ns))) - touch.presentation.n_steps
        self._compute(touch, self._list_frames_to_come(min(n_over, self._count_steps_left(touch))))

    def end(self, touch: Touch, time_ns: int):
        """End a touch: compute the rest of its presentation, decide, prepare the next one."""
        touch.end_ns = time_ns
        n_left = self._count_steps_left(touch)
        if n_left > 0:
            self._network.advance(touch.presentation, self._list_frames_to_come(n_left))
        self._decide_early(touch, time_ns)
        if touch.decision is None:
            self._decide_at_end(touch, time_ns)
        self._network.prepare()

    def _count_steps_left(self, touch):
        return self._steps.find_last_step(touch) - touch.presentation.n_steps

    def _list_frames_to_come(self, n_steps):
        """The frame of the present step, and silence after it."""
        frames = np.zeros((max(n_steps, 0), len(self._frame)), np.uint8)
        if n_steps > 0:
            frames[0] = self._frame
            self._frame[:] = 0
        return frames

    def _compute(self, touch, frames):
        """Compute some steps of the network, and decide if its rules say so."""
        if not len(frames):
            return
        self._network.advance(touch.presentation, frames)
        self._decide_early(touch, np.inf)
        if touch.decision is None and touch.presentation.n_steps == self._steps.longest:
            self._decide_at_end(touch, self._steps.find_end_ns(touch, self._steps.longest))

    def _decide_early(self, touch, now_ns):
        """Decide at the first step that reaches the threshold, if there is one."""
        if touch.decision is not None:
            return
        threshold = self._presentation.threshold_or_1
        readout = touch.presentation.readout
        start = self._presentation.readout_start
        confidences = readout.confidences[: self._steps.usual - start]
        reached = np.flatnonzero(confidences[touch.checked :] >= threshold)
        if len(reached):
            row = touch.checked + int(reached[0])
            n_steps = start + row + 1
            verdict = Verdict(
                number=int(readout.sums[row].argmax()),
                probability=float(confidences[row]),
                n_steps=n_steps,
                time_ns=min(self._steps.find_end_ns(touch, n_steps), now_ns),
                is_early=True,
            )
            self._report(touch, verdict)
        touch.checked = len(confidences)

    def _decide_at_end(self, touch, time_ns):
        """The decision of a check, after the last step."""
        n_steps = self._steps.find_last_step(touch)
        row = n_steps - self._presentation.readout_start - 1
        readout = touch.presentation.readout
        is_estimated = readout.spoke[row] and n_steps <= self._steps.usual
        verdict = Verdict(
            number=int(readout.compute_scores(n_steps).argmax()),
            probability=float(readout.confidences[row]) if is_estimated else None,
            n_steps=n_steps,
            time_ns=time_ns,
            is_early=False,
        )
        self._report(touch, verdict)
