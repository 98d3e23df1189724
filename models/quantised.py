"""Layers whose forward pass uses the weights that Loihi will use."""

from __future__ import annotations

import tensorflow as tf

WEIGHT_LEVELS = 127
"""Largest magnitude of an 8-bit weight that may have either sign."""


def eight_bits(weights):
    """Round weights to 8 bits with one scale for all of them; the gradient passes unchanged.

    NengoLoihi scales the weights of a block so that the largest fills 8 bits
    (``discretize_weights``).
    """
    scale = tf.maximum(tf.reduce_max(tf.abs(weights)), 1e-12) / WEIGHT_LEVELS
    return weights + tf.stop_gradient(tf.round(weights / scale) * scale - weights)


class EightBitConv2D(tf.keras.layers.Conv2D):
    """A ``Conv2D`` (stride 1, valid padding) computing with 8-bit weights."""

    def call(self, inputs):
        """Convolve; shapes as in ``Conv2D``."""
        signal = tf.nn.conv2d(inputs, eight_bits(self.kernel), strides=1, padding="VALID")
        return tf.nn.bias_add(signal, self.bias)
