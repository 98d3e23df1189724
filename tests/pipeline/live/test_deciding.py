"""The network's answers while writing are those of its check."""

import math
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import Bundle, read_bundle
from deploy.conformance import networks
from deploy.network.decision import compute_confidence
from deploy.network.stimulus import EventFrames
from deploy.targets.registry import run_target as answers_of
from pipeline.live.deciding import Curve, EventDecider, make_decider
from pipeline.recordings.dataset import make_inputs, make_inputs_for
from pipeline.recordings.events import Events
from pipeline.recordings.sensor import Sensor
from pipeline.recordings.spike_frames import EventTable, SpikeLimits
from pipeline.settings import Settings
from pipeline.simulation.simulate import simulate_recordings


@pytest.fixture(scope="module")
def bundle(tiny_run):
    return read_bundle(tiny_run / "bundle")


@pytest.fixture(scope="module")
def decider(bundle):
    return make_decider(bundle, Sensor())


@pytest.fixture(scope="module")
def recordings():
    return simulate_recordings(3, [2] * 10, jobs=1)


def test_a_whole_recordings_answer_is_that_of_the_target_fast(bundle, decider, recordings):
    spec = bundle.spec.with_presentation(stream_length=1)
    images = make_inputs_for(spec, recordings)
    expected = answers_of(spec, images, "fast")
    for index in range(len(recordings)):
        said = decider.begin().compute_output(recordings[index], 2.0)
        np.testing.assert_array_equal(said.scores, expected.scores[index])
        assert said.curve.find_last().label == expected.predictions[index]
        counts = {name: int(np.unpackbits(rows).sum()) for name, rows in said.spikes.items()}
        assert counts == {name: n[index] for name, n in expected.spikes.items()}


def test_it_decides_on_part_of_a_recording(decider, recordings):
    events = recordings[0]
    part = Events(*(getattr(events, n)[:40] for n in ("time_ns", "taxel", "polarity", "columns")))
    said = decider.begin().compute_output(part, 0.5)
    shares = said.curve.probabilities[-1]
    assert shares.sum() == pytest.approx(1)
    assert said.curve.find_last().confidence == pytest.approx(shares.max(), abs=1e-3)
    assert said.decided is None
    assert 0 <= said.curve.find_last().label <= 9


def test_it_decides_nothing_without_events(decider):
    assert decider.begin().compute_output(Events(*(np.empty(0),) * 4), 0.2) is None


def test_no_early_decision_after_the_time_of_the_training():
    curve = Curve(np.arange(1, 5), np.array([0.5, 0.7, 0.95, 0.99]), np.full(4, 3), np.eye(4))
    assert curve.find_first(0.9) == curve.find_first(0.9, until_s=3) == (3, 0.95, 3.0, True)
    assert curve.find_first(0.9, until_s=2.9) is None
    assert curve.find_first(None) is None


