"""``stmnist.Stream``: decisions as a check's, and every fault of a sensor is counted."""

import functools
import logging
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.check.bundle import Bundle, CheckSet
from deploy.conformance import networks
from deploy.errors import UserError
from deploy.network.decision import Estimator
from deploy.network.stimulus import EventFrames
from deploy.stream import faults
from deploy.stream.presentation import SharedNetwork
from deploy.stream.stream import Stream
from deploy.targets.emulation import Emulation
from deploy.targets.registry import run_target
from tests.deploy.networks import draw_checks

STEP_US = 10_000


def make_bundle(count=12, **presentation):
    """A bundle of random weights whose check has samples of 20 steps of 10 ms."""
    spec = replace(
        networks.make_event_network(**presentation), stimulus=EventFrames(0.01, refractory=2)
    )
    estimator = _estimator(3) if presentation.get("threshold") else None
    readout = replace(spec.layers[-1], bias=np.zeros(3))
    spec = replace(spec, estimator=estimator, layers=(*spec.layers[:-1], readout))
    frames = networks.draw_frames(spec, count, share=0.1)
    for sample in frames:
        sample[0, 0, 0, 0] = 1  # a recording begins with an event
        ready = np.zeros(sample.shape[1:], int)
        for step, frame in enumerate(sample):
            frame *= ready <= step
            ready[frame != 0] = step + 3
    names = tuple(f"random/{i}" for i in range(count))
    return Bundle(None, "random", spec, CheckSet(frames, np.zeros(count, int), names, 0))


def _estimator(classes):
    rng = np.random.default_rng(3)
    shapes = Estimator.list_shapes(classes)
    return Estimator.from_arrays({n: rng.normal(size=s) for n, s in shapes.items()}, classes)


