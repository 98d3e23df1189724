import numpy as np
import tensorflow as tf

from models.quantised import EightBitConv2D, eight_bits


def test_rounding_by_hand():
    weights = np.float32([[1.27, -1.27], [0.004, 0.006]])
    np.testing.assert_allclose(eight_bits(weights), [[1.27, -1.27], [0.0, 0.01]], atol=1e-7)


def test_at_most_255_values_and_the_largest_is_kept():
    weights = np.random.default_rng(0).normal(size=(50, 60)).astype(np.float32)
    rounded = eight_bits(weights).numpy()
    levels = rounded / (np.abs(weights).max() / 127)
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-4)
    assert np.abs(levels).max() == np.float32(127)
    assert np.abs(rounded - weights).max() <= np.abs(weights).max() / 127 / 2 * 1.001


def test_rounding_twice_changes_nothing():
    weights = np.random.default_rng(1).normal(size=200).astype(np.float32)
    once = eight_bits(weights).numpy()
    np.testing.assert_allclose(eight_bits(once), once, atol=1e-7)


def test_weights_of_zero_stay():
    assert not eight_bits(np.zeros((3, 3), np.float32)).numpy().any()


def test_the_gradient_passes_unchanged():
    weights = tf.Variable([0.3, -0.7, 0.001])
    with tf.GradientTape() as tape:
        total = tf.reduce_sum(eight_bits(weights) * [1.0, 2.0, 3.0])
    np.testing.assert_allclose(tape.gradient(total, weights), [1, 2, 3])


def test_the_convolution_computes_with_rounded_weights():
    image = np.random.default_rng(2).normal(size=(2, 6, 6, 1)).astype(np.float32)
    layer = EightBitConv2D(3, 2)
    layer(image)
    plain = tf.keras.layers.Conv2D(3, 2)
    plain(image)
    plain.set_weights([eight_bits(layer.kernel).numpy(), layer.bias.numpy()])
    np.testing.assert_allclose(layer(image), plain(image), atol=1e-5)
    assert not np.allclose(layer.kernel, plain.kernel)
