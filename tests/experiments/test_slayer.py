import dataclasses

import numpy as np
import pytest

from experiments.slayer import Slayer, spike_response, train_slayer
from experiments.slayer_network import SlayerNetwork
from models.architecture import parse
from pipeline.training.events import Checkpoint
from tests.untraced import untraced

SETTINGS = Slayer(
    architecture="10x10x2-4c2-6c3-3o", bins=40, epochs=6, batch_size=8, learning_rate=0.05,
    true_count=10.0, false_count=1.0, tau_s=0.5, tau_r=0.05,
    conv_scale=10.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def data():
    """Bars at the left, in the middle and at the right, in noise: 36 samples of 3 classes."""
    rng = np.random.default_rng(0)
    labels = np.arange(36) % 3
    frames = (rng.random((36, 40, 10, 10, 2)) < 0.02).astype(np.uint8)
    for frame, label in zip(frames, labels, strict=True):
        at = slice(1 + 3 * label, 3 + 3 * label)
        frame[:25, :, at] |= rng.random(frame[:25, :, at].shape) < 0.6
    return frames, labels, np.arange(27), np.arange(27, 36)


@pytest.fixture(scope="module")
def trained(data):
    return train_slayer(SETTINGS, *data, seed=3)


def layer_spikes(settings, kernels, frames, duration_s=2.0):
    """Spikes of every layer of a trained network, shape (n_samples, bins, ...) each."""
    network = SlayerNetwork(parse(settings.architecture), spike_response(settings, duration_s))
    for own, kernel in zip(network.kernels, kernels, strict=True):
        own[:] = kernel
    layers = zip(*(network.layers(frame) for frame in frames), strict=True)
    return [np.array([spikes for _, spikes in samples]) for samples in layers]


def test_it_learns(trained):
    assert [row["epoch"] for row in trained.history] == [1, 2, 3, 4, 5, 6]
    assert trained.history[-1]["loss"] < trained.history[0]["loss"] / 2
    assert trained.history[-1]["test_accuracy"] >= 8 / 9


def test_the_counts_are_those_of_the_last_epoch(trained, data):
    frames, labels, _, test = data
    *_, outputs = layer_spikes(SETTINGS, trained.kernels, frames[test])
    np.testing.assert_array_equal(outputs.sum(1), trained.counts)
    right = trained.counts.argmax(1) == labels[test]
    assert right.mean() == trained.history[-1]["test_accuracy"]


def test_layers_have_the_shapes_of_the_notation(trained, data):
    spikes = layer_spikes(SETTINGS, trained.kernels, data[0][:4])
    assert [s.shape for s in spikes] == [(4, 40, 9, 9, 4), (4, 40, 7, 7, 6), (4, 40, 3)]
    assert all(s.any() for s in spikes)


def test_time_is_that_of_the_recordings(trained, data):
    """Recordings and time constants of twice the length are the same in bins."""
    slower = dataclasses.replace(SETTINGS, epochs=1, tau_s=1.0, tau_r=0.1)
    with untraced():
        first = train_slayer(slower, *data, seed=3, duration_s=4.0).history[0]
    assert first["loss"] == pytest.approx(trained.history[0]["loss"])
    same = layer_spikes(slower, trained.kernels, data[0][:4], duration_s=4.0)
    for mine, expected in zip(
        same, layer_spikes(SETTINGS, trained.kernels, data[0][:4]), strict=True
    ):
        np.testing.assert_array_equal(mine, expected)


def test_an_interrupted_training_ends_as_it_would_have(trained, data, tmp_path):
    def interrupt(n, note):
        seen.append(n)
        if len(seen) == 3:
            raise KeyboardInterrupt

    seen, checkpoint = [], Checkpoint(tmp_path / "state.npz", "key")
    with pytest.raises(KeyboardInterrupt):
        train_slayer(SETTINGS, *data, 3, checkpoint, interrupt)
    seen = [0, 0, 0]
    resumed = train_slayer(SETTINGS, *data, 3, checkpoint, interrupt)
    assert seen[3:] == [3, 1, 1, 1]
    for got, expected in zip(resumed.kernels, trained.kernels, strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(resumed.counts, trained.counts)
