"""Progress of a long step as lines, for output that goes to a file."""

from __future__ import annotations

import time

from .terminal import remark

# Lines in a step: one each tenth.
LINES = 10

# Least time between two lines in seconds, so that short steps have none.
MIN_SECONDS = 10.0

# Least time in seconds from which the remaining time is estimated.
MIN_MEASURED_SECONDS = 5.0


class ProgressLines:
    """A line for each tenth of a step, with the time that it took and that it will take.

    Parameters
    ----------
    label : str
        The activity, such as ``"train events"``.
    total : int
        Total number of units of work.
    unit : str
        What they are, in the plural.
    clock : callable
        The time in seconds.
    """

    def __init__(self, label: str, total: int, unit: str = "samples", clock=time.monotonic):
        self._label = label
        self._total = total
        self._unit = unit
        self._clock = clock
        self._begun = clock()
        self._printed = self._begun
        self._done = 0
        self._told_line = 0
        # The first units take longer, because something is compiled, or shorter, because they were
        # done in an earlier session: the estimate is from those after them.
        self._first_done = 0
        self._first_at = self._begun

    def advance(self, n: int = 1, note: str | None = None):
        """Count n more units of work; print a line if a tenth is complete.

        Parameters
        ----------
        n : int
        note : str, optional
            Printed after the label.
        """
        self._done += n
        line = LINES * self._done // max(self._total, 1)
        now = self._clock()
        if not self._first_done:
            self._first_done = self._done
            self._first_at = now
            return
        is_last = self._done >= self._total
        if line == self._told_line or is_last or now - self._printed < MIN_SECONDS:
            return
        self._told_line = line
        self._printed = now
        label = self._label if note is None else f"{self._label} {note}"
        done = f"{self._done} of {self._total} {self._unit} after {now - self._begun:.0f} s"
        remark(f"{label}: {done}{self._estimate_rest(now)}")

    def _estimate_rest(self, now):
        """The end of a line: the remaining time, unless too little time has passed."""
        measured = now - self._first_at
        if measured < MIN_MEASURED_SECONDS:
            return ""
        seconds_left = measured / (self._done - self._first_done) * (self._total - self._done)
        return f", about {seconds_left:.0f} s left"
