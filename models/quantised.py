"""Weights and bias currents that are quantised as on a chip, in the forward pass of a training."""

import numpy as np

from deploy.network.chip import LOIHI, Chip
from models.keras.keras2 import as_written, tf


def pass_gradient_through(rounding, values):
    """Apply a rounding function with a straight-through gradient."""
    return values + tf.stop_gradient(rounding(values) - values)


def find_weight_scale(weights, chip: Chip = LOIHI):
    """Value of one level of a weight on the chip: a scalar tensor without a gradient.

    NengoLoihi scales the weights of a block so that the largest fills its bits
    (``discretize_weights``).
    """
    return tf.stop_gradient(tf.maximum(tf.reduce_max(tf.abs(weights)), 1e-12) / chip.weight_levels)


def quantise_weights(weights, chip: Chip = LOIHI):
    """Round weights to the chip's bits with a common scale; the gradient is straight-through."""
    scale = find_weight_scale(weights, chip)
    return pass_gradient_through(lambda values: tf.round(values / scale) * scale, weights)


def quantise_bias(bias, chip: Chip = LOIHI):
    """Round each bias current to the chip's mantissa; the gradient is straight-through.

    Loihi stores a bias as 12 bits times a power of two (NengoLoihi's ``bias_to_manexp``).
    """
    magnitude = tf.maximum(tf.abs(bias), 1e-12)
    unit = tf.pow(2.0, tf.math.ceil(tf.math.log(magnitude) / np.log(2.0)) - chip.bias_bits)
    return pass_gradient_through(lambda values: tf.round(values / unit) * unit, bias)


@as_written
def quantise_layer(kernel, bias, gain: float, chip: Chip = LOIHI):
    """Kernel and bias, quantised as on the chip.

    Parameters
    ----------
    kernel, bias : tensor
    gain : float
        Gain of the layer's neurons: their current is ``1 + gain * (kernel * input + bias)``, so
        that ``1 + gain * bias`` is their bias current.
    chip : Chip
    """
    current = quantise_bias(1 + gain * bias, chip)
    return quantise_weights(kernel, chip), (current - 1) / gain
