import numpy as np
import pytest

from experiments.slayer import Slayer, SlayerSamples, train_slayer
from pipeline.training.events import Checkpoint

SETTINGS = Slayer(
    architecture="10x10x2-4c2-6c3-3o", bins=40, epochs=6, batch_size=8, learning_rate=0.05,
    true_count=10.0, false_count=1.0, tau_s=10.0, tau_r=1.0,
    conv_scale=10.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def data():
    """Bars at the left, in the middle and at the right, in noise: 36 samples of 3 classes."""
    rng = np.random.default_rng(0)
    labels = np.arange(36) % 3
    frames = (rng.random((40, 36, 10, 10, 2)) < 0.02).astype(np.uint8)
    for sample, label in enumerate(labels):
        at = slice(1 + 3 * label, 3 + 3 * label)
        frames[:25, sample, :, at] |= rng.random(frames[:25, sample, :, at].shape) < 0.6
    return SlayerSamples(frames, labels, np.arange(27), np.arange(27, 36))


@pytest.fixture(scope="module")
def trained(data):
    return train_slayer(SETTINGS, data, seed=3)


def test_it_learns(trained):
    _, history, _ = trained
    assert [row["epoch"] for row in history] == [1, 2, 3, 4, 5, 6]
    assert history[-1]["loss"] < history[0]["loss"] / 2
    assert history[-1]["test_accuracy"] >= 8 / 9


def test_the_counts_are_those_of_the_last_epoch(trained, data):
    test = data.test
    network, history, counts = trained
    layers = [spikes.numpy() for _, spikes in network.compute_layers(data.frames[:, test])]
    assert [s.shape for s in layers] == [(40, 9, 9, 9, 4), (40, 9, 7, 7, 6), (40, 9, 3)]
    assert all(s.any() for s in layers)
    np.testing.assert_array_equal(layers[-1].sum(0), counts)
    assert np.mean(counts.argmax(1) == data.labels[test]) == history[-1]["test_accuracy"]


def test_an_interrupted_training_ends_as_it_would_have(trained, data, tmp_path):
    def interrupt(n, note):
        seen.append(n)
        if len(seen) == 3:
            raise KeyboardInterrupt

    seen, checkpoint = [], Checkpoint(tmp_path / "state.npz", "key")
    with pytest.raises(KeyboardInterrupt):
        train_slayer(SETTINGS, data, 3, checkpoint, interrupt)
    seen = [0, 0, 0]
    network, _, counts = train_slayer(SETTINGS, data, 3, checkpoint, interrupt)
    assert seen[3:] == [3, 1, 1, 1]
    for result, expected in zip(network.kernels, trained[0].kernels, strict=True):
        np.testing.assert_array_equal(result.numpy(), expected.numpy())
    np.testing.assert_array_equal(counts, trained[2])
