"""The messages of a page: what it sends is read and checked, and what it receives is made.

A message is a dict.  A page sends:

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
draw, and are therefore not in every ``answer``.  Any other message raises :class:`BadMessage`.
"""

import base64
import json

import numpy as np

from pipeline.live.deciding import NetworkOutput
from pipeline.live.recording import OpenRecording
from pipeline.simulation.pen import MARGIN_TAXELS, START_S

# Maximum number of points in a message.
MAX_POINTS = 512

# Maximum number of taxels of a skin to write on: with more, the simulation would take too long
# in addition to the page and its network (0.15 s of processor time per second for this number).
MAX_TAXELS = 4096


class BadMessage(ValueError):
    """Raised for a message that the page would not send; the text has the reason."""


def parse_message(text: str) -> dict:
    """The message of a text.

    Raises
    ------
    BadMessage
        The text is no object in JSON.
    """
    try:
        message = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadMessage(f"not JSON: {error}") from error
    if not isinstance(message, dict):
        raise BadMessage("not a JSON object")
    return message


def read_number(message: dict, name: str):
    """A number of a message."""
    value = message.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= 1e12:
        raise BadMessage(f"{name}: not a number")  # NaN, too
    return value


def read_whole_number(message: dict, name: str, lowest: int, highest: int) -> int:
    """A whole number of a message, within limits."""
    value = message.get(name)
    if type(value) is not int or not lowest <= value <= highest:
        raise BadMessage(f"{name}: not a whole number from {lowest} to {highest}")
    return value


def read_points(message: dict, now_ms: float, sensor) -> list:
    """The points of the pen, (t, right, down, pressure, touches) of each.

    Parameters
    ----------
    message : dict
    now_ms : float
        Time of the message on the page's clock.
    sensor : Sensor

    Raises
    ------
    BadMessage
    """
    points = message.get("points")
    if not isinstance(points, list) or len(points) > MAX_POINTS:
        raise BadMessage(f"points: not a list of at most {MAX_POINTS}")
    points = [_read_point(point, sensor) for point in points]
    if any(point[0] > now_ms + 1000 for point in points):
        raise BadMessage("points: later than now")
    return points


def _read_point(values, sensor):
    if sensor.rows * sensor.columns > MAX_TAXELS:
        raise BadMessage(f"points: a skin of more than {MAX_TAXELS} taxels is not simulated")
    right, down = (side - 1 + MARGIN_TAXELS for side in (sensor.columns, sensor.rows))
    ranges = (
        (-1e12, 1e12),
        (-MARGIN_TAXELS, right),
        (-MARGIN_TAXELS, down),
        (0, 1),
        (0, 1),
    )
    if not isinstance(values, list) or len(values) != len(ranges):
        raise BadMessage("points: not five values each")
    for value, (lowest, highest) in zip(values, ranges, strict=True):
        if type(value) not in (int, float) or not lowest <= value <= highest:
            raise BadMessage("points: a value is not a number, or out of range")
    return *values[:4], bool(values[4])


def make_problem_message(text: str) -> dict:
    """The message with an error for the user."""
    return {"type": "problem", "text": text}


def make_events_message(recording: OpenRecording, events) -> dict:
    """The message with the events since the last one."""
    return {
        "type": "events",
        "recording": recording.number,
        "time_s": recording.writing.time_s,
        "ns": events.time_ns.tolist(),
        "taxel": events.taxel.tolist(),
        "polarity": events.polarity.tolist(),
        "settled": recording.has_ended,
        "over": recording.is_over,
    }


def make_output_message(recording: OpenRecording, events, output: NetworkOutput) -> dict:
    """The message with the latest output of the network."""
    verdict = recording.verdict
    last = output.curve.find_last()
    return {
        "type": "answer",
        "recording": recording.number,
        "last_ms": recording.to_page_ms(events.time_ns[-1] * 1e-9) if len(events) else None,
        "events": len(events),
        "decision": last.label,
        "confidence": last.confidence,
        "exceeds_training": output.exceeds_training,
        "shares": output.curve.probabilities[-1].round(4).tolist(),
        "verdict": verdict and {**verdict._asdict(), "seconds": verdict.seconds - START_S},
    }


def make_spikes_message(recording: OpenRecording, output: NetworkOutput) -> dict:
    """The message with the spikes of the latest output."""
    layers = output.spikes.items()
    in_255ths = np.rint(255 * output.curve.probabilities).astype(np.uint8)
    return {
        "type": "spikes",
        "recording": recording.number,
        "layers": {name: base64.b64encode(rows.tobytes()).decode() for name, rows in layers},
        "seconds": (output.curve.seconds - START_S).round(4).tolist(),
        "chances": base64.b64encode(in_255ths.tobytes()).decode(),
    }
