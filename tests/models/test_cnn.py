import numpy as np
import pytest

from models.architecture import parse_architecture
from models.chain import make_links
from models.cnn import (
    RateLIF,
    build_cnn,
    call_with_noise,
    compute_activations,
    compute_logits,
    get_weights,
    list_noisy_layers,
    set_weights,
)
from models.keras.keras2 import tf
from models.ops import Dense

PAPER = parse_architecture("10x10-6c4-24c3-10o")


def test_the_papers_network_has_the_notations_weights():
    weights = get_weights(build_cnn(PAPER))
    assert {name: array.shape for name, array in weights.items()} == PAPER.weight_shapes
    assert sum(array.size for array in weights.values()) == 7432


def test_keras_layers_with_other_variables_than_declared_are_refused(monkeypatch):
    def without_bias(layer, name, gain=None):
        return tf.keras.layers.Dense(10, name=name, use_bias=False)

    monkeypatch.setattr(Dense, "make_keras_layer", without_bias)
    with pytest.raises(ValueError, match=r"declare output\.bias"):
        build_cnn(PAPER)


def test_weights_without_a_kernel_make_no_network():
    weights = get_weights(build_cnn(PAPER))
    bias = weights.pop("conv2.bias")
    np.testing.assert_array_equal(make_links(PAPER, weights)[1].bias, np.zeros_like(bias))
    del weights["conv2.kernel"]
    with pytest.raises(ValueError, match=r"'conv2\.kernel' of shape \(3, 3, 6, 24\)"):
        make_links(PAPER, weights)


def test_weights_round_trip():
    first, second = build_cnn(PAPER), build_cnn(PAPER)
    images = np.random.default_rng(0).uniform(size=(3, 10, 10, 1))
    assert not np.allclose(compute_logits(first, images), compute_logits(second, images))
    set_weights(second, get_weights(first))
    np.testing.assert_array_equal(compute_logits(first, images), compute_logits(second, images))


def test_the_network_against_numpy():
    rng = np.random.default_rng(1)
    small = parse_architecture("4x4-2c3-3o")
    weights = {name: rng.normal(size=shape) for name, shape in small.weight_shapes.items()}
    model = build_cnn(small)
    set_weights(model, weights)
    image = rng.uniform(size=(4, 4))
    hidden = np.zeros((2, 2, 2))
    for row in range(2):
        for column in range(2):
            patch = image[row : row + 3, column : column + 3, None]
            hidden[row, column] = (patch * weights["conv1.kernel"][:, :, 0]).sum((0, 1))
    hidden = np.maximum(hidden + weights["conv1.bias"], 0)
    expected = hidden.ravel() @ weights["output.kernel"] + weights["output.bias"]
    np.testing.assert_allclose(
        compute_logits(model, image[None, ..., None])[0], expected, atol=1e-5
    )


@pytest.mark.parametrize("change", ["missing", "shape"])
def test_weights_that_do_not_fit_are_named(change):
    model = build_cnn(PAPER)
    weights = get_weights(model)
    if change == "missing":
        del weights["conv2.bias"]
    else:
        weights["conv2.bias"] = np.zeros(23)
    with pytest.raises(ValueError, match=r"conv2\.bias"):
        set_weights(model, weights)


def test_strides_padding_pooling_and_dense_layers_against_numpy():
    rng = np.random.default_rng(2)
    architecture = parse_architecture("7x6x2-3c3s2p-2a-5-4o")
    assert architecture.shapes == ((7, 6, 2), (4, 3, 3), (2, 1, 3), (5,), (4,))
    weights = {name: rng.normal(size=shape) for name, shape in architecture.weight_shapes.items()}
    model = build_cnn(architecture)
    set_weights(model, weights)
    image = rng.uniform(size=(7, 6, 2))
    padded = np.zeros((9, 7, 2))  # one row before and one after, one column after
    padded[1:8, :6] = image
    conv = np.zeros((4, 3, 3))
    for row in range(4):
        for column in range(3):
            patch = padded[2 * row : 2 * row + 3, 2 * column : 2 * column + 3, :, None]
            conv[row, column] = (patch * weights["conv1.kernel"]).sum((0, 1, 2))
    conv = np.maximum(conv + weights["conv1.bias"], 0)
    pooled = conv[:, :2].reshape(2, 2, 1, 2, 3).mean((1, 3))  # the third column is left over
    dense = np.maximum(pooled.ravel() @ weights["dense1.kernel"] + weights["dense1.bias"], 0)
    expected = dense @ weights["output.kernel"] + weights["output.bias"]
    np.testing.assert_allclose(compute_logits(model, image[None])[0], expected, atol=1e-5)
    shapes = {name: array.shape for name, array in compute_activations(model, image[None]).items()}
    assert shapes == {"conv1": (1, 36), "dense1": (1, 5)}


def test_noise_is_added_to_what_the_neurons_receive():
    """By hand, layer by layer; a model that is called adds none of its own."""
    noises = [0.2, 0.0, 0.5]
    model = build_cnn(
        parse_architecture("6x6-3c3-4c2-5-2o"), lambda index: RateLIF(150.0, noise=noises[index])
    )
    assert [layer.name for layer in list_noisy_layers(model)] == ["conv1_neurons", "dense1_neurons"]
    rng = np.random.default_rng(0)
    images = rng.uniform(size=(4, 6, 6, 1)).astype(np.float32)
    noise = [rng.normal(size=shape).astype(np.float32) for shape in ((4, 4, 4, 3), (4, 5))]
    signal = images
    for layer in model.layers[1:]:
        added = {"conv1_neurons": noise[0], "dense1_neurons": noise[1]}.get(layer.name, 0)
        signal = layer(signal + added).numpy()
    np.testing.assert_allclose(call_with_noise(model, images, noise), signal, rtol=1e-6)
    quiet = compute_logits(model, images)
    assert not np.allclose(signal, quiet, atol=1e-3)
    np.testing.assert_allclose(model(images, training=True), quiet, rtol=1e-6)
    none = [np.zeros_like(values) for values in noise]
    np.testing.assert_allclose(call_with_noise(model, images, none), quiet, rtol=1e-6)
    with pytest.raises(ValueError, match="shorter"):
        call_with_noise(model, images, noise[:1])
