"""Fast-adapting taxels: they answer to change, and to nothing else."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.simulation.contact import Receptors

STEP, REFRACTORY, POLL = 1e-3, 3.27e-3, 88e-6

# Multiples of 1/64 add and subtract without rounding, so that equal means equal.
levels = st.integers(-256, 256).map(lambda n: n / 64)
signals = arrays(float, st.tuples(st.integers(2, 60), st.integers(1, 4)), elements=levels)


def events_of(signal, on=0.5, off=0.5):
    n = signal.shape[1]
    thresholds = np.full(n, on), np.full(n, off)
    receptors = Receptors(signal[0], *thresholds, STEP, REFRACTORY, POLL)
    time, channel, polarity = receptors.advance(signal[1:])
    order = np.lexsort((time, channel))
    return time[order], channel[order], polarity[order]


def test_rise_and_fall_by_hand():
    # A step up of 1 between 2 ms and 3 ms crosses +0.5 half way; a step down between 10 and 11 ms.
    signal = np.zeros((15, 1))
    signal[3:11] = 1.0
    time, channel, polarity = events_of(signal)
    assert polarity.tolist() == [1, -1]
    assert channel.tolist() == [0, 0]
    # First look of the taxel's clock (every 88 us from its start) at or after 2.5 ms.
    assert np.isclose(time[0], 29 * POLL)
    # Its clock goes on from the end of the blind time.
    ready = time[0] + REFRACTORY
    assert np.isclose(time[1], ready + np.ceil((10.5e-3 - ready) / POLL) * POLL)


def test_a_change_while_blind_is_reported_when_it_can_be():
    signal = np.zeros((12, 1))
    signal[1] = 1.0  # up, and at once down again
    time, _, polarity = events_of(signal)
    assert polarity.tolist() == [1, -1]
    assert np.isclose(time[1] - time[0], REFRACTORY)


def test_thresholds_of_on_and_off_are_separate():
    ramp = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, 0, 50)])[:, None]
    _, _, polarity = events_of(ramp, on=0.4, off=0.1)
    assert (polarity == 1).sum() == 2
    assert (polarity == -1).sum() >= 5


@given(signals)
@settings(max_examples=60, deadline=None)
def test_never_twice_within_the_refractory_time(signal):
    time, channel, _ = events_of(signal)
    gaps = np.diff(time)[np.diff(channel) == 0]
    assert (gaps >= REFRACTORY * (1 - 1e-12)).all()


@given(levels, st.integers(2, 50))
def test_constant_pressure_gives_no_events(level, n_times):
    assert len(events_of(np.full((n_times, 3), level))[0]) == 0


@given(signals, levels)
@settings(max_examples=60, deadline=None)
def test_a_constant_offset_changes_nothing(signal, offset):
    for one, other in zip(events_of(signal), events_of(signal + offset), strict=True):
        np.testing.assert_array_equal(one, other)


@given(signals)
@settings(max_examples=60, deadline=None)
def test_turned_over_on_becomes_off(signal):
    time, channel, polarity = events_of(signal)
    other = events_of(-signal)
    np.testing.assert_array_equal(time, other[0])
    np.testing.assert_array_equal(channel, other[1])
    np.testing.assert_array_equal(polarity, -other[2])


@given(signals)
@settings(max_examples=40, deadline=None)
def test_channels_do_not_know_of_each_other(signal):
    time, channel, polarity = events_of(signal)
    for k in range(signal.shape[1]):
        alone = events_of(signal[:, [k]])
        np.testing.assert_array_equal(time[channel == k], alone[0])
        np.testing.assert_array_equal(polarity[channel == k], alone[2])


@given(signals, st.lists(st.integers(1, 59), min_size=4, max_size=4))
def test_channels_that_end_early_fire_as_by_themselves(signal, ends):
    n = signal.shape[1]
    ends = sorted(np.minimum(ends[:n], len(signal)), reverse=True)  # row after each one's last
    thresholds = np.full(n, 0.5), np.full(n, 0.5)
    receptors, found, row = Receptors(signal[0], *thresholds, STEP, REFRACTORY, POLL), [], 1
    for end, width in zip(ends[::-1], range(n, 0, -1), strict=True):
        found.append(receptors.advance(signal[row:end, :width]))
        row = max(row, end)
    time, channel, polarity = map(np.concatenate, zip(*found, strict=True))
    for column, end in enumerate(ends):
        alone = events_of(signal[:end, [column]])
        mine = channel == column
        np.testing.assert_array_equal(time[mine], alone[0])
        np.testing.assert_array_equal(polarity[mine], alone[2])
