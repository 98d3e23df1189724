import numpy as np
import pytest

from pipeline.recordings.columns import EventColumns
from pipeline.recordings.spike_frames import EventTable, SpikeLimits, make_spike_frames
from tests.pipeline.handmade import recordings

MS = 1_000_000
# Taxel 12 is row 2, column 1; 99 is row 9, column 9.
ROWS = [(5 * MS, 12, 1, 4), (14 * MS, 12, 1, 4), (16 * MS, 12, -1, 2), (47 * MS, 99, 1, 1)]


@pytest.fixture
def table():
    return EventTable.from_recordings(recordings([(1 * MS, 0, -1, 2)], ROWS))


def test_times_count_from_the_first_event(table):
    assert len(table) == 2
    events = table.select([0, 1])
    np.testing.assert_allclose(events.time_ms, [0, 0, 9, 11, 42])
    np.testing.assert_allclose(table.duration_ms, [0, 42])
    assert events.row.tolist() == [0, 2, 2, 2, 9]
    assert events.column.tolist() == [0, 1, 1, 1, 9]
    assert events.polarity.tolist() == [1, 0, 0, 1, 0]


def test_frames_by_hand(table):
    frames = table.make_frames([1, 0], step_ms=10, n_steps=5)
    assert frames.shape == (5, 2, 10, 10, 2)
    assert frames.dtype == np.uint8
    where = {tuple(map(int, index)) for index in np.argwhere(frames)}
    assert where == {(0, 0, 2, 1, 0), (1, 0, 2, 1, 1), (4, 0, 9, 9, 0), (0, 1, 0, 0, 1)}


def test_events_past_the_last_step_are_left_out(table):
    assert table.make_frames([1], step_ms=10, n_steps=4).sum() == 2


def test_lost_is_the_share_that_shares_a_step(table):
    # Two ON events of a taxel are in the first 10 ms.
    assert table.measure_loss(10) == pytest.approx(1 / 5)
    assert table.measure_loss(1) == 0
    # The others have another polarity or another taxel.
    assert table.measure_loss(100) == pytest.approx(1 / 5)


def test_a_taxel_rests_after_a_spike():
    rows = [(time * MS, 12, 1, 1) for time in (1, 12, 15, 22, 45)]
    rows.insert(2, (12 * MS, 13, 1, 1))
    table = EventTable.from_recordings(recordings([(1 * MS, 3, 1, 1)], rows))
    frames = table.make_frames([1], step_ms=10, n_steps=5, limits=SpikeLimits(1))[:, 0, :, :, 0]
    # Steps 0, 1, 1, 2, 4 of taxel 12: that of 1 is too soon, which makes 2 late enough.
    assert np.flatnonzero(frames[:, 2, 1]).tolist() == [0, 2, 4]
    assert np.flatnonzero(frames[:, 3, 1]).tolist() == [1]
    assert table.measure_loss(10, refractory_steps=1) == pytest.approx(2 / 7)
    assert table.measure_loss(10) == pytest.approx(1 / 7)
    long = table.make_frames([1], step_ms=10, n_steps=5, limits=SpikeLimits(100))[:, 0, :, :, 0]
    assert np.flatnonzero(long[:, 2, 1]).tolist() == [0]


def test_frames_take_steps_down_and_leave_out_what_is_before_and_after():
    one = np.zeros(4, int)
    events = EventColumns(one, np.array([-0.1, 0.9, 1.0, 2.0]), one, one, one)
    frames = make_spike_frames(events, step_ms=1.0, n_samples=1, n_steps=2)
    assert frames[:, 0, 0, 0, 0].tolist() == [1, 1]
