"""Layers whose forward pass uses the weights that Loihi will use."""

from __future__ import annotations

import numpy as np

from deploy.network.chip import LOIHI
from models.keras2 import as_written, tf

WEIGHT_LEVELS = LOIHI.weight_levels
"""Largest magnitude of a weight that may have either sign."""

BIAS_BITS = LOIHI.bias_bits
"""Bits of the mantissa of a bias current."""


def straight_through(rounding, values):
    """Values after a rounding function, with the gradient that they would have without it."""
    return values + tf.stop_gradient(rounding(values) - values)


def weight_scale(weights):
    """What one level of an 8-bit weight stands for, without a gradient; a scalar tensor.

    NengoLoihi scales the weights of a block so that the largest fills 8 bits
    (``discretize_weights``).
    """
    return tf.stop_gradient(tf.maximum(tf.reduce_max(tf.abs(weights)), 1e-12) / WEIGHT_LEVELS)


def eight_bits(weights):
    """Round weights to 8 bits with one scale for all of them; the gradient passes unchanged."""
    scale = weight_scale(weights)
    return straight_through(lambda values: tf.round(values / scale) * scale, weights)


def twelve_bits(bias):
    """Round bias currents to a mantissa of 12 bits each; the gradient passes unchanged.

    Loihi holds a bias as 12 bits times a power of two (NengoLoihi's ``bias_to_manexp``).
    """
    magnitude = tf.maximum(tf.abs(bias), 1e-12)
    unit = tf.pow(2.0, tf.math.ceil(tf.math.log(magnitude) / np.log(2.0)) - BIAS_BITS)
    return straight_through(lambda values: tf.round(values / unit) * unit, bias)


@as_written
def on_chip(kernel, bias, gain: float):
    """Kernel and bias as the chip has them.

    Parameters
    ----------
    kernel, bias : tensor
    gain : float
        Of the neurons that follow: their current is ``1 + gain * (kernel * input + bias)``, which
        makes ``1 + gain * bias`` their bias current.
    """
    return eight_bits(kernel), (twelve_bits(1 + gain * bias) - 1) / gain


class OnChipConv2D(tf.keras.layers.Conv2D):
    """A ``Conv2D`` with the weights and bias currents of the chip.

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
    """A ``Dense`` layer with the weights and bias currents of the chip.

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
        """Weigh; shapes as in ``Dense``."""
        kernel, bias = on_chip(self.kernel, self.bias, self.gain)
        return tf.matmul(inputs, kernel) + bias
