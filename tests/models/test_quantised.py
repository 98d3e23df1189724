import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.keras.keras2 import tf
from models.keras.operation_layer import OperationLayer
from models.ops import Convolution
from models.quantised import quantise_bias, quantise_weights


def test_rounding_by_hand():
    weights = np.float32([[1.27, -1.27], [0.004, 0.006]])
    np.testing.assert_allclose(quantise_weights(weights), [[1.27, -1.27], [0.0, 0.01]], atol=1e-7)


def test_at_most_255_values_and_the_largest_is_kept():
    weights = np.random.default_rng(0).normal(size=(50, 60)).astype(np.float32)
    rounded = quantise_weights(weights).numpy()
    levels = rounded / (np.abs(weights).max() / 127)
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-4)
    assert np.abs(levels).max() == np.float32(127)
    assert np.abs(rounded - weights).max() <= np.abs(weights).max() / 127 / 2 * 1.001


def test_the_gradient_passes_unchanged():
    weights = tf.Variable([0.3, -0.7, 0.001])
    with tf.GradientTape() as tape:
        total = tf.reduce_sum(quantise_weights(weights) * [1.0, 2.0, 3.0])
    np.testing.assert_allclose(tape.gradient(total, weights), [1, 2, 3])


@given(st.floats(2.0**-10, 100.0), st.booleans())
def test_a_bias_keeps_quantise_bias(bias, negative):
    bias = -bias if negative else bias
    rounded = float(quantise_bias(tf.constant(bias, tf.float64)))
    assert abs(rounded - bias) <= abs(bias) * 2.0**-12
    mantissa = rounded / 2.0 ** (np.ceil(np.log2(abs(rounded))) - 12)
    assert mantissa == pytest.approx(round(mantissa), abs=1e-9)
    assert abs(mantissa) <= 2**12


def test_the_convolution_computes_with_the_chips_weights_and_biases():
    image = np.random.default_rng(2).normal(size=(2, 6, 6, 1)).astype(np.float32)
    gain, bias = 0.3, np.float32([0.1, -0.2, 0.33])
    layer = OperationLayer(Convolution(3, 2), gain)
    layer(image)
    layer.bias.assign(bias)
    plain = tf.keras.layers.Conv2D(3, 2)
    plain(image)
    on_chip = (quantise_bias(1 + gain * bias).numpy() - 1) / gain
    plain.set_weights([quantise_weights(layer.kernel).numpy(), on_chip])
    np.testing.assert_allclose(layer(image), plain(image), atol=1e-5)
    assert not np.allclose(layer.kernel, plain.kernel)
    assert not np.array_equal(on_chip, bias)
