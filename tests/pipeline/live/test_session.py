"""One page's side of the conversation, without sockets."""

import base64
import json
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from pipeline.live.examples import Example
from pipeline.live.keeping import Keeper
from pipeline.live.messages import BadMessage
from pipeline.live.recording import MAX_RECORDING_S, PAUSE_S
from pipeline.live.session import Session
from pipeline.recordings.events import Events
from pipeline.recordings.formats.mat import read_recording
from pipeline.recordings.sensor import Sensor
from pipeline.simulation import parameters
from tests.pipeline.live.conftest import Parrot, stroke
from tests.pipeline.live.test_keeping import recording

P = parameters.read_parameters()


@pytest.fixture
def keeper(tmp_path):
    keeper = Keeper(tmp_path / "kept")
    yield keeper
    keeper.close()


@pytest.fixture
def session(keeper):
    session = Session(1, keeper, P)
    session.begin(Parrot())
    return session


def say(session, message):
    return session.handle(json.dumps(message))


def select_replies(replies, kind):
    return [reply for reply in replies if reply["type"] == kind]


def write_stroke(session, **options):
    return [reply for message in stroke(**options) for reply in say(session, message)]


def pause(session, lifted_ms=1300.0):
    """Wait until no other stroke can belong to the recording; returns the replies."""
    return say(session, {"type": "pen", "now": lifted_ms + 1000 * PAUSE_S + 1, "points": []})


def test_events_come_while_writing(session):
    events = select_replies(write_stroke(session), "events")
    assert sum(bool(reply["ns"]) for reply in events) > 5  # not all at the end
    assert not events[-1]["settled"]
    assert select_replies(pause(session), "events")[-1]["settled"]


def test_the_events_of_the_page_are_those_that_are_kept(session, keeper):
    replies = [*write_stroke(session), *pause(session)]
    replies += say(session, {"type": "label", "label": 1})
    saved = select_replies(replies, "saved")[0]
    read = read_recording((keeper.folder / saved["name"]).read_bytes())
    for name, column in (("ns", "time_ns"), ("taxel", "taxel"), ("polarity", "polarity")):
        told = [value for reply in select_replies(replies, "events") for value in reply[name]]
        assert told == getattr(read.events, column).tolist()
    assert saved["events"] == len(read.events) > 20
    assert read.written
    assert select_replies(replies, "writer")[-1]["saved"] == 1


def test_the_answer_is_to_all_events_so_far(session):
    assert session.make_output_task() is session.make_spikes_message() is None
    replies = write_stroke(session)
    assert session.make_spikes_message() is None  # nothing has been asked yet
    n = sum(len(reply["ns"]) for reply in select_replies(replies, "events"))
    answer = session.make_output_task()()
    assert (answer["events"], answer["decision"]) == (n, n % 10)
    assert sum(answer["shares"]) == pytest.approx(1)
    spikes = session.make_spikes_message()
    seconds = spikes["seconds"]
    assert answer["confidence"] == pytest.approx(1)
    verdict = answer["verdict"]
    assert verdict["early"] is True
    assert verdict["confidence"] >= 0.9
    assert verdict["seconds"] in [pytest.approx(at, abs=1e-3) for at in seconds]
    assert 0 < verdict["seconds"] < seconds[-1]
    assert len(base64.b64decode(spikes["chances"])) == 10 * len(seconds)
    assert spikes["recording"] == answer["recording"]
    assert len(base64.b64decode(spikes["layers"]["input"])) == 3 * 13
    last = max(ns for reply in select_replies(replies, "events") for ns in reply["ns"])
    assert answer["last_ms"] == pytest.approx(1000 + (last * 1e-9 - 0.2) * 1e3)


class Waits(Parrot):
    """It never decides early, and becomes less sure when nothing happens any more."""

    threshold = None

    def compute_output(self, events, time_s):
        answer = super().compute_output(events, time_s)
        end = events.time_ns[-1] * 1e-9 + 1 if np.isinf(time_s) else time_s
        curve = replace(
            answer.curve,
            seconds=np.append(answer.curve.seconds, end),
            confidences=np.append(answer.curve.confidences, 0.2),
            classes=np.append(answer.curve.classes, 0),
            probabilities=np.append(answer.curve.probabilities, answer.curve.probabilities[-1:], 0),
        )
        return replace(answer, curve=curve)


