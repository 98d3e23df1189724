"""Rate-based leaky integrate-and-fire neurons as Keras layers.

A LIF neuron with input current J (in units of its threshold) fires at

    r(J) = 1 / (tau_ref + tau_rc * log(1 + 1 / (J - 1)))   for J > 1, else 0

spikes a second (Hunsberger and Eliasmith 2016, eq. 2).  Here ``J = 1 + gain * z`` with z the
layer's weighted input, so that the neuron begins to fire at z = 0 as a rectified linear unit does;
``gain`` is such that z = 1 gives ``max_rate``, and the output is r / max_rate.

On Loihi a neuron can fire only on whole steps and its time constants are rounded:

    r(J) = 1 / (dt * ceil((tau_ref' + tau_rc' * log(1 + 1 / (J - 1))) / dt))
"""

from __future__ import annotations

import numpy as np
import tensorflow as tf

DT = 0.001
"""Time step in seconds."""

DECAY_LEVELS = 2**12 - 1
"""Loihi keeps the decay of a compartment as 12 bits."""


def on_chip_time_constants(tau_rc: float, tau_ref: float):
    """Time constants in seconds as Loihi has them: 12-bit decay, whole steps of refractory time."""
    decay = np.round(-np.expm1(-DT / tau_rc) * DECAY_LEVELS) / DECAY_LEVELS
    return -DT / np.log1p(-decay), DT * np.round(tau_ref / DT)


def gain_for(max_rate: float, tau_rc: float, tau_ref: float) -> float:
    """Gain with which z = 1 makes a neuron fire at ``max_rate`` spikes a second.

    Raises
    ------
    ValueError
        The refractory period does not allow that rate.
    """
    if not 0 < max_rate * tau_ref < 1:
        raise ValueError(
            f"max_rate {max_rate:g} Hz is out of reach with a refractory period of {tau_ref:g} s"
        )
    return float(1 / np.expm1((1 / max_rate - tau_ref) / tau_rc))


class RateLIF(tf.keras.layers.Layer):
    """Rate of LIF neurons, relative to ``max_rate``.

    Parameters
    ----------
    max_rate : float
        Spikes a second at z = 1.
    tau_rc, tau_ref : float
        Membrane time constant and refractory period in seconds.
    whole_steps : bool
        Forward pass with Loihi's rates (whole-step intervals, discretised time constants).
    smoothing : float
        The backward pass uses the soft LIF of Hunsberger and Eliasmith (2016, eq. 4): J - 1
        replaced by ``smoothing * softplus((J - 1) / smoothing)``.  The rate itself has an infinite
        slope at the threshold.

    Notes
    -----
    Input and output: any shape, float.
    """

    def __init__(
        self,
        max_rate,
        tau_rc=0.02,
        tau_ref=0.001,
        whole_steps=False,
        smoothing=0.1,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self.max_rate = max_rate
        self.gain = gain_for(max_rate, tau_rc, tau_ref)
        self.whole_steps = whole_steps
        self.smoothing = smoothing
        self.tau_rc, self.tau_ref = (
            on_chip_time_constants(tau_rc, tau_ref) if whole_steps else (tau_rc, tau_ref)
        )

    def call(self, inputs):
        smooth = self._smooth(inputs)
        # The value of the exact rate with the gradient of the smooth one.
        return smooth + tf.stop_gradient(self._exact(inputs) - smooth)

    def _exact(self, z):
        excess = self.gain * z
        period = self.tau_ref + self.tau_rc * tf.math.log1p(1 / tf.maximum(excess, 1e-20))
        if self.whole_steps:
            # The hair below one step is for periods that are whole but for rounding.
            period = DT * tf.math.ceil(period / DT - 1e-4)
        return tf.where(excess > 1e-20, 1 / (period * self.max_rate), 0.0)

    def _smooth(self, z):
        excess = self.smoothing * tf.math.softplus(self.gain * z / self.smoothing)
        period = self.tau_ref + self.tau_rc * tf.math.log1p(1 / tf.maximum(excess, 1e-12))
        return 1 / (period * self.max_rate)
