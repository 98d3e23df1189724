import numpy as np
import pytest

from models.architecture import parse
from models.cnn import build_cnn, get_weights
from models.keras2 import tf
from models.lif import RateLIF, gain_for
from models.quantised import OnChipConv2D, OnChipDense
from models.together import _orders, fit_together, forward_together
from tests.untraced import untraced

ARCHITECTURE = parse("6x6-3c3-4c2-10o")


def build(seed, activation=None, sums=None):
    tf.keras.utils.set_random_seed(seed)
    return build_cnn(ARCHITECTURE, activation, sums)


def rate_lif(index):
    return RateLIF(150.0)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    labels = np.arange(100) % 10
    images = rng.random((100, 6, 6, 1)).astype(np.float32)
    images[np.arange(100), labels % 6, labels // 6] += 2
    return images, labels


@pytest.mark.parametrize("activation", [None, rate_lif], ids=["relu", "rate-lif"])
def test_logits_are_those_of_each_network(activation, data):
    models = [build(seed, activation) for seed in (1, 2, 3)]
    variables = [
        tf.stack([v.numpy() for v in group])
        for group in zip(*(m.trainable_variables for m in models), strict=True)
    ]
    images = np.stack([data[0][i * 30 : i * 30 + 30] for i in range(3)])
    logits, costs = forward_together(models[0].layers, variables, tf.constant(images))
    assert costs == 0
    for model, part, got in zip(models, images, logits, strict=True):
        np.testing.assert_allclose(got, model(part), atol=1e-4)


def test_every_kind_of_layer_stacked():
    architecture = parse("7x7x2-3c3s2p-2a-5-4o")
    models = []
    for seed in (1, 2):
        tf.keras.utils.set_random_seed(seed)
        models.append(build_cnn(architecture, rate_lif, on_chip_sums))
    variables = [
        tf.stack([v.numpy() for v in group])
        for group in zip(*(m.trainable_variables for m in models), strict=True)
    ]
    images = np.random.default_rng(0).random((2, 6, 7, 7, 2)).astype(np.float32)
    logits, _ = forward_together(models[0].layers, variables, tf.constant(images))
    for model, part, got in zip(models, images, logits, strict=True):
        np.testing.assert_allclose(got, model(part), atol=1e-4)


def on_chip_sums(index, layer, name):
    gain = gain_for(150.0, 0.02, 0.001)
    if layer.kind == "dense":
        return OnChipDense(layer.units, gain, name=name)
    return OnChipConv2D(
        layer.filters, layer.kernel, gain, strides=layer.stride, padding=layer.padding, name=name
    )


def check_against_keras(start, parts, data, optimizer):
    """Two networks together and each alone end with the same losses and weights.

    ``start(seed)`` builds a network, ``optimizer()`` an optimiser.
    """
    together = [start(seed) for seed in (1, 2)]
    histories = fit_together(together, data, parts, (7, 8), 3, 16, optimizer())
    for index, seed in enumerate((1, 2)):
        alone = start(seed)
        loss = tf.keras.losses.SparseCategoricalCrossentropy(from_logits=True)
        alone.compile(optimizer(), loss, run_eagerly=True)  # a dozen steps: not worth compiling
        for epoch in range(3):
            order, mask = _orders([parts[index]], [7 + index], epoch, 16)
            order, losses = order[0][mask[0] == 1], []
            for first in range(0, len(order), 16):
                batch = order[first : first + 16]
                losses.append(alone.train_on_batch(data[0][batch], data[1][batch]) * len(batch))
            expected = sum(losses) / len(order)
            assert histories[index][epoch]["loss"] == pytest.approx(expected, rel=2e-3)
        for name, array in get_weights(alone).items():
            np.testing.assert_allclose(
                get_weights(together[index])[name], array, atol=2e-3, err_msg=name
            )


@pytest.mark.parametrize("activation", [None, rate_lif], ids=["relu", "rate-lif"])
def test_each_network_ends_as_it_would_with_keras(activation, data):
    """Last batches that are not full, and one network has fewer batches than the other."""
    parts = [np.arange(0, 100, 2), np.arange(1, 100, 2)[:30]]
    check_against_keras(
        lambda seed: build(seed, activation), parts, data, lambda: tf.keras.optimizers.RMSprop(0.01)
    )


def test_they_learn(data):
    models = [build(seed) for seed in (1, 2)]
    parts = [np.arange(100)] * 2
    histories = fit_together(models, data, parts, (1, 2), 25, 16, tf.keras.optimizers.RMSprop(0.01))
    assert all(history[-1]["accuracy"] > 0.9 for history in histories)
    for model, history in zip(models, histories, strict=True):
        accuracy = np.mean(model.predict(data[0], verbose=0).argmax(1) == data[1])
        assert accuracy == pytest.approx(history[-1]["accuracy"], abs=0.1)


def own_recipe(seed, noise=0.0):
    """A network as the recipe "loihi" trains it: the chip's weights, spikes at a price."""
    rng = np.random.default_rng(0)
    costs = [rng.random(shape).astype(np.float32) / 50 for shape in ((4, 4, 3), (3, 3, 4))]
    return build(
        seed,
        lambda index: RateLIF(150.0, on_chip=True, noise=noise, spike_costs=costs[index]),
        on_chip_sums,
    )


def test_the_own_recipe_ends_as_it_would_with_keras(data):
    parts = [np.arange(0, 100, 2), np.arange(1, 100, 2)[:-1]]
    check_against_keras(own_recipe, parts, data, lambda: tf.keras.optimizers.Adam(0.003))


def test_noise_is_each_networks_own(data):
    """The same network gets the same noise whatever stands beside it, and other noise each step."""
    images = tf.constant(np.stack([data[0][:5]] * 3))
    models = [own_recipe(1, noise=0.5)] * 3
    variables = [
        tf.stack([v.numpy() for v in group])
        for group in zip(*(m.trainable_variables for m in models), strict=True)
    ]
    seeds = tf.constant([[4, 0], [5, 0], [4, 1]])
    logits, costs = forward_together(models[0].layers, variables, images, seeds)
    one, alone = forward_together(
        models[0].layers, [v[:1] for v in variables], images[:1], seeds[:1]
    )
    np.testing.assert_allclose(logits[0], one[0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(costs[0], alone[0], rtol=1e-5, atol=1e-6)
    assert not np.allclose(logits[0], logits[1])
    assert not np.allclose(logits[0], logits[2])
    quiet, _ = forward_together(models[0].layers, variables, images)
    np.testing.assert_allclose(quiet[0], models[0](data[0][:5]), atol=1e-4)


def test_a_layer_that_cannot_be_stacked_is_named():
    class Own(tf.keras.layers.Conv2D):
        pass

    model = build(1, sums=lambda index, conv, name: Own(conv.filters, conv.kernel, name=name))
    with pytest.raises(ValueError, match="conv1"):
        forward_together(model.layers, [], tf.zeros((1, 2, 6, 6, 1)))


@pytest.mark.parametrize(
    "option", [{"use_bias": False}, {"strides": (1, 2)}, {"activation": "relu"}]
)
def test_an_option_that_is_not_done_is_refused(option):
    layer = tf.keras.layers.Conv2D(2, 3, name="conv1", **option)
    layer.build((None, 6, 6, 1))
    with pytest.raises(ValueError, match="conv1"):
        forward_together([layer], layer.trainable_variables, tf.zeros((1, 2, 6, 6, 1)))


def test_a_network_ends_the_same_beside_a_larger_one_until_the_schedule_differs(data):
    """One epoch of the own recipe, noise included, at a constant learning rate."""

    def weights(parts):
        models = [own_recipe(1, noise=0.5) for _ in parts]
        optimizer = tf.keras.optimizers.Adam(0.003)
        with untraced():
            fit_together(models, data, parts, range(len(parts)), 1, 16, optimizer)
        return get_weights(models[0])

    small, large = np.arange(32), np.arange(100)
    alone, beside = weights([small]), weights([small, large])
    for name, array in alone.items():
        np.testing.assert_allclose(beside[name], array, atol=1e-5, err_msg=name)


def test_every_sample_comes_once_an_epoch():
    order, mask = _orders([np.arange(10, 20), np.arange(3)], [1, 2], 0, 4)
    assert order.shape == mask.shape == (2, 12)
    assert sorted(order[0][mask[0] == 1]) == list(range(10, 20))
    assert sorted(order[1][mask[1] == 1]) == [0, 1, 2]
    again, _ = _orders([np.arange(10, 20), np.arange(3)], [1, 2], 1, 4)
    assert not np.array_equal(order, again)
