"""Hot and dead taxels, in training samples and in checks."""

import numpy as np
import pytest

from pipeline.recordings.columns import EventColumns
from pipeline.recordings.events import Events
from pipeline.recordings.faulty_taxels import (
    CHECK_PERIOD_MS,
    HOT_PERIOD_MS,
    MAX_DEAD_SHARE,
    MAX_HOT_TAXELS,
    FaultCounts,
    add_faults,
    draw_faults,
    place_faults,
)
from pipeline.recordings.recordings import Source, join_recordings

SIZE = (4, 5)
PLACES = np.stack(np.divmod(np.arange(20), 5), 1)


def one_event_a_taxel(samples, time_ms=0.0):
    """An ON event of every taxel in each sample."""
    sample = np.repeat(np.arange(samples), len(PLACES))
    row, column = np.tile(PLACES, (samples, 1)).T
    return EventColumns(sample, np.full(len(sample), time_ms), row, column, 0 * sample)


def taxels_of(events):
    return set(map(tuple, np.stack([events.sample, events.row, events.column], 1).tolist()))


def test_a_check_has_the_number_of_faults_that_was_asked_for():
    durations_ms = np.array([800.0, 1600.0, 0.0])
    faults = place_faults(FaultCounts(2, 3), np.random.default_rng(0), durations_ms, PLACES, SIZE)
    dead = ~faults.live
    assert dead.reshape(3, -1).sum(1).tolist() == [3, 3, 3]
    hot = faults.draw_hot_events()
    for sample, duration_ms in enumerate(durations_ms):
        own = hot.select(hot.sample == sample)
        assert len(taxels_of(own)) == (2 if duration_ms else len(taxels_of(own)))
        assert not dead[sample, own.row, own.column].any()
        assert len(own.sample) <= 4 * (duration_ms / CHECK_PERIOD_MS + 1)
        assert own.time_ms.max(initial=0) <= duration_ms
    long = hot.select(hot.sample == 1)
    one = long.select((long.row == long.row[0]) & (long.column == long.column[0]))
    for polarity in (0, 1):
        times = one.time_ms[one.polarity == polarity]
        assert len(times) == 1600 / CHECK_PERIOD_MS
        np.testing.assert_allclose(np.diff(times), CHECK_PERIOD_MS)
    left = faults.apply(one_event_a_taxel(3))
    assert len(left.sample) == 3 * (20 - 3) + len(hot.sample)


def test_a_sensor_with_one_polarity_has_no_hot_off_events():
    hot = place_faults(
        FaultCounts(1, 0), np.random.default_rng(0), [800.0], PLACES, SIZE, n_polarities=1
    )
    assert set(hot.draw_hot_events().polarity) == {0}


def test_more_faults_than_taxels_are_refused():
    with pytest.raises(ValueError, match="21 faulty taxels"):
        place_faults(FaultCounts(1, 20), np.random.default_rng(0), [800.0], PLACES, SIZE)


def test_faults_of_training_samples():
    n, duration_ms = 2000, 1000.0
    durations_ms = np.full(n, duration_ms)
    faults = draw_faults(0.5, 0.5, np.random.default_rng(0), durations_ms, SIZE)
    hot = faults.hot
    assert len(set(hot.sample)) == pytest.approx(n / 2, rel=0.1)
    assert HOT_PERIOD_MS[0] <= hot.period_ms.min() < hot.period_ms.max() <= HOT_PERIOD_MS[1]
    assert hot.end_ms.max() == duration_ms
    assert (hot.end_ms < duration_ms).any()
    assert {*map(tuple, np.stack([hot.row, hot.column], 1).tolist())} == {
        *map(tuple, PLACES.tolist())
    }
    in_sample = np.bincount(hot.sample, minlength=n)
    assert in_sample.max() <= 2 * MAX_HOT_TAXELS
    events = faults.draw_hot_events()
    assert events.time_ms.min() >= 0
    assert events.time_ms.max() <= duration_ms
    # Dead taxels, from the beginning or from later on.
    dead = ~faults.live
    assert dead.mean() == pytest.approx(0.5 * MAX_DEAD_SHARE / 2, rel=0.2)
    at_first = len(faults.apply(one_event_a_taxel(n)).sample)
    at_last = len(faults.apply(one_event_a_taxel(n, duration_ms)).sample)
    assert at_last < at_first < n * len(PLACES) + len(events.sample)


def test_no_faults():
    faults = draw_faults(0.0, 0.0, np.random.default_rng(0), [100.0, 0.0], SIZE)
    before = one_event_a_taxel(2)
    after = faults.apply(before)
    assert [values.tolist() for values in after] == [values.tolist() for values in before]


def test_recordings_with_faults():
    one = Events([10_000_000, 500_000_000], [44, 55], [1, -1], [4, 2])
    recordings = join_recordings(
        [one, Events([], [], [], [])], [3, 5], ["3/0", "5/0"], [4, 4], Source("made up", "", True)
    )
    same = add_faults(recordings, FaultCounts(0, 0), 0)
    assert same[0].time_ns.tolist() == one.time_ns.tolist()
    assert same[0].columns.tolist() == [4, 2]
    hot = add_faults(recordings, FaultCounts(1, 0), 0)
    assert hot.offsets[1] > 10
    assert (np.diff(hot[0].time_ns) >= 0).all()
    assert hot[0].time_ns[0] == one.time_ns[0]
    assert set(hot[0].polarity.tolist()) == {-1, 1}
    assert len(set(hot[0].taxel.tolist())) == 3
    assert len(add_faults(recordings, FaultCounts(0, 100), 0).events.time_ns) == 0
