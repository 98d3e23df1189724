import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.recordings.events import Events, expand_bursts, merge_bursts
from tests.pipeline.handmade import GOOD, recordings


def test_bursts_by_hand():
    time = [0, 16, 32, 48, 80, 96, 112, 128]
    taxel = [5, 5, 5, 6, 6, 6, 6, 6]
    sign = [1, 1, 1, 1, 1, 1, -1, -1]
    merged = merge_bursts(time, taxel, sign)
    assert merged.time_ns.tolist() == [0, 48, 80, 112]  # new taxel, a tick left out, new polarity
    assert merged.taxel.tolist() == [5, 6, 6, 6]
    assert merged.polarity.tolist() == [1, 1, 1, -1]
    assert merged.columns.tolist() == [3, 1, 2, 2]


def test_nothing_merges_to_nothing():
    assert len(merge_bursts([], [], [])) == 0


@st.composite
def tick_streams(draw):
    steps = draw(st.lists(st.sampled_from([1, 1, 1, 2, 50]), max_size=60))
    n = len(steps)
    taxel = draw(st.lists(st.integers(0, 3), min_size=n, max_size=n))
    sign = draw(st.lists(st.sampled_from([1, -1]), min_size=n, max_size=n))
    return 16 * np.cumsum(steps, dtype=np.int64), np.array(taxel, int), np.array(sign, int)


@given(tick_streams())
def test_expanding_what_was_merged_gives_the_columns_back(ticks):
    merged = merge_bursts(*ticks)
    for found, expected in zip(expand_bursts(merged), ticks, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert merged.columns.sum() == len(ticks[0])
    again = merge_bursts(*expand_bursts(merged))
    np.testing.assert_array_equal(again.columns, merged.columns)


def test_events_of_each_recording():
    both = recordings(GOOD[:3], [], GOOD[3:])
    assert [len(both[i]) for i in range(3)] == [3, 0, 1]
    assert both.sample_of_event.tolist() == [0, 0, 0, 2]
    assert both[2].taxel.tolist() == [99]


def test_columns_of_events_must_be_equally_long():
    with pytest.raises(ValueError, match="Events"):
        Events([1, 2], [3], [1], [1])
