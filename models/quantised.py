"""Keras layers whose forward pass uses weights quantised as on Loihi."""

from __future__ import annotations

import numpy as np

from deploy.network.chip import LOIHI
from models.keras2 import as_written, tf

WEIGHT_LEVELS = LOIHI.weight_levels
"""Largest magnitude of a signed weight."""

BIAS_BITS = LOIHI.bias_bits
"""Bits of a bias current's mantissa."""


def straight_through(rounding, values):
    """Apply a rounding function with a straight-through gradient."""
    return values + tf.stop_gradient(rounding(values) - values)


def weight_scale(weights):
    """Value of one level of an 8-bit weight: a scalar tensor without a gradient.

    NengoLoihi scales the weights of a block so that the largest fills 8 bits
    (``discretize_weights``).
    """
    return tf.stop_gradient(tf.maximum(tf.reduce_max(tf.abs(weights)), 1e-12) / WEIGHT_LEVELS)


def eight_bits(weights):
    """Round weights to 8 bits with a common scale; the gradient is straight-through."""
    scale = weight_scale(weights)
    return straight_through(lambda values: tf.round(values / scale) * scale, weights)


def twelve_bits(bias):
    """Round each bias current to a 12-bit mantissa; the gradient is straight-through.

    Loihi stores a bias as 12 bits times a power of two (NengoLoihi's ``bias_to_manexp``).
    """
    magnitude = tf.maximum(tf.abs(bias), 1e-12)
    unit = tf.pow(2.0, tf.math.ceil(tf.math.log(magnitude) / np.log(2.0)) - BIAS_BITS)
    return straight_through(lambda values: tf.round(values / unit) * unit, bias)


@as_written
def on_chip(kernel, bias, gain: float):
    """Kernel and bias, quantised as on the chip.

    Parameters
    ----------
    kernel, bias : tensor
    gain : float
        Gain of the layer's neurons: their current is ``1 + gain * (kernel * input + bias)``, so
        that ``1 + gain * bias`` is their bias current.
    """
    return eight_bits(kernel), (twelve_bits(1 + gain * bias) - 1) / gain


class OnChipConv2D(tf.keras.layers.Conv2D):
    """A ``Conv2D`` with the chip's quantised weights and bias currents.

    Parameters
    ----------
    filters, kernel_size : int
    gain : float
        See :func:`on_chip`.
    """

    def __init__(self, filters, kernel_size, gain, **kwargs):
        super().__init__(filters, kernel_size, **kwargs)
        self.gain = gain

    def call(self, inputs):
        """Convolve; shapes as in ``Conv2D``."""
        kernel, bias = on_chip(self.kernel, self.bias, self.gain)
        return tf.nn.bias_add(
            tf.nn.conv2d(inputs, kernel, strides=self.strides, padding=self.padding.upper()), bias
        )


class OnChipDense(tf.keras.layers.Dense):
    """A ``Dense`` layer with the chip's quantised weights and bias currents.

    Parameters
    ----------
    units : int
    gain : float
        See :func:`on_chip`.
    """

    def __init__(self, units, gain, **kwargs):
        super().__init__(units, **kwargs)
        self.gain = gain

    def call(self, inputs):
        """Compute the weighted sums; shapes as in ``Dense``."""
        kernel, bias = on_chip(self.kernel, self.bias, self.gain)
        return tf.matmul(inputs, kernel) + bias