def test_layers_are_as_many_bytes_as_the_page_reads(bundle, decider, recordings):
    said = decider.begin().compute_output(recordings[0], 2.0)
    assert list(decider.layers) == list(bundle.spec.spiking_layers)
    assert decider.steps + decider.first_step == bundle.spec.presentation.steps
    for name, neurons in decider.layers.items():
        assert said.spikes[name].shape == (decider.steps, -(-neurons // 8))


@pytest.fixture(scope="module")
def events_bundle():
    """An events bundle of random weights, for whole recordings in steps of 10 ms."""
    rng = np.random.default_rng(0)
    small = networks.make_event_network()
    conv1 = networks.excite(networks.make_convolution("conv1", (10, 10, 2), 4, 4, rng), scale=8)
    spec = replace(
        small,
        input_shape=(10, 10, 2),
        stimulus=EventFrames(0.01, refractory=1),
        layers=(conv1, networks.make_readout(conv1.shape, rng, classes=10)),
        presentation=replace(small.presentation, steps=200, threshold=0.7),
    )
    return Bundle(None, "random", spec, None)


def test_a_slow_hand_is_answered_at_its_own_end(events_bundle, recordings):
    """Longer than the presentation: as the target answers with as many steps as it takes."""
    slow = replace(recordings.events, time_ns=4 * recordings.events.time_ns)
    slow = replace(recordings, events=slow)
    decider = make_decider(events_bundle, Sensor())
    spec = events_bundle.spec.with_presentation(steps=600, stream_length=1)
    frames = EventTable.from_recordings(slow).make_frames(
        np.arange(len(slow)), 10.0, 600, SpikeLimits(1)
    )
    expected = answers_of(spec, np.moveaxis(frames, 0, 1), "fast")
    longer = 0
    for index in range(0, len(slow), 3):
        first, last = slow[index].time_ns[[0, -1]] * 1e-9
        end = round((max(2.0, last - first + 0.01 * (len(spec.layers) + 2))) / 0.01)
        longer += end > 200
        is_slow = last - first >= 2
        said = decider.begin().compute_output(slow[index], math.inf)
        assert said.curve.find_last().label == expected.decisions[index, min(end, 600) - 1]
        assert said.exceeds_training == is_slow  # and its confidence means nothing
    assert longer > 3


def test_an_events_bundle_says_at_each_moment_what_its_target_says_at_that_step(
    events_bundle, recordings
):
    decider = make_decider(events_bundle, Sensor())
    assert isinstance(decider, EventDecider)
    assert decider.changes_with_time
    spec = events_bundle.spec.with_presentation(stream_length=1)
    settings = Settings().with_values({"input": {"kind": "events"}}, "test")
    frames = make_inputs(recordings, settings)
    assert frames.shape[1] == 200
    expected = answers_of(spec, frames, "fast")
    assert len(set(expected.predictions)) > 1
    for index in range(0, len(recordings), 3):
        events = recordings[index]
        first_s = events.time_ns[0] * 1e-9
        deciding = decider.begin()
        for step in (5, 40, 82, 200):
            time_s = first_s + 0.01 * step + 1e-6
            so_far = events.time_ns < time_s * 1e9
            names = ("time_ns", "taxel", "polarity", "columns")
            known = Events(*(getattr(events, name)[so_far] for name in names))
            said = deciding.compute_output(known, time_s)
            if expected.decisions[index, step - 1] < 0:
                assert said is None
                continue
            assert said.curve.find_last().label == expected.decisions[index, step - 1]
            after = spec.presentation.gap + step
            assert all(not rows[after:].any() for rows in said.spikes.values())
        at_the_end = deciding.compute_output(events, math.inf)
        np.testing.assert_array_equal(at_the_end.scores, expected.scores[index])
        summed = expected.scores[index] * 200
        assert at_the_end.curve.probabilities[-1].max() == pytest.approx(
            compute_confidence(summed), abs=1e-3
        )
        assert at_the_end.curve.find_last().confidence == pytest.approx(compute_confidence(summed))
        # The moment of the early decision is the step of the check, whenever the page asks.
        stopped = expected.stopped_at[index]
        if compute_confidence(summed) >= spec.presentation.threshold or stopped < 200:
            assert at_the_end.decided.seconds == pytest.approx(first_s + 0.01 * stopped)
            # Random weights with a bias can be confident before any output.
            assert expected.decisions[index, stopped - 1] in (-1, at_the_end.decided.label)
        else:
            assert at_the_end.decided is None


def test_before_the_first_step_is_over_an_events_bundle_says_nothing(events_bundle, recordings):
    events = recordings[0]
    names = ("time_ns", "taxel", "polarity", "columns")
    first = Events(*(getattr(events, name)[:1] for name in names))
    deciding = make_decider(events_bundle, Sensor()).begin()
    assert deciding.compute_output(first, events.time_ns[0] * 1e-9 + 0.009) is None
