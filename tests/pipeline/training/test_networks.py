"""Training learns, repeats itself, and hands over what it learned."""

import os

import numpy as np
import pytest

from models.cnn import compute_activations, set_weights
from pipeline.settings import Settings, write_settings
from pipeline.training.images import epochs
from pipeline.training.images.epochs import TrainingSamples, _draw_samples
from pipeline.training.images.networks import TrainedCNN, build_rate_network
from pipeline.training.images.rescaling import scale_to_unit
from pipeline.training.images.schedules import make_cnn_schedule, make_snn_schedule
from pipeline.training.images.train import train_cnn, train_matched, train_rate_network
from tests.command import LEAVE_GARBAGE, printed_by, users_environment


@pytest.fixture(scope="module")
def stripes():
    """Images that a few epochs can tell apart: class k has its row k lit."""
    rng = np.random.default_rng(0)
    labels = np.tile(np.arange(10), 40)
    images = rng.uniform(0, 0.2, (len(labels), 10, 10, 1)).astype(np.float32)
    images[np.arange(len(labels)), labels] += 0.8
    return images, labels


def settings(**snn):
    return Settings().with_values({"cnn": {"epochs": 6, "batch_size": 16}, "snn": snn}, "test")


def accuracy(logits, labels):
    return np.mean(np.argmax(logits, axis=1) == labels)


@pytest.fixture(scope="module")
def cnn(stripes):
    return train_cnn(settings(), TrainingSamples(*stripes), seed=0)


def test_the_weights_are_the_trained_ones(cnn, stripes):
    images, labels = stripes
    found = accuracy(cnn.compute_logits(images), labels)
    assert found >= cnn.history[-1]["accuracy"] - 0.02
    assert found > 0.9


def test_same_seed_same_weights(cnn, stripes):
    again = train_cnn(settings(), TrainingSamples(*stripes), seed=0)
    other = train_cnn(settings(), TrainingSamples(*stripes), seed=1)
    for name, array in cnn.weights.items():
        np.testing.assert_array_equal(array, again.weights[name])
    assert not np.array_equal(cnn.weights["output.kernel"], other.weights["output.kernel"])


def test_images_that_are_computed_in_parts_give_the_same_weights(cnn, stripes, monkeypatch):
    monkeypatch.setattr(epochs, "MAX_IMAGES_AHEAD", 1)
    monkeypatch.setattr(epochs, "ALTERED_AT_ONCE", 16)
    again = train_cnn(settings(), TrainingSamples(*stripes), seed=0)
    for name, array in cnn.weights.items():
        np.testing.assert_array_equal(array, again.weights[name])


@pytest.mark.parametrize("recipe", ["paper", "loihi"])
def test_rate_networks_learn(cnn, stripes, recipe):
    images, labels = stripes
    chosen = settings(recipe=recipe, epochs=8, batch_size=16)
    trained = train_rate_network(chosen, TrainingSamples(*stripes), 0, cnn.weights)
    assert accuracy(trained.compute_logits(images), labels) > 0.9


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="only one core is allowed")
def test_the_number_of_cores_does_not_matter(stripes, tmp_path):
    """The weights of a process on one core in another that has all, both as a user starts them."""
    np.savez(tmp_path / "data.npz", *stripes)
    write_settings(tmp_path / "chosen.toml", settings(recipe="loihi", epochs=2))
    printed_by(LEAVE_GARBAGE + ON_ONE_AND_ALL, env=users_environment(), cwd=tmp_path)
    trained = []
    for cores in ("one", "all"):
        for name in ("cnn", "rates"):
            with np.load(tmp_path / f"{name}-{cores}.npz") as weights:
                trained.append(dict(weights))
    for one, all_ in zip(trained[:2], trained[2:], strict=True):
        assert set(one) == set(all_)
        for name, array in one.items():
            np.testing.assert_array_equal(array, all_[name], err_msg=name)


# TensorFlow counts the cores when it computes for the first time, which is after the fork.
ON_ONE_AND_ALL = """
import os
import numpy as np
from pipeline.settings import read_settings
from pipeline.training.images.epochs import TrainingSamples
from pipeline.training.images.train import train_cnn, train_rate_network

chosen = read_settings("chosen.toml")
stripes = TrainingSamples(*np.load("data.npz").values())

def train(name):
    cnn = train_cnn(chosen, stripes, 0)
    np.savez(f"cnn-{name}.npz", **cnn.weights)
    rates = train_rate_network(chosen, stripes, 0, cnn.weights)
    np.savez(f"rates-{name}.npz", **rates.weights)

child = os.fork()
if child == 0:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    train("one")
    os._exit(0)
train("all")
assert os.waitpid(child, 0)[1] == 0
"""


def test_noise_is_normal_with_the_settings_deviation():
    chosen = settings(recipe="loihi", epochs=2, batch_size=64, noise=0.3)
    model = build_rate_network(chosen)
    schedule = make_snn_schedule(chosen.snn, 200)
    samples = TrainingSamples(np.arange(200.0).reshape(-1, 1, 1, 1), np.arange(200))
    drawn = list(_draw_samples(model, samples, schedule, 4))
    assert [len(labels) for _, labels, _, _ in drawn] == [200, 200]
    assert sorted(drawn[0][1].numpy()) == list(range(200))
    assert not np.array_equal(drawn[0][1], drawn[1][1])
    for images, labels, noise, masks in drawn:
        np.testing.assert_array_equal(images[:, 0, 0, 0], labels)
        assert masks == []
        assert [layer.shape for layer in noise] == [(200, 7, 7, 6), (200, 5, 5, 24)]
        for layer in noise:
            assert abs(float(np.mean(layer))) < 0.01
            assert np.std(layer) == pytest.approx(0.3, rel=0.02)
    first, second = drawn[0][2][0].numpy(), drawn[1][2][0].numpy()
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
    again, other = (
        next(_draw_samples(model, samples, schedule, seed))[2][0].numpy() for seed in (4, 5)
    )
    np.testing.assert_array_equal(again, first)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.02


