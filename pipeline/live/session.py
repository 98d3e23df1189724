"""The session of one page: strokes in, events and decisions out, recordings saved.

This module uses no sockets or clocks: a message is a dict, and the time is an argument.  A page
sends:

``pen``      ``now`` and ``points`` [[t, right, down, pressure, touches], ...], times in
             milliseconds of the page's clock, positions in taxels
``clear``    discard the present recording
``label``    ``label``: save the recording under this class, counted from 0, and under the writer
             that it was begun with
``example``  ``now`` and ``label`` (or null for any): play a sample of the network's check
``undo``     remove the file of the recording on the skin
``writer``   ``number`` of the writer, or null for a new one

and it receives: ``events``, ``answer``, ``spikes``, ``cleared``, ``saved``, ``undone``,
``examples``, ``writer`` and ``problem``.  ``spikes`` are most of the data and slow to
draw, and are therefore not in every ``answer``.
Any other message raises :class:`BadMessage`.
"""

import base64
import json
import math

import numpy as np

from deploy.errors import UserError, describe_error
from pipeline.live.deciding import Decider, NetworkOutput
from pipeline.live.examples import Examples, ReplayedTouch
from pipeline.live.keeping import FIRST_WRITER, WRITER_LIMIT, Keeper
from pipeline.recordings.events import Events, join_events
from pipeline.recordings.formats.mat import MatRecording
from pipeline.simulation.pen import MARGIN, START_S, PenPoint, Writing

# Maximum duration of a recording. The published ones last 2 s; some people write more slowly.
LONGEST_S = 10.0

# Pause in seconds after which a recording has ended: a touch of the pen begins another one.
PAUSE_S = 1.2

# Seconds without a message after which the pen is taken to rest; before, messages may be delayed by
# a busy machine.
REST_S = 0.25

# Maximum number of points in a message.
MAX_POINTS = 512

# Maximum number of taxels of a skin to write on: with more, the simulation would take too long
# beside the page and its network (0.15 s of processor time per second for this number).
MAX_TAXELS = 4096

# Seconds of the skin that are simulated in one piece, so that little memory is needed: an
# intermediate result of a piece takes 8 MB on the largest skin.
PIECE_S = 0.5


class BadMessage(ValueError):
    """Raised for a message that the page would not send; the text has the reason."""