def events_of(frames, start_us):
    """Columns t (in microseconds), x, y, p of the events of a sample."""
    step, row, column, polarity = np.nonzero(frames)
    time = start_us + STEP_US * step + np.where(step > 0, STEP_US // 3, 0)
    return time, column, row, polarity == 0


@pytest.fixture(scope="module")
def bundle():
    return make_bundle()


@pytest.fixture(scope="module")
def network(bundle):
    return SharedNetwork(Emulation(bundle.spec, bundle.seed))


@pytest.fixture
def stream(bundle, network):
    return Stream(bundle, unit="us", network=network)


def replay(stream, frames, one_by_one=False, pause_us=700_000, start_us=5_000_000):
    """All decisions on samples that are pushed one after the other."""
    decisions = []
    for sample in frames:
        columns = events_of(sample, start_us)
        if one_by_one:
            for event in zip(*(column.tolist() for column in columns), strict=True):
                decisions += stream.push(*event)
        else:
            decisions += stream.push(*columns)
        start_us += len(sample) * STEP_US + pause_us
    return decisions + stream.finish()


@pytest.mark.parametrize("one_by_one", [False, True])
@pytest.mark.parametrize("threshold", [None, 0.5, 0.93])
def test_decisions_are_those_of_a_check_with_the_target_fast(threshold, one_by_one):
    """Samples follow each other without a reset, in streams of three, as in ``check run``."""
    bundle = make_bundle(threshold=threshold, readout_start=3)
    expected = run_target(bundle.spec, bundle.checks.inputs, "fast", bundle.seed)
    decisions = replay(Stream(bundle, unit="us"), bundle.checks.inputs, one_by_one)
    assert len(decisions) == len(bundle.checks)
    n_early = 0
    for index, decision in enumerate(decisions):
        if not decision.early:
            assert decision.number == expected.predictions[index]
            continue
        n_early += 1
        stopped = expected.stopped_at[index]
        assert decision.number == expected.decisions[index, stopped - 1]
        due = decision.start + stopped * STEP_US
        assert decision.time == min(due, decision.time)
    if threshold is None:
        assert n_early == 0
        assert len({decision.number for decision in decisions}) > 1
    else:
        stops = [s for s, d in zip(expected.stopped_at, decisions, strict=True) if not d.early]
        assert set(stops) <= {bundle.spec.presentation.steps}
        assert n_early > 0


def test_the_maximum_number_of_spikes_is_that_of_a_check():
    bundle = make_bundle()
    spec = bundle.spec
    limited = replace(spec, stimulus=replace(spec.stimulus, max_spikes=1))
    expected = run_target(limited, bundle.checks.inputs, "fast", bundle.seed)
    unlimited = run_target(spec, bundle.checks.inputs, "fast", bundle.seed)
    assert expected.spikes["input"].sum() < unlimited.spikes["input"].sum()
    stream = Stream(replace(bundle, spec=limited), unit="us")
    decisions = replay(stream, bundle.checks.inputs)
    assert [decision.number for decision in decisions] == expected.predictions.tolist()


def test_a_touch_begins_with_an_event_and_ends_with_silence(stream):
    assert not stream.touching
    assert stream.push(1_000_000, 2, 3, 1) == []
    assert stream.push(1_030_000, 2, 4, 0) == []
    assert stream.touching
    silence_us = round(1e6 * stream.silence)
    # The presentation of 0.2 s ends first, if the sensor is not silent for long.
    before = min(silence_us, 170_000)
    assert stream.advance(1_030_000 + before - 1000) == []
    (decision,) = stream.advance(1_030_000 + before + 1000)
    assert (decision.start, decision.events) == (1_000_000, 2)
    assert decision.time == 1_030_000 + before
    assert stream.advance(9_000_000) == []
    assert not stream.touching


def test_a_decision_is_preliminary_until_the_touch_has_ended():
    """An early one, and one at the end of a presentation that the touch goes on after."""
    bundle = make_bundle(threshold=0.5)
    stream = Stream(bundle, unit="us")
    silence_us = round(1e6 * stream.silence)
    decisions = replay(stream, bundle.checks.inputs)
    assert any(decision.early and not decision.ended for decision in decisions)
    ended = [decision for decision in decisions if decision.ended]
    assert all(decision.time - decision.start >= silence_us for decision in ended)
    patient = Stream(make_bundle(), unit="us", silence=0.05)
    patient.push(1_000_000, 2, 3, 1)
    (ended,) = patient.advance(1_060_000)
    for step in range(25):
        going_on = patient.push(2_000_000 + STEP_US * step, 2, 3, 1)
        if going_on:
            break
    assert ended.ended
    assert not going_on[0].ended


def test_a_touch_longer_than_the_training_has_no_probability(bundle, network):
    """Probabilities are estimated on samples of the training: they are too high for slower ones."""
    shortest = {}
    for steps in (19, 30):
        stream = Stream(bundle, "us", longest=1, stream_length=1, network=network)
        time = STEP_US * np.arange(steps)
        stream.push(time, np.arange(steps) % 4, np.arange(steps) % 6, np.arange(steps) % 2)
        (decision,) = stream.finish()
        assert stream.exceeds_training == (steps > 20)
        shortest[steps] = decision.probability
    assert shortest[19] > 0
    assert shortest[30] is None


def test_silence_ends_a_touch_before_its_presentation_with_the_same_decision(bundle, network):
    patient = replay(Stream(bundle, "us", network=network), bundle.checks.inputs)
    hasty = Stream(bundle, "us", silence=0.05, network=network)
    some = bundle.checks.inputs[:1]
    last = int(np.flatnonzero(some[0].any(axis=(1, 2, 3)))[-1])
    columns = events_of(some[0], 0)
    decisions = hasty.push(*columns) + hasty.advance(int(columns[0][-1]) + 60_000)
    assert last < 14
    assert decisions[0].number == patient[0].number
    assert decisions[0].time == columns[0][-1] + 50_000


def test_a_longer_touch_is_presented_as_long_as_wanted(bundle, network):
    time = np.arange(0, 400_000, 7_000)
    place = np.arange(len(time)) % 6
    cut = Stream(bundle, "us", network=network)
    (decision,) = cut.push(time, place, place, place > 2)
    assert decision.time == 200_000
    assert cut.faults == {"surplus": int(np.sum(time >= 200_000))}
    whole = Stream(bundle, "us", longest=0.6, network=network)
    assert whole.push(time, place, place, place > 2) == []
    (decision,) = whole.finish()
    assert decision.events == len(time)
    assert whole.faults == {}


def test_probability_is_none_if_nothing_reached_the_readout(stream):
    stream.push(0, 0, 0, True)
    (decision,) = stream.finish()
    assert (decision.probability, decision.early) == (None, False)
    assert decision.to_dict()["label"] == decision.label


def test_times_in_another_unit_are_doubted(bundle, network, caplog):
    """Microseconds that are read as seconds make a touch of each event."""
    stream = Stream(bundle, unit="s", network=network)
    for time in range(0, 10 * STEP_US, STEP_US):
        stream.push(time, 0, 0, 1)
    stream.finish()
    assert [record.getMessage() for record in caplog.records if "unit" in record.getMessage()]
    caplog.clear()
    stream = Stream(bundle, unit="us", network=network)
    replay(stream, bundle.checks.inputs[:6])
    assert not caplog.records


def test_faulty_events_are_counted_and_change_nothing(bundle, network):
    clean = replay(Stream(bundle, "us", network=network), bundle.checks.inputs)
    stream, decisions = Stream(bundle, "us", network=network), []
    start = 5_000_000
    for sample in bundle.checks.inputs:
        for t, x, y, p in zip(*events_of(sample, start), strict=True):
            decisions += stream.push(t, x, y, p)
            for wrong in ((t, 6, y, p), (t, x, -1, p), (t, x, y, 2), (math.nan, x, y, p)):
                decisions += stream.push(*wrong)
            decisions += stream.push("soon", x, y, p)
            decisions += stream.push([t], [None], [y], [p])
        start += 900_000
    decisions += stream.finish()
    assert decisions == clean
    n = stream.n_events
    assert stream.faults == {"outside": 2 * n, "polarity": n, "unreadable": 3 * n}


def test_an_off_event_is_another_polarity_where_training_had_none(bundle):
    spec = replace(bundle.spec, provenance={"polarities": 1})
    stream = Stream(replace(bundle, spec=spec))
    stream.push([0.0, 0.01], [1, 1], [1, 1], [1, 0])
    assert (stream.n_events, stream.faults) == (1, {"polarity": 1})


def test_events_out_of_order_are_presented_in_their_step_or_the_present_one(bundle, network):
    expected = replay(Stream(bundle, "us", network=network), bundle.checks.inputs)
    stream, decisions = Stream(bundle, "us", network=network), []
    start = 5_000_000
    for sample in bundle.checks.inputs:
        t, x, y, p = events_of(sample, start)
        order = np.arange(len(t))
        order[1:] = order[1:][::-1]  # all but the first arrive in reverse, together
        decisions += stream.push(t[order], x[order], y[order], p[order])
        start += 900_000
    decisions += stream.finish()
    assert [d.number for d in decisions] == [d.number for d in expected]
    assert stream.faults["late"] > 0
    late = Stream(bundle, "us", silence=0.2, network=network)
    late.push(0, 1, 1, 1)
    late.push(55_000, 2, 1, 1)
    late.push(12_000, 3, 1, 1)  # its step has been computed
    (decision,) = late.finish()
    assert (decision.events, late.faults) == (3, {"late": 1})


def test_events_that_arrive_after_the_clock_are_no_fault(stream):
    stream.push(0, 1, 1, 1)
    for time in range(5_000, 100_000, 5_000):
        stream.advance(time)
        stream.push(time - 2_000, 2, 1, 1)
    (decision,) = stream.finish()
    assert (decision.events, stream.faults) == (20, {})


def test_one_event_from_the_future_does_not_end_a_touch(stream):
    stream.push(0, 1, 1, 1)
    assert stream.push(86_400_000_000, 2, 1, 1) == []
    assert stream.push(1_000, 3, 1, 1) == []
    (decision,) = stream.finish()
    assert (decision.events, decision.start) == (3, 0)
    assert stream.faults == {"future": 1}


def test_the_clock_tells_that_an_event_is_from_the_future_or_after_silence(bundle, network):
    for clock, n_decisions, counted in ((30_000, 0, {"future": 1}), (5_000_000, 1, {})):
        stream = Stream(bundle, "us", network=network)
        stream.push(0, 1, 1, 1)
        stream.push(5_000_000, 2, 1, 1)
        assert len(stream.advance(clock)) == n_decisions
        assert stream.faults == counted
        assert stream.touching


def test_a_clock_that_jumps_back_goes_on_from_there(stream):
    stream.push(50_000_000, 1, 1, 1)
    stream.push(50_010_000, 2, 1, 1)
    stream.push(3_000_000, 3, 1, 1)
    stream.push(3_010_000, 4, 1, 1)
    (decision,) = stream.advance(9_000_000)
    assert decision.events == 4
    assert stream.faults == {"jump": 1}
    stream.advance(1_000_000)  # the clock itself
    assert stream.faults == {"jump": 2}
    stream.push(1_000_500, 1, 1, 1)
    stream.push(1_000_600, 1, 1, 1)
    assert len(stream.finish()) == 1
    assert stream.faults == {"jump": 2}


@pytest.fixture
def reports_of_five_seconds(stream, monkeypatch, caplog):
    """The reports of a fault ten times a second, and of another one at the end."""
    now = [100.0]
    monkeypatch.setattr(faults.time, "monotonic", lambda: now[0])
    with caplog.at_level(logging.WARNING, "stmnist.stream"):
        for _ in range(50):
            stream.push(0, -1, 0, 1)
            now[0] += 0.1
        stream.push(0, 0, 0, 7)
        stream.finish()
    return [record.getMessage() for record in caplog.records]


def test_faults_are_reported_once_a_second_at_most(reports_of_five_seconds):
    assert len(reports_of_five_seconds) <= 7


def test_all_faults_are_reported(stream, reports_of_five_seconds):
    numbers = [int(report.split(": ")[2].split()[0]) for report in reports_of_five_seconds]
    assert sum(numbers) == stream.faults["outside"] == 50
    assert "polarity" in reports_of_five_seconds[-1]


@given(
    st.lists(
        st.tuples(
            st.one_of(
                st.floats(allow_nan=True, width=64),
                st.integers(-(2**70), 2**70),
                st.floats(0, 3),
                st.none(),
                st.text(max_size=2),
            ),
            st.one_of(st.integers(-2, 8), st.floats(), st.none()),
            st.integers(-2, 8),
            st.sampled_from([0, 1, -1, True, False, 2, math.nan]),
        ),
        max_size=30,
    ),
    st.booleans(),
)
@settings(deadline=None, max_examples=60)
def test_whatever_is_pushed_nothing_is_raised_or_lost(events, together):
    stream = shared_stream()
    before = accounted(stream)
    if together:
        columns = list(zip(*events, strict=True)) or [[]] * 4
        stream.push(*map(list, columns))
    for event in () if together else events:
        stream.push(*event)
        if isinstance(event[0], float) and abs(event[0]) < 1e6:
            stream.advance(event[0])
    stream.finish()
    assert accounted(stream) - before == len(events)


def accounted(stream):
    """Events that were presented, or counted and not presented."""
    return stream.n_events + sum(stream.faults.get(n, 0) for n in NOT_PRESENTED)


NOT_PRESENTED = ("outside", "polarity", "unreadable")


@functools.cache
def shared_stream():
    return Stream(make_bundle())


def test_columns_of_different_lengths_are_refused_in_one_line(stream):
    with pytest.raises(UserError, match="equal lengths"):
        stream.push([0, 1], [0], [0, 1], [1, 1])


def test_a_bundle_on_images_is_told_what_a_stream_needs():
    spec = networks.make_image_network()
    bundle = Bundle("there/bundle", "random", spec, draw_checks(spec, 3))
    with pytest.raises(UserError, match=r"there/bundle: .*on images.*needs one on events"):
        Stream(bundle)


def test_a_folder_that_is_no_bundle_is_refused(tmp_path):
    with pytest.raises(UserError, match="not a bundle"):
        Stream(tmp_path)
    with pytest.raises(UserError, match="not a bundle"):
        Stream(SimpleNamespace(path=tmp_path))  # as a run has


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("unit", "h"),
        ("silence", 0),
        ("longest", -1),
        ("longest", math.nan),
        ("longest", math.inf),
        ("stream_length", 0),
        ("stream_length", 1.5),
    ],
)
def test_wrong_values_are_refused(bundle, name, value):
    with pytest.raises(UserError, match=name):
        Stream(bundle, **{name: value})


