"""The session of one page: strokes in, events and decisions out, recordings saved.

This module uses no sockets or clocks: a message is a dict (:mod:`pipeline.live.messages`), and the
time is an argument.
"""

import math

from deploy.errors import UserError, describe_error
from pipeline.live.deciding import PageDecider
from pipeline.live.examples import Examples, ReplayedTouch
from pipeline.live.keeping import END_OF_WRITERS, FIRST_WRITER, Keeper
from pipeline.live.messages import (
    BadMessage,
    make_events_message,
    make_output_message,
    make_problem_message,
    make_spikes_message,
    parse_message,
    read_number,
    read_points,
    read_whole_number,
)
from pipeline.live.recording import OpenRecording
from pipeline.recordings.formats.mat import MatRecording
from pipeline.simulation.pen import Writing


class Session:
    """The session of a page, from its opening to its closing.

    Parameters
    ----------
    number : int
        Unique among the sessions of a server; seed of the skin's noise and of the examples' order.
    keeper : Keeper
    parameters : pipeline.simulation.parameters.Parameters
    """

    def __init__(self, number, keeper: Keeper, parameters):
        self._number = number
        self._keeper = keeper
        self._parameters = parameters
        self._decider: PageDecider | None = None
        self._examples: Examples | None = None
        self._sensor = keeper.sensor
        self._recordings = 0
        self._writer = FIRST_WRITER
        self.recording = None

    def begin(self, decider: PageDecider):
        """Set the decider, once it is ready."""
        self._decider = decider

    def set_examples(self, examples) -> dict:
        """Set the samples of the network's check; returns the message ``examples``.

        Parameters
        ----------
        examples : list of pipeline.live.examples.Example
        """
        self._examples = Examples(examples, [3, self._number])
        counts = self._examples.count_by_class(len(self._sensor.classes))
        return {"type": "examples", "counts": counts}

    @property
    def changes_with_time(self) -> bool:
        """True if the answer of the network can change without an event."""
        return self._decider is not None and self._decider.changes_with_time

    def make_writer_message(self) -> dict:
        """The message ``writer``: the writer, those with recordings, and the number of its own."""
        counts = self._keeper.writers
        number = self._writer
        return {
            "type": "writer",
            "number": number,
            "known": sorted(counts),
            "saved": counts[number],
        }

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
        message = parse_message(text)
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

    def make_output_task(self):
        """A function for another thread that computes the next output, or None.

        The function returns the message ``answer``, or None.
        """
        recording = self.recording
        if self._decider is None or recording is None:
            return None
        events = recording.writing.events
        known_s = recording.known_s

        def compute():
            output = recording.deciding.compute_output(events, known_s)
            if output is None:
                return None
            recording.take_output(output, known_s == math.inf)
            return make_output_message(recording, events, output)

        return compute

    def make_spikes_message(self):
        """The message ``spikes`` of the latest output, or None."""
        recording = self.recording
        if recording is None or recording.output is None:
            return None
        return make_spikes_message(recording, recording.output)

    def _handle_pen(self, message):
        now_ms = read_number(message, "now")
        points = read_points(message, now_ms, self._sensor)
        if self._decider is None:
            return []  # the page says that it is not ready yet
        replies = []
        for point in points:
            if point[4] and self._is_new(point[0]):
                self._begin(point[0])
                number = self.recording.number
                replies.append({"type": "cleared", "recording": number, "begun_ms": point[0]})
            if self.recording is not None and not self.recording.is_complete:
                self.recording.add_point(*point)
        if self.recording is not None:
            events = self.recording.advance(now_ms)
            replies.append(make_events_message(self.recording, events))
        return replies

    def _is_new(self, page_ms):
        recording = self.recording
        if recording is None or recording.is_complete:
            return True
        if recording.is_down:
            return False
        return recording.has_ended or recording.is_after(recording.to_recording_s(page_ms))

    def _begin(self, page_ms):
        self._recordings += 1
        seed = (2, self._number, self._recordings)
        sensor = self._sensor
        writing = Writing(seed, self._parameters, (sensor.rows, sensor.columns), sensor.polarities)
        self.recording = OpenRecording(
            self._recordings, page_ms, self._decider.begin(), writing, self._writer
        )

    def _handle_example(self, message):
        now_ms = read_number(message, "now")
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
        description = {"name": example.name, "label": example.label}
        return [{"type": "cleared", "recording": self._recordings, "example": description}]

    def _read_class(self, message):
        return read_whole_number(message, "label", 0, len(self._sensor.classes) - 1)

    def _handle_clear(self, message):
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
        replies = [make_events_message(recording, recording.finish())]
        events = recording.writing.events
        if len(events) == 0:
            return [
                *replies,
                make_problem_message("no taxel has an event; write with more pressure"),
            ]
        taxels = self._sensor.rows * self._sensor.columns
        saved = self._keeper.save(label, MatRecording(events, True, recording.writer, True, taxels))
        recording.is_complete = True
        recording.saved_as = saved
        if saved_before is not None:  # the label was wrong
            self._keeper.remove(saved_before)
        reply = {
            "type": "saved",
            "label": label,
            "recording": recording.number,
            "name": saved.name,
            "events": len(events),
        }
        return [*replies, reply, self.make_writer_message()]

    def _handle_undo(self, message):
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
        if number is not None and (type(number) is not int or not 1 <= number < END_OF_WRITERS):
            raise BadMessage(f"number: not from 1 to {END_OF_WRITERS - 1}")
        if number is None:
            number = self._keeper.add_writer()
        self._keeper.note_writer(number)
        self._writer = number
        return [self.make_writer_message()]


_HANDLERS = {
    "pen": Session._handle_pen,
    "clear": Session._handle_clear,
    "label": Session._handle_label,
    "example": Session._handle_example,
    "undo": Session._handle_undo,
    "writer": Session._handle_writer,
}