class OpenRecording:
    """A recording that is being written, or an example that is being played.

    Parameters
    ----------
    number : int
    begun_ms : float
        Time of the first touch on the page's clock.
    deciding : object
        From ``Decider.begin``: answers for this recording.
    writing : Writing or ReplayedTouch
    writer : int
        Who writes it, also if another writer is chosen before it is saved.
    example : Example, optional
        The example that is played.

    Attributes
    ----------
    complete : bool
        True if nothing can be written on it any more, because it is an example or was saved.
    saved_as : pipeline.live.keeping.SavedRecording or None
        Its file; None before it is saved, and after that was undone.
    """

    def __init__(self, number, begun_ms, deciding, writing, writer=0, example=None):
        self.number = number
        self.deciding = deciding
        self.writing = writing
        self.writer = writer
        self.example = example
        self.last = None  # of the pen's points
        self.down = False
        self.complete = example is not None
        self.saved_as = None
        self.verdict = None
        self.spikes = self.curve = None  # of the latest answer
        self._longest_s = LONGEST_S if example is None else writing.settled_s
        self._begun_ms = begun_ms
        self._now_s = START_S

    def time_s(self, page_ms):
        """Convert a time of the page's clock to the recording's."""
        return START_S + (page_ms - self._begun_ms) / 1e3

    def to_page_ms(self, time_s):
        """Convert a time of the recording's clock to the page's."""
        return self._begun_ms + (time_s - START_S) * 1e3

    @property
    def over(self):
        """True if its maximum duration has passed."""
        return self.writing.time_s >= self._longest_s - 2e-3

    @property
    def _rests(self):
        """True if nothing can happen before the pen returns."""
        return self.over or self.writing.time_s >= self.writing.settled_s - 2e-3

    @property
    def settled(self):
        """True if it has ended: another touch does not belong to it."""
        return self._rests and (self.complete or self.over or self.is_after(self._now_s))

    def is_after(self, time_s):
        """True if a touch at this time would begin another recording."""
        return time_s > self.last.time_s + PAUSE_S

    @property
    def known_s(self):
        """Time until which all events are known; infinity for a recording that has ended."""
        reached = self._now_s if self._rests else self.writing.time_s
        return math.inf if self.settled else reached

    def decide(self, said: NetworkOutput, settled: bool):
        """Keep an early decision; otherwise take the answer at the end of a settled recording."""
        if self.verdict is not None and self.verdict.early:
            return
        self.verdict = said.decided or (said.curve.find_last() if settled else None)

    def add_point(self, page_ms, right, down, pressure, touches):
        """Add a point of the pen."""
        if not self.over and (touches or self.down):
            point = PenPoint(self.time_s(page_ms), down, right, pressure, touches)
            self.writing.add_point(point)
            self.last = point
        self.down = touches

    def lift(self):
        """Lift the pen, independently of the last message of the page."""
        if self.down:
            _, down, right, pressure, _ = self.last
            self.add_point(self.to_page_ms(self.writing.time_s), right, down, pressure, False)

    def advance(self, page_ms) -> Events:
        """Advance the time: to now or, while the pen may be moving, to its last known point."""
        self._now_s = self.time_s(page_ms)
        until = min(self._now_s, self._longest_s)
        if self.down:
            until = min(until, max(self.last.time_s, until - REST_S))
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