def test_a_touch_may_end_by_its_length_only(bundle):
    assert Stream(bundle, silence=math.inf).silence == math.inf


def test_the_present_time_goes_on_from_the_last_event(bundle, network, monkeypatch):
    """By the clock of this machine, on which an event arrives when it is pushed."""
    machine_s = 50.0
    monkeypatch.setattr("time.monotonic", lambda: machine_s)
    stream = Stream(bundle, "us", network=network)
    assert stream.now is None
    assert stream.advance() == []
    stream.push(1_000_000, 2, 3, 1)
    machine_s += 0.005
    assert stream.now == pytest.approx(1_005_000)
    stream.push(1_004_000, 2, 4, 1)  # within the same step
    assert stream.now == pytest.approx(1_004_000)
    stream.push(float("nan"), 2, 4, 1)
    machine_s += 0.02
    assert stream.now == pytest.approx(1_024_000)
    assert stream.advance() == []
    machine_s += stream.silence
    (decision,) = stream.advance()
    assert decision.events == 2
    assert not stream.touching


def test_a_number_that_no_sensor_has_is_counted(stream):
    assert stream.push([0, 10**400, 1], [1, 1, 10**400], [1, 1, 1], [1, 1, 1]) == []
    assert stream.faults == {"unreadable": 2}
