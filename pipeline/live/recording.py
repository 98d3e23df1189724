"""A recording that is being written on the skin of a page, or an example that is being played."""

import math

import numpy as np

from pipeline.live.deciding import NetworkOutput
from pipeline.recordings.events import Events, join_events
from pipeline.simulation.pen import START_S, PenPoint

# Maximum duration of a recording. The published ones last 2 s; some people write more slowly.
MAX_RECORDING_S = 10.0

# Pause in seconds after which a recording has ended: a touch of the pen begins another one.
PAUSE_S = 1.2

# Seconds without a message after which the pen is taken to rest; before, messages may be delayed by
# a busy machine.
MAX_MESSAGE_DELAY_S = 0.25

# Seconds of the skin that are simulated in one piece, so that little memory is needed: an
# intermediate result of a piece takes 8 MB on the largest skin.
PIECE_S = 0.5


class OpenRecording:
    """A recording that is being written, or an example that is being played.

    Parameters
    ----------
    number : int
    begun_ms : float
        Time of the first touch on the page's clock.
    deciding : object
        From ``PageDecider.begin``: answers for this recording.
    writing : Writing or ReplayedTouch
    writer : int
        Who writes it, also if another writer is chosen before it is saved.
    example : Example, optional
        The example that is played.

    Attributes
    ----------
    is_complete : bool
        True if nothing can be written on it any more, because it is an example or was saved.
    is_down : bool
        True if the pen touches the skin.
    last_point : PenPoint or None
        The last point of the pen.
    output : NetworkOutput or None
        The latest output of the network.
    verdict : PageVerdict or None
        The decision that counts, once there is one.
    saved_as : pipeline.live.keeping.SavedRecording or None
        Its file; None before it is saved, and after that was undone.
    """

    def __init__(self, number, begun_ms, deciding, writing, writer=0, example=None):
        self.number = number
        self.deciding = deciding
        self.writing = writing
        self.writer = writer
        self.example = example
        self.last_point = None
        self.is_down = False
        self.is_complete = example is not None
        self.saved_as = None
        self.verdict = None
        self.output = None
        self._longest_s = MAX_RECORDING_S if example is None else writing.settled_s
        self._begun_ms = begun_ms
        self._now_s = START_S

    def to_recording_s(self, page_ms):
        """Convert a time of the page's clock to the recording's."""
        return START_S + (page_ms - self._begun_ms) / 1e3

    def to_page_ms(self, time_s):
        """Convert a time of the recording's clock to the page's."""
        return self._begun_ms + (time_s - START_S) * 1e3

    @property
    def is_over(self):
        """True if its maximum duration has passed."""
        return self.writing.time_s >= self._longest_s - 2e-3

    @property
    def _is_at_rest(self):
        """True if nothing can happen before the pen returns."""
        return self.is_over or self.writing.time_s >= self.writing.settled_s - 2e-3

    @property
    def has_ended(self):
        """True if it has ended: another touch does not belong to it."""
        return self._is_at_rest and (self.is_complete or self.is_over or self.is_after(self._now_s))

    def is_after(self, time_s):
        """True if a touch at this time would begin another recording."""
        return time_s > self.last_point.time_s + PAUSE_S

    @property
    def known_s(self):
        """Time until which all events are known; infinity for a recording that has ended."""
        reached_s = self._now_s if self._is_at_rest else self.writing.time_s
        return math.inf if self.has_ended else reached_s

    def take_output(self, output: NetworkOutput, has_ended: bool):
        """Keep an early decision; otherwise take the answer at the end of the recording."""
        self.output = output
        if self.verdict is not None and self.verdict.early:
            return
        self.verdict = output.decided or (output.curve.find_last() if has_ended else None)

    def add_point(self, page_ms, right, down, pressure, touches):
        """Add a point of the pen."""
        if not self.is_over and (touches or self.is_down):
            point = PenPoint(self.to_recording_s(page_ms), down, right, pressure, touches)
            self.writing.add_point(point)
            self.last_point = point
        self.is_down = touches

    def lift(self):
        """Lift the pen, independently of the last message of the page."""
        if self.is_down:
            _, down, right, pressure, _ = self.last_point
            self.add_point(self.to_page_ms(self.writing.time_s), right, down, pressure, False)

    def advance(self, page_ms) -> Events:
        """Advance the time: to now or, while the pen may be moving, to its last known point."""
        self._now_s = self.to_recording_s(page_ms)
        until = min(self._now_s, self._longest_s)
        if self.is_down:
            until = min(until, max(self.last_point.time_s, until - MAX_MESSAGE_DELAY_S))
        else:
            until = min(until, self.writing.settled_s)
        return self._advance(until)

    def finish(self) -> Events:
        """End the recording: let the skin come to rest."""
        self._now_s = math.inf
        return self._advance(min(self.writing.settled_s, self._longest_s))

    def _advance(self, until_s):
        ends = np.arange(self.writing.time_s + PIECE_S, until_s, PIECE_S).tolist()
        return join_events([self.writing.advance(end_s) for end_s in (*ends, until_s)])
