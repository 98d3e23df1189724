"""What is fed in: frames over time, silence, and the spikes that the host makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import CheckSet, read_bundle, write_bundle
from deploy.check.run import run_check
from deploy.conformance.networks import draw_frames, make_event_network
from deploy.errors import UserError
from deploy.network.build import build_nengo_network
from deploy.network.loihi_import import nengo_loihi
from deploy.network.simulation import present_samples
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames, Feed, ImageSpikes, find_last_steps
from deploy.preflight.plan import make_plan
from tests.deploy.check.test_bundle import with_arrays


def test_frames_and_silence_by_hand():
    """Two samples of three steps, two silent steps before each."""
    spec = make_event_network(steps=3, gap=2, readout_start=0)
    feed = Feed(spec.presentation, 2)
    feed.samples = np.array([[[1, 0], [0, 0], [1, 1]], [[0, 1], [0, 0], [0, 0]]], np.uint8)
    frames = [feed(step * 0.001).tolist() for step in range(1, 11)]
    assert frames == [
        [0, 0], [0, 0], [1, 0], [0, 0], [1, 1], [0, 0], [0, 0], [0, 1], [0, 0], [0, 0],
    ]  # fmt: skip


@pytest.mark.parametrize("target", ["nengo", "simreal", "sim"])
def test_an_event_is_one_spike_in_its_step(target):
    spec = make_event_network()
    frames = draw_frames(spec, 3)
    built = build_nengo_network(spec)
    if target == "nengo":
        import nengo

        simulator = nengo.Simulator(built.network, progress_bar=False, optimize=False)
    else:
        simulator = nengo_loihi.Simulator(built.network, target=target, precompute=True)
    with simulator as sim:
        shown = list(present_samples(built, sim, spec.stimulus.flatten(frames)))
    gap = spec.presentation.gap
    for one, frame in zip(shown, frames, strict=True):
        assert not one.spikes["input"][:gap].any()
        np.testing.assert_array_equal(one.spikes["input"][gap:], frame.reshape(len(frame), -1))


def test_an_event_arrives_as_a_spike_of_height_one():
    """Without a filter, a weight of w adds w to the current of one step: threshold 1."""
    spec = make_event_network(steps=6, gap=2, readout_start=0)
    layer = replace(spec.layers[0], synapse=None, bias=np.zeros(spec.layers[0].bias.shape))
    frames = draw_frames(spec, 1, share=0)
    frames[0, 3, 2, 1, 0] = 1
    fires = {}
    for weight in (15.0, 25.0):  # of a membrane of 20 steps about a twentieth arrives in one step
        weights = np.full_like(layer.weights, weight)
        changed = replace(spec, layers=(replace(layer, weights=weights), *spec.layers[1:]))
        built = build_nengo_network(changed)
        with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:
            (shown,) = present_samples(built, sim, changed.stimulus.flatten(frames))
        fires[weight] = shown.spikes["conv1"].any()
    assert fires == {15.0: False, 25.0: True}


@pytest.fixture(scope="module")
def bundle_on_events(tmp_path_factory):
    spec = make_event_network()
    frames = draw_frames(spec, 7)
    checks = CheckSet(frames, np.arange(7) % 3, tuple(f"sample{i}" for i in range(7)), 0)
    return write_bundle(tmp_path_factory.mktemp("events") / "bundle", spec, checks)


@pytest.fixture(scope="module")
def results_on_events(bundle_on_events):
    """The result of each target."""
    folder = bundle_on_events.path.parent
    return {
        target: run_check(bundle_on_events, target, folder / f"{target}.json")
        for target in ("nengo", "simreal", "emulator", "fast")
    }


def test_a_bundle_has_the_frames_of_events(bundle_on_events):
    frames = bundle_on_events.checks.inputs
    assert frames.dtype == np.uint8
    np.testing.assert_array_equal(frames, draw_frames(bundle_on_events.spec, 7))


def test_every_target_counts_the_spikes_of_events(bundle_on_events, results_on_events):
    for result in results_on_events.values():
        assert result.spikes["input"] == bundle_on_events.checks.inputs.sum()
        assert result.spikes["conv1"] > 0
        assert set(result.synaptic_operations) == {"conv1", "dense1", "output"}


def test_fast_has_each_spike_of_the_emulator_on_events(results_on_events):
    assert results_on_events["fast"].samples == results_on_events["emulator"].samples


def test_operations_of_events_by_hand():
    spec = make_event_network()
    counts = {"input": np.zeros((1, 72)), "conv1": np.zeros((1, 36)), "dense1": np.zeros((1, 5))}
    counts["input"][0, 0] = 2  # a corner reaches one position of 4 filters
    operations = spec.count_synaptic_operations(counts)
    assert operations["conv1"].tolist() == [2 * 4]


def test_worst_case_counts_an_event_a_step():
    assert EventFrames().shortest_interval == 1
    assert ImageSpikes(250.0).shortest_interval == 4
    assert make_plan(make_event_network()).problems == []


def test_a_pixel_spikes_at_most_once_a_step():
    """At 500 Hz a pixel of 2 spikes in every step of 1 ms; at 1000 Hz one of 1 does."""
    images = np.zeros((2, 6, 6, 1))
    for rate, most in ((500.0, 2.0), (1000.0, 1.0)):
        stimulus = ImageSpikes(rate)
        images[1, 2, 3] = most
        assert stimulus.find_problem(images, (6, 6, 1), 30) is None
        images[1, 2, 3] = 1.01 * most
        said = stimulus.find_problem(images, (6, 6, 1), 30)
        assert f"{1.01 * most:g}" in said
        assert f"{rate:g}" in said


def test_wrong_samples_are_refused(tmp_path):
    spec = make_event_network()
    frames = draw_frames(spec, 2)
    checks = CheckSet(frames, np.zeros(2, int), ("a", "b"), 0)
    bundle = write_bundle(tmp_path / "bundle", spec, checks)
    for inputs, fact in ((2 * frames, "0 and 1"), (frames[:, :-1], r"\(19, 6, 6, 2\)")):
        with pytest.raises(UserError, match=fact):
            read_bundle(with_arrays(bundle, "checks.npz", inputs=inputs))


def test_a_taxel_that_spikes_while_it_rests_is_refused():
    spec = make_event_network()
    resting = replace(spec, stimulus=EventFrames(0.01, refractory=2))
    assert resting.stimulus.shortest_interval == 3
    assert NetworkSpec.from_json(resting.to_json(), resting.to_arrays()) == resting
    steps = spec.presentation.steps
    frames = np.zeros((1, *spec.stimulus.find_sample_shape(spec.input_shape, steps)), np.uint8)
    frames[0, [0, 3], 2, 2, 0] = 1
    assert resting.stimulus.find_problem(frames, spec.input_shape, steps) is None
    frames[0, 5, 2, 2, 0] = 1
    assert spec.stimulus.find_problem(frames, spec.input_shape, steps) is None
    assert "2 steps" in resting.stimulus.find_problem(frames, spec.input_shape, steps)
    assert "shape" in resting.stimulus.find_problem(frames.ravel(), spec.input_shape, steps)
    with pytest.raises(ValueError, match=r"refractory.* 0 to 10000"):
        EventFrames(0.01, refractory=-1)


def test_the_last_event_by_hand():
    frames = np.zeros((4, 5, 2, 1, 2), np.uint8)
    frames[0, [1, 3], 1, 0, 1] = 1
    frames[1, 4], frames[2, 0] = 1, 1
    assert find_last_steps(frames).tolist() == [3, 4, 0, 0]


def test_a_taxel_has_at_most_so_many_spikes_in_a_sample():
    """Each sample is limited on its own; the first spikes remain, in every form of samples."""
    frames = np.zeros((2, 6, 1, 2, 1), np.uint8)
    frames[0, :, 0, 0] = 1
    frames[1, [0, 3, 5], 0, 0] = 1
    frames[:, 2, 0, 1] = 1
    flat = EventFrames(0.01, max_spikes=2).flatten(frames)
    assert flat.dtype == frames.dtype
    assert flat[0, :, 0].tolist() == [1, 1, 0, 0, 0, 0]
    assert flat[1, :, 0].tolist() == [1, 0, 0, 1, 0, 0]
    assert flat[:, :, 1].sum(1).tolist() == [1, 1]
    np.testing.assert_array_equal(EventFrames(0.01).flatten(frames), frames.reshape(2, 6, 2))