def test_without_an_early_decision_the_verdict_is_the_answer_at_the_end(keeper):
    """It comes when another stroke would begin another recording."""
    session = Session(1, keeper, P)
    session.begin(Waits())
    messages = list(stroke())
    for message in messages[:8]:
        say(session, message)
    assert session.make_output_task()()["verdict"] is None
    for message in messages[8:]:
        say(session, message)
    assert session.make_output_task()()["verdict"] is None
    pause(session)
    answer = session.make_output_task()()
    verdict = answer["verdict"]
    assert verdict["early"] is False
    assert verdict["label"] == answer["decision"]
    assert verdict["confidence"] == answer["confidence"] == pytest.approx(0.2)


def test_a_pause_begins_another_recording_and_a_short_one_does_not(session):
    first = select_replies(write_stroke(session, start_ms=1000.0), "cleared")
    second = select_replies(
        write_stroke(session, start_ms=1000 + 300 + 400.0, right=6.0), "cleared"
    )
    third = select_replies(write_stroke(session, start_ms=9000.0), "cleared")
    assert [len(first), len(second), len(third)] == [1, 0, 1]
    assert third[0]["recording"] == first[0]["recording"] + 1


def test_a_recording_ends_and_the_next_stroke_begins_another(session, keeper):
    replies = write_stroke(session, seconds=MAX_RECORDING_S + 2, per_message=10)
    assert select_replies(replies, "events")[-1]["over"]
    say(session, {"type": "label", "label": 1})
    read = read_recording(next(keeper.folder.rglob("w*.mat")).read_bytes())
    assert read.events.time_ns[-1] < MAX_RECORDING_S * 1e9
    replies = write_stroke(session, start_ms=1000.0 * (MAX_RECORDING_S + 4))
    assert select_replies(replies, "cleared")
    assert say(session, {"type": "label", "label": 2})[1]["type"] == "saved"


def test_new_writers_on_two_pages_have_two_numbers(session, keeper):
    """Also before they have saved anything, and after one of them has lost its connection."""
    new = {"type": "writer", "number": None}
    assert say(session, new)[0]["number"] == 1
    other = Session(2, keeper, P)
    assert say(other, new)[0]["number"] == 2
    again = Session(3, keeper, P)
    assert say(again, {**new, "number": 7})[0]["number"] == 7  # the browser has stored it
    assert say(other, new)[0]["number"] == 8


def test_a_page_counts_the_recordings_of_its_own_writer(session, keeper):
    for label in (3, 4):
        keeper.save(label, recording(writer=1))
    saved = [say(session, {"type": "writer", "number": n})[0]["saved"] for n in (1, None)]
    assert saved == [2, 0]


def test_a_mislabelled_recording_is_saved_again(session, keeper):
    """After an undo, or at once as another class."""
    write_stroke(session)
    say(session, {"type": "label", "label": 7})
    say(session, {"type": "label", "label": 3})
    assert len(keeper) == 1
    assert select_replies(say(session, {"type": "undo"}), "undone")[0]["label"] == 3
    (saved,) = select_replies(say(session, {"type": "label", "label": 8}), "saved")
    assert saved["name"] == "8/w001-0001.mat"
    assert len(keeper) == 1
    read = read_recording((keeper.folder / saved["name"]).read_bytes())
    assert len(read.events) == saved["events"] > 20
    assert select_replies(say(session, {"type": "label", "label": 8}), "problem")
    say(session, {"type": "undo"})
    assert select_replies(
        write_stroke(session, start_ms=1400.0), "cleared"
    )  # it is not written on again