def test_a_price_on_spikes_saves_spikes(cnn, stripes):
    totals = []
    for penalty in (0.0, 5.0):
        chosen = settings(spike_penalty=penalty, epochs=6, batch_size=16)
        trained = train_rate_network(chosen, TrainingSamples(*stripes), 0, cnn.weights)
        model = build_rate_network(chosen)
        set_weights(model, trained.weights)
        totals.append(compute_activations(model, stripes[0])["conv1"].sum())
    assert totals[1] < 0.8 * totals[0]


def test_scaling_to_unit_keeps_the_function(cnn, stripes):
    images, _ = stripes
    scaled = scale_to_unit(settings(), cnn.weights, images)
    np.testing.assert_allclose(
        TrainedCNN(settings(), scaled).compute_logits(images),
        cnn.compute_logits(images),
        rtol=1e-3,
        atol=1e-3,
    )
    assert not np.allclose(scaled["conv1.kernel"], cnn.weights["conv1.kernel"])


def test_validation_samples_are_watched_and_not_trained_on():
    rng = np.random.default_rng(0)
    images = rng.uniform(size=(40, 10, 10, 1)).astype(np.float32)
    labels = rng.integers(0, 10, 40)
    chosen = Settings().with_values({"cnn": {"epochs": 1}}, "test")
    watched = train_cnn(chosen, TrainingSamples(images, labels, None, (images[:8], labels[:8])), 0)
    unwatched = train_cnn(chosen, TrainingSamples(images, labels), 0)
    logits = watched.compute_logits(images[:8])
    right = float(np.mean(logits.argmax(1) == labels[:8]))
    shares = np.exp(logits - logits.max(1, keepdims=True))
    shares /= shares.sum(1, keepdims=True)
    loss = -np.log(shares[np.arange(8), labels[:8]]).mean()
    assert watched.history[0]["val_accuracy"] == right
    assert watched.history[0]["val_loss"] == pytest.approx(loss, rel=1e-4)
    for name, array in watched.weights.items():
        np.testing.assert_array_equal(array, unwatched.weights[name])


def test_the_best_shift_brings_a_lif_neuron_near_a_rectified_unit():
    """By hand: at z = 1 the rate is max_rate whatever the shift, and it beats no shift."""
    from models.cnn import RateLIF
    from pipeline.training.images.rescaling import _find_best_shift

    neurons = RateLIF(150.0, on_chip=True)
    wanted = np.linspace(0.001, 1, 500)
    shift, factor = _find_best_shift(neurons, wanted)
    assert 0 < shift < 0.5

    def error(shift, factor):
        rates = neurons.compute_rates(((1 + shift) * wanted - shift).astype(np.float32)).numpy()
        return np.sqrt(np.mean((factor * rates - wanted) ** 2))

    plain = neurons.compute_rates(wanted.astype(np.float32)).numpy()
    assert error(shift, factor) < 0.5 * error(0.0, plain @ wanted / (plain @ plain))
    assert _find_best_shift(neurons, np.empty(0)) == (0.0, 1.0)


def test_dropout_keeps_the_mean():
    chosen = settings(recipe="loihi", epochs=1, batch_size=64, dropout=0.25)
    model = build_rate_network(chosen)
    samples = TrainingSamples(np.zeros((200, 1, 1, 1)), np.zeros(200, int))
    *_, masks = next(_draw_samples(model, samples, make_snn_schedule(chosen.snn, 200), 4))
    assert [layer.shape for layer in masks] == [(200, 7, 7, 6), (200, 5, 5, 24)]
    for mask in masks:
        assert set(np.unique(mask)) == {np.float32(0), np.float32(4 / 3)}
        assert np.mean(mask) == pytest.approx(1, abs=0.02)


def test_small_data_sets_get_more_epochs():
    """A schedule shows a number of samples at least; a number of epochs that is set is kept."""
    default = Settings()
    assert make_cnn_schedule(default.cnn, 5562).epochs == 20  # the paper's
    assert make_cnn_schedule(default.cnn, 518).epochs == 155  # 80,000 samples
    assert make_snn_schedule(default.snn, 5562).epochs == 60
    assert make_snn_schedule(default.snn, 518).epochs == 309
    assert make_cnn_schedule(settings().cnn, 518).epochs == 6


def test_the_matched_cnn_is_trained_like_the_rate_network(cnn, stripes):
    images, labels = stripes
    chosen = settings(epochs=8, batch_size=16)
    matched = train_matched(chosen, TrainingSamples(*stripes), 0, cnn.weights)
    assert [row["epoch"] for row in matched.history] == list(range(1, 9))
    assert accuracy(matched.compute_logits(images), labels) > 0.9
    untrained = scale_to_unit(chosen, cnn.weights, images)
    assert not np.allclose(matched.weights["conv1.kernel"], untrained["conv1.kernel"])
    # It starts from the CNN's function, not from new weights.
    assert matched.history[0]["accuracy"] > 0.9


def test_altered_images_take_the_place_of_the_samples(stripes):
    images, labels = stripes
    seen = []

    def altered(rng, indices):
        seen.append(indices)
        return images[(indices + 1) % len(images)]  # of the next class

    few = Settings().with_values({"cnn": {"epochs": 8, "batch_size": 16}})
    trained = train_cnn(few, TrainingSamples(*stripes, altered), 0)
    assert len(seen) == 8
    assert np.mean(trained.compute_logits(images).argmax(1) == (labels - 1) % 10) > 0.8
