"""Examples are what the network's check has, and what the page has kept."""

import math
import re
import shutil
from collections import Counter

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.errors import UserError
from deploy.targets.registry import run_target
from pipeline.live.deciding import make_decider
from pipeline.live.examples import Example, Examples, ReplayedTouch, list_check_examples
from pipeline.live.network import SHIPPED
from pipeline.recordings.events import Events
from pipeline.recordings.sensor import Sensor
from pipeline.settings import read_settings
from pipeline.simulation.pen import START_S
from pipeline.sources import load_named_recordings
from pipeline.storage.run_folder import RunFolder


def line(n=5):
    return Events(200_000_000 + 1_000_000 * np.arange(n), np.arange(n), np.ones(n), np.ones(n))


def test_a_bundle_on_events_has_examples_that_are_answered_as_in_its_check():
    bundle = read_bundle(SHIPPED)
    tests = list_check_examples(RunFolder(SHIPPED.parent), bundle)
    assert len(tests) == len(bundle.checks)
    some = range(0, len(tests), 25)
    spec = bundle.spec.with_presentation(stream_length=1)
    expected = run_target(spec, bundle.checks.inputs[some], "fast")
    decider = make_decider(bundle, Sensor())
    for place, index in enumerate(some):
        assert tests[index].events.time_ns[0] == round(START_S * 1e9)
        said = decider.begin().compute_output(tests[index].events, math.inf)
        np.testing.assert_array_equal(said.scores, expected.scores[place])
        assert tests[index].label == bundle.checks.labels[index]


def test_a_run_has_the_recordings_of_its_check_with_their_times(tiny_run, tmp_path):
    run = RunFolder(tiny_run)
    bundle = read_bundle(run.bundle)
    tests = list_check_examples(run, bundle)
    assert [test.name for test in tests] == list(bundle.checks.ids)
    recordings = load_named_recordings(read_settings(run.experiment))
    first = recordings[recordings.ids.index(tests[0].name)]
    np.testing.assert_array_equal(np.diff(tests[0].events.time_ns), np.diff(first.time_ns))
    np.testing.assert_array_equal(tests[0].events.taxel, first.taxel)
    # Of images alone nobody knows when their events were.
    shutil.copytree(run.bundle, tmp_path / "bundle")
    with pytest.raises(UserError, match=re.escape(str(tmp_path / "bundle"))):
        list_check_examples(RunFolder(tmp_path), read_bundle(tmp_path / "bundle"))


def test_every_example_of_a_class_comes_before_one_comes_again():
    tests = [Example(line(), label, f"{label}/{n}") for label in (3, 4) for n in range(5)]
    examples = Examples(tests, [0])
    drawn = [examples.draw(3).name for _ in range(10)]
    assert set(Counter(drawn).values()) == {2}
    assert set(drawn[:5]) == {f"3/{n}" for n in range(5)}
    assert drawn[:5] != sorted(drawn[:5])
    assert {examples.draw().label for _ in range(10)} == {3, 4}
    assert [Examples(tests, [0]).draw(3).name for _ in range(2)] == [drawn[0]] * 2
    with pytest.raises(UserError):
        examples.draw(5)


def test_a_replay_gives_each_event_once_and_at_its_time():
    replay, told = ReplayedTouch(line()), []
    for until in (0.2, 0.2015, 0.2015, 0.1, 0.203, 0.9):
        told.append(len(replay.advance(until)))
        assert len(replay.events) == sum(told)
    assert told == [0, 2, 0, 0, 1, 2]
    assert replay.settled_s == pytest.approx(0.254)