class Session:
    """The session of a page, from its opening to its closing.

    Parameters
    ----------
    number : int
        Unique among the sessions of a server; seed of the skin's noise and of the examples' order.
    keeper : Keeper
    p : pipeline.simulation.parameters.Parameters
    """

    def __init__(self, number, keeper: Keeper, p):
        self._number = number
        self._keeper = keeper
        self._p = p
        self._decider: Decider | None = None
        self._examples: Examples | None = None
        self._sensor = keeper.sensor
        self._recordings = 0
        self._writer = FIRST_WRITER
        self.recording = None

    def begin(self, decider: Decider):
        """Set the decider, once it is ready."""
        self._decider = decider

    def show(self, tests) -> dict:
        """Set the recordings of the network's check; returns the message ``examples``.

        Parameters
        ----------
        tests : list of pipeline.live.examples.Example
        """
        self._examples = Examples(tests, [3, self._number])
        counts = self._examples.counts(len(self._sensor.classes))
        return {"type": "examples", "counts": counts}

    @property
    def clocked(self) -> bool:
        """True if the answer of the network can change without an event."""
        return self._decider is not None and self._decider.clocked

    def make_writer_message(self) -> dict:
        """The message ``writer``: the writer, those with recordings, and the number of its own."""
        saved = self._keeper.writers
        number = self._writer
        return {"type": "writer", "number": number, "known": sorted(saved), "saved": saved[number]}

    def handle(self, text: str) -> list:
        """Handle a message.

        Parameters
        ----------
        text : str
            The message as received.

        Returns
        -------
        list of dict
            Messages for the page.

        Raises
        ------
        BadMessage
        """
        try:
            message = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise BadMessage(f"not JSON: {error}") from error
        if not isinstance(message, dict):
            raise BadMessage("not a JSON object")
        kind = message.get("type")
        handler = _HANDLERS.get(kind) if isinstance(kind, str) else None
        if handler is None:
            raise BadMessage("of an unknown type")
        try:
            return handler(self, message)
        except OverflowError as error:
            raise BadMessage("a number is out of range") from error
        except UserError as error:
            return [make_problem_message(str(error))]
        except OSError as error:  # any error of the disk
            return [make_problem_message(describe_error(error))]

    def ask(self):
        """The next answer of the network: a function for another thread, or None.

        The function returns the message ``answer``, or None.
        """
        recording = self.recording
        if self._decider is None or recording is None:
            return None
        events = recording.writing.events
        known_s = recording.known_s

        def compute():
            said = recording.deciding.compute_output(events, known_s)
            if said is None:
                return None
            recording.decide(said, known_s == math.inf)
            return _make_output_message(recording, events, said)

        return compute

    def make_spikes_message(self):
        """The message ``spikes`` of the latest output, or None."""
        recording = self.recording
        if recording is None or recording.spikes is None:
            return None
        layers = recording.spikes.items()
        shares = np.rint(255 * recording.curve.shares).astype(np.uint8)
        return {
            "type": "spikes",
            "recording": recording.number,
            "layers": {name: base64.b64encode(rows.tobytes()).decode() for name, rows in layers},
            "seconds": (recording.curve.seconds - START_S).round(4).tolist(),
            "chances": base64.b64encode(shares.tobytes()).decode(),
        }

    def _handle_pen(self, message):
        now_ms = _read_number(message, "now")
        points = message.get("points")
        if not isinstance(points, list) or len(points) > MAX_POINTS:
            raise BadMessage(f"points: not a list of at most {MAX_POINTS}")
        points = [_read_point(point, self._sensor) for point in points]
        if any(point[0] > now_ms + 1000 for point in points):
            raise BadMessage("points: later than now")
        if self._decider is None:
            return []  # the page says that it is not ready yet
        replies = []
        for point in points:
            if point[4] and self._is_new(point[0]):
                self._begin(point[0])
                number = self.recording.number
                replies.append({"type": "cleared", "recording": number, "begun_ms": point[0]})
            if self.recording is not None and not self.recording.complete:
                self.recording.add_point(*point)
        if self.recording is not None:
            replies.append(self._pass_time(self.recording.advance, now_ms))
        return replies

    def _is_new(self, page_ms):
        recording = self.recording
        if recording is None or recording.complete:
            return True
        if recording.down:
            return False
        return recording.settled or recording.is_after(recording.time_s(page_ms))

    def _begin(self, page_ms):
        self._recordings += 1
        seed = (2, self._number, self._recordings)
        sensor = self._sensor
        writing = Writing(seed, self._p, (sensor.rows, sensor.columns), sensor.polarities)
        self.recording = OpenRecording(
            self._recordings, page_ms, self._decider.begin(), writing, self._writer
        )

    def _handle_example(self, message):
        now_ms = _read_number(message, "now")
        label = message.get("label")
        if label is not None:
            label = self._read_class(message)
        if self._decider is None or self._examples is None:
            return [
                make_problem_message("the examples are not ready yet; wait a moment and try again")
            ]
        example = self._examples.draw(label)
        self._recordings += 1
        deciding = self._decider.begin()
        replayed = ReplayedTouch(example.events)
        self.recording = OpenRecording(
            self._recordings, now_ms, deciding, replayed, example=example
        )
        shown = {"name": example.name, "label": example.label}
        return [{"type": "cleared", "recording": self._recordings, "example": shown}]

    def _read_class(self, message):
        return _read_whole_number(message, "label", 0, len(self._sensor.classes) - 1)

    def _pass_time(self, advance, *until):
        """Advance the skin within the limits; returns the message with its events."""
        recording = self.recording
        events = advance(*until)
        return {
            "type": "events",
            "recording": recording.number,
            "time_s": recording.writing.time_s,
            "ns": events.time_ns.tolist(),
            "taxel": events.taxel.tolist(),
            "polarity": events.polarity.tolist(),
            "settled": recording.settled,
            "over": recording.over,
        }

    def _clear(self, message):
        self.recording = None
        return [{"type": "cleared", "recording": None}]

    def _handle_label(self, message):
        label = self._read_class(message)
        recording = self.recording
        if recording is not None and recording.example is not None:
            return [make_problem_message("an example cannot be saved; clear it and write your own")]
        if recording is None:
            return [
                make_problem_message("nothing has been written; write first, then press the class")
            ]
        saved_before = recording.saved_as
        if saved_before is not None and saved_before.label == label:
            return [make_problem_message("this recording is saved already; write the next one")]
        recording.lift()
        replies = [self._pass_time(recording.finish)]
        events = recording.writing.events
        if len(events) == 0:
            return [
                *replies,
                make_problem_message("no taxel has an event; write with more pressure"),
            ]
        taxels = self._sensor.rows * self._sensor.columns
        kept = self._keeper.save(label, MatRecording(events, True, recording.writer, True, taxels))
        recording.complete = True
        recording.saved_as = kept
        if saved_before is not None:  # the label was wrong
            self._keeper.remove(saved_before)
        saved = {
            "type": "saved",
            "label": label,
            "recording": recording.number,
            "name": kept.name,
            "events": len(events),
        }
        return [*replies, saved, self.make_writer_message()]

    def _undo(self, message):
        recording = self.recording
        saved = recording and recording.saved_as
        if saved is None:
            return [make_problem_message("nothing on the sensor is saved; Clear erases a drawing")]
        self._keeper.remove(saved)
        recording.saved_as = None  # it can be saved as another class
        return [
            {"type": "undone", "label": saved.label, "name": saved.name},
            self.make_writer_message(),
        ]

    def _handle_writer(self, message):
        number = message.get("number")
        if number is not None and (type(number) is not int or not 1 <= number < WRITER_LIMIT):
            raise BadMessage(f"number: not from 1 to {WRITER_LIMIT - 1}")
        if number is None:
            number = self._keeper.add_writer()
        self._keeper.note_writer(number)
        self._writer = number
        return [self.make_writer_message()]


