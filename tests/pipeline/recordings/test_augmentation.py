"""Samples as they might have been written at another time."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.recordings.augmentation import (
    Alteration,
    alter_events,
    alter_recordings,
    choose_augmentation,
)
from pipeline.recordings.columns import EventColumns
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor

STILL = Alteration(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def altered(how, n=400, seed=0):
    """One event in the middle of the left edge in step 10, in each of n samples."""
    ones = np.ones(n, int)
    rng = np.random.default_rng(seed)
    events = EventColumns(np.arange(n), 10.0 * ones, 4 * ones, 0 * ones, ones)
    return alter_events(how, rng, events, n, 1.0)


def test_nothing_altered_but_where_in_its_step_a_sample_begins():
    sample, step, row, column, polarity = altered(STILL)
    assert sample.tolist() == list(range(400))
    assert (set(row), set(column), set(polarity)) == ({4}, {0}, {1})
    assert 10 <= step.min() < 10.1
    assert 10.9 < step.max() <= 11


def test_each_change_does_what_it_says():
    sample, step, *_ = altered(replace(STILL, stretch=0.2))
    assert np.std(np.log((step - 0.5) / 10)) == pytest.approx(0.2, abs=0.05)
    assert len(altered(replace(STILL, drop=0.5), n=4000)[0]) == pytest.approx(3000, abs=150)
    # A quarter turn takes the middle of the left edge to an end of the middle column.
    _, _, row, column, _ = altered(replace(STILL, turn=np.pi / 2))
    assert {(0, 4), (9, 5)} & set(zip(row.tolist(), column.tolist(), strict=True))
    # Half of those moved to the left fall off the edge.
    sample, _, row, column, _ = altered(replace(STILL, shift=1.0))
    assert 200 < len(sample) < 330
    assert np.std(row - 4.0) == pytest.approx(1.04, abs=0.2)
    # Near the middle row a slant moves by half a taxel at most, stretching columns moves the edge.
    assert set(altered(replace(STILL, shear=0.5))[3]) <= {0, 1}
    assert set(altered(replace(STILL, scale=0.3))[2]) <= {3, 4}
    assert len(set(altered(replace(STILL, scale=0.3))[3])) > 1


def recordings(*columns):
    parts = [Events(*part) for part in columns]
    labels, ids = [3, 5][: len(parts)], ["3/0000", "5/0000"][: len(parts)]
    return join_recordings(parts, labels, ids, [4, 4][: len(parts)], Source("made up", "", True))


def test_recordings_that_are_altered_by_nothing():
    one = ([10_000_000, 30_000_000], [44, 55], [1, -1], [4, 2])
    other = ([5_000_000], [7], [1], [5])
    changed = alter_recordings(recordings(one, other), [1, 0, 0], STILL, 10.0, 0)
    assert changed.labels.tolist() == [5, 3, 3]
    assert len(set(changed.ids)) == 3
    assert changed.offsets.tolist() == [0, 1, 3, 5]
    first, second, third = (changed[i] for i in range(3))
    assert (first.taxel.tolist(), first.columns.tolist()) == ([7], [5])
    assert second.polarity.tolist() == [1, -1]
    # Each begins anywhere within ten milliseconds; the rest of it moves along.
    assert np.diff(second.time_ns).tolist() == pytest.approx([20e6], abs=2)
    assert 10e6 <= second.time_ns[0] < 20e6
    assert second.time_ns[0] != third.time_ns[0]


def test_recordings_without_events_and_events_that_fall_off_the_edge():
    empty = ([], [], [], [])
    changed = alter_recordings(recordings(empty), [0, 0], STILL, 10.0, 0)
    assert changed.offsets.tolist() == [0, 0, 0]
    corner = ([0, 1, 2], [0, 0, 99], [1, 1, 1], [4, 4, 4])
    far = replace(STILL, shift=50.0)
    assert len(alter_recordings(recordings(corner), [0] * 5, far, 10.0, 0).events) < 15


def test_events_of_altered_recordings_are_those_of_alter():
    rng = np.random.default_rng(0)
    times = np.sort(rng.integers(0, 10**9, 200))
    many = (times, rng.integers(0, 100, 200), rng.choice([-1, 1], 200), np.full(200, 4))
    how = Alteration(hot=0.0, dead=0.0)
    changed = alter_recordings(recordings(many), [0], how, 10.0, 7)
    taxel = np.asarray(many[1])
    time_ms = (times - times[0]) / 1e6
    events = EventColumns(np.zeros(200, int), time_ms, taxel % 10, taxel // 10, many[2])
    _, altered_ms, row, column, _ = alter_events(how, np.random.default_rng(7), events, 1, 10.0)
    assert sorted((10 * column + row).tolist()) == sorted(changed[0].taxel.tolist())
    assert (np.diff(changed[0].time_ns) >= 0).all()
    np.testing.assert_allclose(
        np.sort(altered_ms), (changed[0].time_ns - times[0]) / 1e6, rtol=0, atol=1e-5
    )


@pytest.mark.parametrize(
    ("source", "sensor", "how"),
    [
        (Source("simulated", "", True), Sensor(), "space"),
        (Source("simulated", "", True), Sensor(16, 16), "space"),
        (Source("st-mnist.zip", "", False), Sensor(), "space"),
        (Source("written", "", True, True), Sensor(9, 12, classes=("a", "b")), "space"),
        (Source("own", "", True), Sensor(9, 12, classes=("a", "b")), "slight"),
        (Source("strip", "", False, time_unit="us"), Sensor(1, 39), "time"),
        (Source("camera", "", False, time_unit="us"), Sensor(), "slight"),
    ],
)
def test_handwriting_is_altered_in_space_and_other_grids_slightly(source, sensor, how):
    recordings = join_recordings(
        [Events([0], [0], [1], [1])], [0], ["0"], [-1], source, sensor=sensor
    )
    assert choose_augmentation(recordings) == how


def test_samples_get_hot_and_dead_taxels():
    n, ones = 500, np.ones(500, int)
    events = EventColumns(np.arange(n), 1000.0 * ones, 4 * ones, 5 * ones, ones)
    hot = alter_events(replace(STILL, hot=1.0), np.random.default_rng(0), events, n, 10.0)
    assert set(hot.sample.tolist()) == set(range(n))
    assert len(hot.sample) > 10 * n
    dead = alter_events(replace(STILL, dead=1.0), np.random.default_rng(0), events, n, 10.0)
    assert 0.9 * n < len(dead.sample) < n