POINT = [1.0, 4.0, 4.0, 0.5, 1]


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[]", "7", "null", '"pen"', "[" * 100_000, "NaN", "{}",
        json.dumps({"type": "pen"}),
        json.dumps({"type": ["pen"]}),
        json.dumps({"type": "save"}),
        json.dumps({"type": "label"}),
        json.dumps({"type": "label", "label": 10}),
        json.dumps({"type": "label", "label": True}),
        json.dumps({"type": "label", "label": "../../1"}),
        json.dumps({"type": "writer", "number": 0}),
        json.dumps({"type": "writer", "number": "../1"}),
        json.dumps({"type": "pen", "now": "now", "points": []}),
        json.dumps({"type": "pen", "now": float("nan"), "points": []}),
        json.dumps({"type": "pen", "now": 1000, "points": {}}),
        json.dumps({"type": "pen", "now": 1000, "points": [1]}),
        json.dumps({"type": "pen", "now": 1000, "points": [POINT] * 513}),
        '{"type": "pen", "now": 1000, "points": [[1000, 1' + "0" * 400 + ', 1, 0.5, 1]]}',
        *(
            json.dumps({"type": "pen", "now": 1, "points": [[*POINT[:i], value, *POINT[i + 1 :]]]})
            for i, value in [(0, 1e300), (0, None), (0, 9e9), (1, -2.1), (1, "4"), (2, 11.5),
                             (2, float("inf")), (3, 1.5), (3, -0.1), (4, 2), (4, "yes")]
        ),
    ],
)  # fmt: skip
def test_malformed_messages_are_refused(session, keeper, text):
    with pytest.raises(BadMessage):
        session.handle(text)
    assert len(keeper) == 0
    assert session.recording is None


def test_a_disk_that_fails_is_said_and_the_digit_can_be_kept_again(session, keeper, monkeypatch):
    write_stroke(session)

    def fails(folder, places=()):
        raise OSError(5, "Input/output error", str(folder))

    with monkeypatch.context() as patched:
        patched.setattr("pipeline.live.keeping._list_recordings", fails)
        text = select_replies(say(session, {"type": "label", "label": 1}), "problem")[0]["text"]
        assert "Input/output error" in text
        patched.setattr(Keeper, "save", lambda keeper, *given: fails("disk"))
        assert (
            "disk: "
            in select_replies(say(session, {"type": "label", "label": 1}), "problem")[0]["text"]
        )
    assert select_replies(say(session, {"type": "label", "label": 1}), "saved")


LINE = Events(205_000_000 + 20_000_000 * np.arange(40), np.arange(40), [1, -1] * 20, [1] * 40)


ASK_FOR_EXAMPLE = {"type": "example", "now": 5000.0, "label": 7}


def test_an_example_goes_its_own_pace(session):
    assert session.set_examples([Example(LINE, 7, "7/0001")])["counts"] == [0] * 7 + [1, 0, 0]
    begun = say(session, ASK_FOR_EXAMPLE)[0]
    assert begun["example"] == {"name": "7/0001", "label": 7}
    told = []
    for now in np.arange(5010.0, 6000.0, 50.0).tolist():
        part = select_replies(say(session, {"type": "pen", "now": now, "points": []}), "events")[0]
        told += part["ns"]
        assert told == [ns for ns in LINE.time_ns.tolist() if ns < 1e6 * (now - 5000) + 2e8]
    assert part["settled"]
    assert session.make_output_task()()["events"] == 40


def test_an_example_is_kept_no_second_time(session, keeper):
    session.set_examples([Example(LINE, 7, "7/0001")])
    say(session, ASK_FOR_EXAMPLE)
    for now in np.arange(5010.0, 6000.0, 50.0).tolist():
        say(session, {"type": "pen", "now": now, "points": []})
    assert select_replies(say(session, {"type": "label", "label": 7}), "problem")
    assert len(keeper) == 0
    start = stroke(start_ms=9000.0)
    assert select_replies([r for m in start for r in say(session, m)], "cleared")
    assert select_replies(say(session, {"type": "label", "label": 1}), "saved")
    assert say(session, {**ASK_FOR_EXAMPLE, "label": None})[0]["example"]["label"] == 7
    assert select_replies(say(session, {**ASK_FOR_EXAMPLE, "label": 3}), "problem")


def test_a_sensor_of_ones_own(tmp_path):
    with closing(Keeper(tmp_path / "kept", Sensor(9, 12, 1, classes=("a", "b c")))) as keeper:
        session = Session(1, keeper, P)
        session.begin(Parrot(2))
        events = select_replies(write_stroke(session, right=11.0), "events")
        assert {p for reply in events for p in reply["polarity"]} == {1}
        saved = select_replies(say(session, {"type": "label", "label": 1}), "saved")[0]
        assert saved["name"] == "b c/w001-0001.mat"
        read = read_recording((keeper.folder / saved["name"]).read_bytes(), 108)
        assert np.median(read.events.taxel // 9) >= 10
        for message in (
            {"type": "label", "label": 2},
            {"type": "pen", "now": 9.0, "points": [[9.0, 4.0, 10.5, 0.5, 1]]},
        ):
            with pytest.raises(BadMessage):
                session.handle(json.dumps(message))