_HANDLERS = {
    "pen": Session._handle_pen,
    "clear": Session._clear,
    "label": Session._handle_label,
    "example": Session._handle_example,
    "undo": Session._undo,
    "writer": Session._handle_writer,
}


def make_problem_message(text: str) -> dict:
    """The message with an error for the user."""
    return {"type": "problem", "text": text}


def _make_output_message(recording, events, said: NetworkOutput):
    recording.spikes = said.spikes
    recording.curve = said.curve
    verdict = recording.verdict
    last = said.curve.find_last()
    return {
        "type": "answer",
        "recording": recording.number,
        "last_ms": recording.to_page_ms(events.time_ns[-1] * 1e-9) if len(events) else None,
        "events": len(events),
        "decision": last.label,
        "confidence": last.confidence,
        "exceeds_training": said.exceeds_training,
        "shares": said.curve.shares[-1].round(4).tolist(),
        "verdict": verdict and {**verdict._asdict(), "seconds": verdict.seconds - START_S},
    }


def _read_number(message, name):
    value = message.get(name)
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > 1e12:
        raise BadMessage(f"{name}: not a number")
    return value


def _read_whole_number(message, name, least, most):
    value = message.get(name)
    if type(value) is not int or not least <= value <= most:
        raise BadMessage(f"{name}: not a whole number from {least} to {most}")
    return value


def _read_point(values, sensor):
    if sensor.rows * sensor.columns > MAX_TAXELS:
        raise BadMessage(f"points: a skin of more than {MAX_TAXELS} taxels is not simulated")
    right, down = (side - 1 + MARGIN for side in (sensor.columns, sensor.rows))
    ranges = (-1e12, 1e12), (-MARGIN, right), (-MARGIN, down), (0, 1), (0, 1)
    if not isinstance(values, list) or len(values) != len(ranges):
        raise BadMessage("points: not five values each")
    for value, (least, most) in zip(values, ranges, strict=True):
        if type(value) not in (int, float) or not least <= value <= most:
            raise BadMessage("points: a value is not a number, or out of range")
    return *values[:4], bool(values[4])
