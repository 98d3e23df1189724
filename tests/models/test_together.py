import numpy as np
import pytest
import tensorflow as tf

from models.cnn import build_cnn, get_weights
from models.lif import RateLIF
from models.notation import parse
from models.quantised import OnChipConv2D
from models.together import _orders, fit_together, forward_together

ARCHITECTURE = parse("6x6-3c3-4c2-10o")


def build(seed, activation=None, convolution=None):
    tf.keras.utils.set_random_seed(seed)
    return build_cnn(ARCHITECTURE, activation, convolution)


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
    logits = forward_together(models[0].layers, variables, tf.constant(images))
    for model, part, got in zip(models, images, logits, strict=True):
        np.testing.assert_allclose(got, model(part), atol=1e-4)


@pytest.mark.parametrize("activation", [None, rate_lif], ids=["relu", "rate-lif"])
def test_each_network_ends_as_it_would_with_keras(activation, data):
    """Two networks, samples of different number, last batches that are not full."""
    parts = [np.arange(0, 100, 2), np.arange(1, 100, 2)[:-1]]
    together = [build(seed, activation) for seed in (1, 2)]
    histories = fit_together(together, data, parts, (7, 8), 3, 16, 0.01)
    for index, seed in enumerate((1, 2)):
        alone = build(seed, activation)
        alone.compile(
            tf.keras.optimizers.RMSprop(0.01),
            tf.keras.losses.SparseCategoricalCrossentropy(from_logits=True),
        )
        for epoch in range(3):
            order, mask = _orders([parts[index]], [7 + index], epoch, 16)
            order, losses = order[0][mask[0] == 1], []
            for start in range(0, len(order), 16):
                batch = order[start : start + 16]
                losses.append(alone.train_on_batch(data[0][batch], data[1][batch]) * len(batch))
            assert histories[index][epoch]["loss"] == pytest.approx(
                sum(losses) / len(order), rel=2e-3
            )
        for name, expected in get_weights(alone).items():
            np.testing.assert_allclose(
                get_weights(together[index])[name], expected, atol=2e-3, err_msg=name
            )


def test_they_learn(data):
    models = [build(seed) for seed in (1, 2)]
    parts = [np.arange(100)] * 2
    histories = fit_together(models, data, parts, (1, 2), 25, 16, 0.01)
    assert all(history[-1]["accuracy"] > 0.9 for history in histories)
    for model, history in zip(models, histories, strict=True):
        accuracy = np.mean(model.predict(data[0], verbose=0).argmax(1) == data[1])
        assert accuracy == pytest.approx(history[-1]["accuracy"], abs=0.1)


def test_a_layer_that_cannot_be_stacked_is_named():
    model = build(
        1,
        convolution=lambda index, conv, name: OnChipConv2D(
            conv.filters, conv.kernel, gain=0.2, name=name
        ),
    )
    with pytest.raises(ValueError, match="conv1"):
        forward_together(model.layers, [], tf.zeros((1, 2, 6, 6, 1)))


def test_every_sample_comes_once_an_epoch():
    order, mask = _orders([np.arange(10, 20), np.arange(3)], [1, 2], 0, 4)
    assert order.shape == mask.shape == (2, 12)
    assert sorted(order[0][mask[0] == 1]) == list(range(10, 20))
    assert sorted(order[1][mask[1] == 1]) == [0, 1, 2]
    again, _ = _orders([np.arange(10, 20), np.arange(3)], [1, 2], 1, 4)
    assert not np.array_equal(order, again)
