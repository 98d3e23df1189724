"""The network's answers while writing are those of its check."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import Bundle, read_bundle
from deploy.network.stimulus import EventFrames
from deploy.targets.registry import answer as answers_of
from pipeline.inputs.frames import bin_events
from pipeline.inputs.images import tactile_images
from pipeline.live.deciding import EventDecider, decider_of, frames_of
from pipeline.recordings.events import Events
from pipeline.settings import Image
from pipeline.skin.simulate import simulate
from tests.deploy import networks


@pytest.fixture(scope="module")
def bundle(tiny_run):
    return read_bundle(tiny_run / "bundle")


@pytest.fixture(scope="module")
def decider(bundle):
    return decider_of(bundle, Image())


@pytest.fixture(scope="module")
def recordings():
    return simulate(3, [2] * 10, jobs=1)


def test_a_whole_recordings_answer_is_that_of_the_target_fast(bundle, decider, recordings):
    spec = bundle.spec.with_presentation(stream_length=1)
    images = tactile_images(recordings)
    expected = answers_of(spec, images, "fast")
    for index in range(len(recordings)):
        said = decider.begin().answer(recordings[index], 2.0)
        np.testing.assert_array_equal(said.scores, expected.scores[index])
        assert said.decision == expected.predictions[index]
        counts = {name: int(np.unpackbits(rows).sum()) for name, rows in said.spikes.items()}
        assert counts == {name: n[index] for name, n in expected.spikes.items()}


def test_it_decides_on_part_of_a_recording_and_not_on_nothing(decider, recordings):
    events = recordings[0]
    part = Events(*(getattr(events, n)[:40] for n in ("time_ns", "taxel", "polarity", "columns")))
    said = decider.begin().answer(part, 0.5)
    assert said.confidence.sum() == pytest.approx(1)
    assert 0 <= said.decision <= 9
    assert decider.begin().answer(Events(*(np.empty(0),) * 4), 0.2) is None


def test_layers_are_as_many_bytes_as_the_page_reads(bundle, decider, recordings):
    said = decider.begin().answer(recordings[0], 2.0)
    assert [layer.name for layer in decider.layers] == list(bundle.spec.spiking_layers)
    assert decider.steps + decider.first_step == bundle.spec.presentation.steps
    for layer in decider.layers:
        assert said.spikes[layer.name].shape == (decider.steps, -(-layer.neurons // 8))


@pytest.fixture(scope="module")
def clocked():
    """An events bundle of random weights, for whole recordings in steps of 20 ms."""
    rng = np.random.default_rng(0)
    small = networks.events_spec()
    conv1 = networks.conv("conv1", (10, 10, 2), 4, 4, rng, scale=8.0)
    spec = replace(
        small,
        input_shape=(10, 10, 2),
        stimulus=EventFrames(0.02),
        layers=(conv1, networks.readout(conv1.shape, rng, classes=10)),
        presentation=replace(small.presentation, steps=100),
    )
    return Bundle(None, "random", spec, None)


def test_frames_are_those_that_networks_are_trained_on(recordings):
    bins = bin_events(recordings, 100)
    for index in range(len(recordings)):
        np.testing.assert_array_equal(frames_of(recordings[index], 100, 0.02)[0], bins[index])


def test_an_events_bundle_says_at_each_moment_what_its_target_says_at_that_step(
    clocked, recordings
):
    decider = decider_of(clocked, Image())
    assert isinstance(decider, EventDecider)
    assert decider.clocked
    spec = clocked.spec.with_presentation(stream_length=1)
    expected = answers_of(spec, bin_events(recordings, 100), "fast")
    assert len(set(expected.predictions)) > 1
    for index in range(0, len(recordings), 3):
        events = recordings[index]
        deciding = decider.begin()
        for time_s in (0.5, 0.9, 1.21, 2.0, 3.5):
            so_far = events.time_ns < time_s * 1e9
            names = ("time_ns", "taxel", "polarity", "columns")
            known = Events(*(getattr(events, name)[so_far] for name in names))
            said, step = deciding.answer(known, time_s), min(int(time_s / 0.02), 100)
            assert said.decision == expected.decisions[index, step - 1]
            after = spec.presentation.gap + step
            assert all(not rows[after:].any() for rows in said.spikes.values())
        np.testing.assert_array_equal(said.scores, expected.scores[index])
