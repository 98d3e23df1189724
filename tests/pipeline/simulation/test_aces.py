"""ACES: what goes onto the wire comes off it again."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.recordings.events import TICK_NS, Events, expand_bursts, merge_bursts
from pipeline.simulation import aces, parameters
from pipeline.simulation.simulate import simulate_recordings
from tests.pipeline.simulation import wire as wire_of

P = SimpleNamespace(**vars(parameters.read_parameters().aces), **wire_of.WIRE)
SIGNATURE_NS = P.signature_s * 1e9

sent = st.lists(
    st.tuples(st.floats(0, 3e6, allow_nan=False), st.integers(0, 99), st.sampled_from([-1, 1])),
    unique_by=lambda event: event[1],  # a taxel is blind while its signature goes out
    min_size=1,
    max_size=40,
)


def columns(events):
    return {name: getattr(events, name).tolist() for name in vars(events)}


def test_signatures_meet_in_few_pulses():
    codes = wire_of.signatures(P.pulses, P.signature_s, P.most_shared)
    assert codes.shape == (100, P.pulses)
    assert (codes[:, 0] == 0).all()
    assert codes.max() * TICK_NS < SIGNATURE_NS
    # By brute force for some pairs: slide one along the other and count the pulses that meet.
    for one, other in [(0, 1), (17, 42), (98, 99)]:
        offsets = np.subtract.outer(codes[one], codes[other]).ravel()
        meet = np.abs(offsets[:, None] - offsets) <= 2
        assert meet.sum(axis=1).max() <= 2 * P.most_shared


def test_burst_lengths_are_those_of_the_real_recording():
    time_ns = np.random.default_rng(0).uniform(0, 1e12, 40_000)
    polarity = np.repeat([1, -1], 20_000)
    events = aces.make_bursts(time_ns, np.zeros(40_000, int), polarity, P)
    rises, falls = (events.columns[events.polarity == sign] for sign in (1, -1))
    assert set(falls) == {4, 5}
    assert set(rises) == {2, 3}
    assert np.mean(falls == 5) == pytest.approx(165 / 359, abs=0.02)
    assert np.mean(rises == 3) == pytest.approx(133 / 306, abs=0.02)


def test_encode_by_hand():
    # 100 ns is in tick 7 (112 ns); a pulse of 71.4 ns is still high at ticks 8 to 10 (160 ns).
    wire = wire_of.encode([100.0], [5], [-1], P, 0, 70_000)
    delays = wire_of.signatures(P.pulses, P.signature_s, P.most_shared)[5]
    expected = np.zeros(70_000)
    for delay in delays:
        expected[7 + delay : 11 + delay] = 1
    np.testing.assert_array_equal(wire, expected)


@given(sent)
@settings(max_examples=25, deadline=None)
def test_decode_of_encode_is_the_short_way(events):
    time_ns, taxel, polarity = (np.array(column) for column in zip(*events, strict=True))
    wire = wire_of.encode(time_ns, taxel, polarity, P, 0, round(4.2e6 / TICK_NS))
    assert columns(wire_of.decode(wire, P, 0)) == columns(
        aces.make_bursts(time_ns, taxel, polarity, P)
    )


@given(sent)
@settings(max_examples=60, deadline=None)
def test_no_two_bursts_share_a_tick(events):
    time_ns, taxel, polarity = (np.array(column) for column in zip(*events, strict=True))
    # Squeezed together until they collide.
    reported = aces.make_bursts(time_ns / 1e4, taxel, polarity, P)
    ticks = expand_bursts(reported)
    assert (np.diff(ticks[0]) > 0).all()
    assert columns(merge_bursts(*ticks)) == columns(reported)


def test_the_short_way_stands_for_the_wire_on_a_simulated_recording():
    # 60 ms of a written digit, with the wire's usual noise: nothing lost, nothing added.
    events = simulate_recordings(3, [0] * 8 + [1, 0], jobs=1)[0]
    start = int(events.time_ns[len(events) // 2]) // TICK_NS * TICK_NS
    inside = (events.time_ns >= start) & (events.time_ns < start + 60e6)
    part = Events(*(getattr(events, name)[inside] for name in vars(events)))
    assert len(part) > 30
    wire = wire_of.encode(
        part.time_ns.astype(float), part.taxel, part.polarity, P, start, round(61.2e6 / TICK_NS)
    )
    wire += P.noise * np.random.default_rng(0).standard_normal(len(wire), np.float32)
    decoded = wire_of.decode(wire, P, start)
    again = aces.make_bursts(part.time_ns.astype(float), part.taxel, part.polarity, P)
    assert columns(decoded) == columns(again)
