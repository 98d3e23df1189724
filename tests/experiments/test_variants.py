"""What is left of the events in each variant."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.variants import VARIANTS, measure_durations_ns, vary_recordings
from pipeline.recordings.spike_frames import EventTable
from tests.pipeline.handmade import assert_same, recordings

FIRST = [(100, 5, 1, 4), (200, 17, -1, 2), (300, 5, 1, 1), (1000, 5, -1, 5), (1100, 5, 1, 1)]
ALONE = [(700, 3, -1, 1)]


@pytest.fixture
def three():
    """Recordings of five events, of none, and of one."""
    return recordings(FIRST, [], ALONE)


def rows(made, index):
    events = made[index]
    return list(zip(events.time_ns.tolist(), events.taxel.tolist(), events.polarity, strict=True))


def drawn(seed=0, samples=20, most=60):
    rng = np.random.default_rng(seed)
    parts = []
    for n in rng.integers(0, most, samples):
        time = np.sort(rng.integers(0, 10**9, n))
        parts.append(
            np.stack([time, rng.integers(0, 100, n), rng.choice([-1, 1], n), np.ones(n, int)], 1)
        )
    return recordings(*parts)


def test_without_polarity_all_is_on(three):
    made = vary_recordings(three, "no-polarity", 0, 0)
    assert rows(made, 0) == [(t, taxel, 1) for t, taxel, *_ in FIRST]
    assert rows(made, 2) == [(700, 3, 1)]


def test_an_even_speed_keeps_order_and_ends(three):
    made = vary_recordings(three, "even", 0, 0)
    assert rows(made, 0) == [(100, 5, 1), (350, 17, -1), (600, 5, 1), (850, 5, -1), (1100, 5, 1)]
    assert rows(made, 2) == rows(three, 2)


def test_counts_are_spread_over_the_same_time(three):
    made = vary_recordings(three, "counts", 0, 600)
    # Three ON events of taxel 5 at 1/6, 3/6, 5/6; all that is alone stands in the middle.
    assert rows(made, 0) == [(100, 5, 1), (300, 5, 1), (300, 5, -1), (300, 17, -1), (500, 5, 1)]
    assert rows(made, 2) == [(300, 3, -1)]


def test_counts_do_not_know_when_anything_was():
    made = drawn()
    other = vary_recordings(made, "shuffled", 3, 0)
    assert_same(vary_recordings(made, "counts", 0, 1e9), vary_recordings(other, "counts", 0, 1e9))


def test_shuffling_keeps_times_and_events_and_parts_them():
    made = drawn()
    shuffled = vary_recordings(made, "shuffled", 0, 0)
    np.testing.assert_array_equal(shuffled.events.time_ns, made.events.time_ns)
    assert (shuffled.events.taxel != made.events.taxel).mean() > 0.5
    assert_same(shuffled, vary_recordings(made, "shuffled", 0, 0))
    again = vary_recordings(made, "shuffled", 1, 0)
    assert (shuffled.events.taxel != again.events.taxel).any()


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_recording_keeps_its_events_in_order_of_time(variant):
    made = drawn()
    varied = vary_recordings(made, variant, 0, 5e8)
    assert_same(replace(varied, events=made.events), made)
    assert EventTable.from_recordings(varied).offsets[-1] == len(made.events)
    for index in range(len(made)):
        before, after = made[index], varied[index]
        assert (np.diff(after.time_ns) >= 0).all()
        if variant != "no-polarity":
            columns = [np.stack([e.taxel, e.polarity, e.columns], 1) for e in (before, after)]
            assert sorted(columns[0].tolist()) == sorted(columns[1].tolist())
    if variant in ("even", "shuffled", "no-polarity"):
        np.testing.assert_array_equal(measure_durations_ns(varied), measure_durations_ns(made))


def test_as_it_is_nothing_changes(three):
    assert_same(vary_recordings(three, "as-is", 0, 0), three)


def test_durations(three):
    assert measure_durations_ns(three).tolist() == [1000, 0, 0]
