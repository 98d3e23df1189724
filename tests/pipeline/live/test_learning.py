"""Learning a writer's handwriting on the page, with the network that comes with the package."""

import json
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from pipeline.data.events import Sensor
from pipeline.live.keeping import Keeper
from pipeline.live.learning import Learner
from pipeline.live.network import SHIPPED
from pipeline.live.session import BadMessage, Session
from pipeline.settings import Image
from pipeline.skin import handwriting, parameters
from pipeline.skin.handwriting import Trace
from pipeline.skin.shape_model import boxed
from pipeline.skin.simulate import simulate
from tests.pipeline.live.conftest import Parrot, stroke

BUNDLE = read_bundle(SHIPPED)
KEPT = f".readout-w001-{BUNDLE.id[:12]}.npz"
P = parameters.load()


@pytest.fixture(scope="module")
def strange():
    """Recordings of somebody whose digits lean far to the left."""
    rng = np.random.default_rng(5)
    who = handwriting.writers(rng, P.writers, P.shapes)[0]
    leaning = np.array([[1.0, 0.7], [0.0, 1.0]])
    traces = [
        Trace(digit, 7, boxed(s @ leaning for s in handwriting.write(digit, who, rng, P.shapes)))
        for digit in range(10)
        for _ in range(2)
    ]
    return simulate(5, [2] * 10, 1, traces=traces)


def learner_of(folder):
    return Learner(BUNDLE, Image(), folder, Sensor())


def taught(learner, recordings, writer=1):
    rng = np.random.default_rng(0)
    for index in rng.permutation(len(recordings)):
        label = int(recordings.labels[index])
        state = learner.learn(writer, f"{label}/{index}", label, recordings[index])
    return state


def test_a_strange_hand_is_learned_and_scored_before_it_is(strange, tmp_path):
    learner = learner_of(tmp_path)
    assert learner.recall(1) == {
        "type": "learned", "writer": 1, "digits": 0, "right": 0, "of": 0, "own_readout": False
    }  # fmt: skip
    assert learner.decider(1) is None
    state = taught(learner, strange)
    assert (state["digits"], state["of"], state["own_readout"]) == (20, 10, True)
    assert list(tmp_path.iterdir()) == [tmp_path / KEPT]
    # What it now says of a digit that it has learned is what was written.
    right = [
        learner.decider(1).begin().answer(strange[i], np.inf).decision == strange.labels[i]
        for i in range(20)
    ]
    assert np.mean(right) > 0.9
    # The score is of the readouts before each digit, and so lower than that.
    scored = learner._known(1).right
    assert scored.mean() < np.mean(right)
    # The other writers have the bundle's readout.
    assert learner.recall(2)["digits"] == 0
    assert learner.decider(2) is None
    # Another learner, such as after a restart, goes on where this one is.
    again = learner_of(tmp_path)
    assert again.recall(1) == state
    np.testing.assert_array_equal(again._known(1).weights, learner._known(1).weights)
    assert again.decider(1) is not None
    # One removed, then all.
    assert again.forget(1, again._known(1).names[-1])["digits"] == 19
    assert again.forget(1)["digits"] == 0
    assert again.decider(1) is None
    assert not list(tmp_path.iterdir())


def test_what_is_of_another_network_or_damaged_is_not_used(strange, tmp_path):
    path = tmp_path / KEPT
    path.write_bytes(b"no arrays")
    assert learner_of(tmp_path).recall(1)["digits"] == 0
    learner = learner_of(tmp_path)
    learner.learn(1, "one", 3, strange[6])
    assert learner_of(tmp_path).recall(1)["digits"] == 1
    with np.load(path) as arrays:
        changed = {**arrays, "bundle": np.array("0" * 64)}
    np.savez(path, **changed)
    assert learner_of(tmp_path).recall(1)["digits"] == 0


def test_another_network_keeps_its_own_readout(strange, tmp_path):
    other = Learner(replace(BUNDLE, id="0" * 64), Image(), tmp_path, Sensor())
    for learner in (learner_of(tmp_path), other):
        learner.learn(1, "one", 3, strange[6])
    assert [each.recall(1)["digits"] for each in (learner_of(tmp_path), other)] == [1, 1]
    assert other.forget(1)["digits"] == 0
    assert learner_of(tmp_path).recall(1)["digits"] == 1


@pytest.fixture(scope="module")
def kept(strange, tmp_path_factory):
    """The arrays that are kept of a writer of two digits."""
    folder = tmp_path_factory.mktemp("kept")
    learner = learner_of(folder)
    for name, label in (("one", 3), ("two", 5)):
        learner.learn(1, name, label, strange[6])
    with np.load(folder / KEPT) as arrays:
        return dict(arrays)


def test_a_network_that_cannot_be_fitted_learns_nothing(tmp_path):
    forgetful = replace(BUNDLE, spec=replace(BUNDLE.spec, rehearsal=None))
    assert Learner.of(forgetful, Image(), tmp_path, Sensor()) is None
    assert Learner.of(BUNDLE, Image(), tmp_path, Sensor()) is not None


class Notes:
    """A learner that notes what it is asked for."""

    def __init__(self):
        self.asked = []

    def decider(self, writer):
        return None

    def __getattr__(self, name):
        return lambda *given: self.asked.append((name, *given[:2])) or {"type": "learned"}


@pytest.fixture
def session(tmp_path):
    with closing(Keeper(tmp_path / "kept")) as keeper:
        session = Session(1, keeper, P)
        session.notes = Notes()
        session.begin(Parrot(), session.notes)
        yield session


def say(session, message):
    replies = session.handle(json.dumps(message))
    for lesson in session.lessons():
        lesson()
    return replies


def write(session, start_ms):
    for message in stroke(start_ms=start_ms):
        say(session, message)


def test_each_labelled_digit_is_a_lesson_unless_learning_is_off(session):
    write(session, 1000.0)
    saved = say(session, {"type": "label", "label": 4})
    name = next(reply["name"] for reply in saved if reply["type"] == "saved")
    assert session.notes.asked == [("recall", 1), ("learn", 1, name)]
    assert session.lessons() == []
    assert say(session, {"type": "learning", "on": False})[0]["learns"] is False
    write(session, 9000.0)
    say(session, {"type": "label", "label": 4})
    assert len(session.notes.asked) == 2
    say(session, {"type": "undo"})
    say(session, {"type": "forget"})
    assert session.notes.asked[2:] == [("forget", 1, "4/w001-0002.mat"), ("forget", 1)]
    say(session, {"type": "writer", "number": 3, "handedness": "", "each": 0})
    assert session.notes.asked[-1] == ("recall", 3)
    with pytest.raises(BadMessage):
        say(session, {"type": "learning", "on": 1})


def test_learning_changes_nothing_that_is_recorded(tmp_path, strange):
    kept = []
    for learner in (None, Notes()):
        with closing(Keeper(tmp_path / str(learner is None))) as keeper:
            session = Session(1, keeper, P, now=lambda: __import__("datetime").datetime(2026, 1, 1))
            session.begin(Parrot(), learner)
            write(session, 1000.0)
            say(session, {"type": "label", "label": 4})
            kept.append((keeper.folder / "4" / "w001-0001.mat").read_bytes())
    assert kept[0] == kept[1]
