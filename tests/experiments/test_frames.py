from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.slayer import bin_events
from pipeline.recordings.events import Events, expand_bursts
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import TaxelMap

SOURCE = Source("made by hand", "0" * 64, simulated=True)


def recordings(*samples, taxels=None):
    parts = [Events(*np.array(rows).reshape(-1, 4).T) for rows in samples]
    n = len(parts)
    return join_recordings(parts, [0] * n, [str(i) for i in range(n)], [-1] * n, SOURCE, taxels)


def test_events_by_hand():
    frames = bin_events(
        recordings(
            [[0, 0, 1, 1], [9_999_999, 37, -1, 2], [10_000_000, 37, 1, 4]],
            [[1_999_999_999, 99, -1, 1]],
        )
    )
    assert frames.shape == (200, 2, 10, 10, 2)
    assert frames.dtype == np.uint8
    assert [tuple(map(int, at)) for at in np.argwhere(frames)] == [
        (0, 0, 0, 0, 0),
        (0, 0, 7, 3, 1),  # taxel 37: row 37 % 10, column 37 // 10
        (1, 0, 7, 3, 0),
        (199, 1, 9, 9, 1),
    ]


def test_a_sensor_with_on_events_only_has_an_empty_channel_for_the_others():
    both = recordings([[0, 37, 1, 1]])
    frames = bin_events(replace(both, sensor=replace(both.sensor, polarities=1)))
    np.testing.assert_array_equal(frames, bin_events(both))
    assert frames[..., 1].sum() == 0


def test_the_lookup_table_decides_where_a_taxel_is():
    transposed = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    frames = bin_events(recordings([[0, 37, 1, 1]], taxels=transposed))
    assert frames[0, 0, 3, 7, 0] == 1


def test_events_outside_the_two_seconds_are_left_out():
    late = recordings([[2_000_000_000, 5, 1, 1], [3 * 10**9, 5, 1, 1]])
    assert not bin_events(late).any()


@pytest.mark.parametrize("bins", [1, 20, 200])
@given(
    rows=st.lists(
        st.tuples(
            st.integers(0, 2 * 10**9 - 100),
            st.integers(0, 99),
            st.sampled_from([1, -1]),
            st.integers(1, 5),
        ),
        max_size=30,
    )
)
def test_merged_and_repeated_columns_give_the_same_frames(bins, rows):
    rows = sorted(rows)
    # Away from an edge of a bin, which a burst may straddle.
    rows = [r for r in rows if r[0] % (2 * 10**9 // bins) < 2 * 10**9 // bins - 100]
    events = Events(*np.array(rows).reshape(-1, 4).T)
    columns = np.array(expand_bursts(events) + (np.ones(events.columns.sum()),)).T
    merged, repeated = (bin_events(recordings(r), bins) for r in (rows, columns))
    np.testing.assert_array_equal(merged, repeated)
    expected = {(t * bins // (2 * 10**9), taxel, p) for t, taxel, p, _ in rows}
    assert merged.sum() == len(expected)
