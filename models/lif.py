"""Rate-based leaky integrate-and-fire neurons as Keras layers.

A LIF neuron with input current J (in units of its threshold) fires at

    r(J) = 1 / (tau_ref + tau_rc * log(1 + 1 / (J - 1)))   for J > 1, else 0

spikes a second (Hunsberger and Eliasmith 2016, eq. 2).  Here ``J = 1 + gain * z`` with z the
layer's weighted input, so that the neuron begins to fire at z = 0 as a rectified linear unit does;
``gain`` is such that z = 1 gives ``max_rate``, and the output is r / max_rate.

On Loihi a neuron fires on whole steps, so its intervals are rounded up to them, and its time
constants are rounded.  With a perfectly steady input that makes a staircase of the rate.  The input
of a deployed neuron is never steady: it ripples with every spike that arrives, so that the interval
ends anywhere within a step and the rounding adds half a step on average:

    r(J) = 1 / (dt / 2 + tau_ref' + tau_rc' * log(1 + 1 / (J - 1)))

That is the rate trained with here; noise on the input during training stands for the ripple itself.
"""

from __future__ import annotations

import numpy as np

from deploy.network.chip import LOIHI
from models.keras2 import as_written, tf

DT = LOIHI.dt
"""Time step in seconds."""

LEAST_EXCESS = 1e-12
"""Below it an excess over the threshold counts as this, which keeps its logarithm finite."""

DECAY_LEVELS = LOIHI.decay_levels
"""Largest decay of a compartment."""


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
    on_chip : bool
        The mean rate on Loihi, with its rounded intervals and time constants.
    noise : float
        Standard deviation of the normal noise that training adds to z, outside of the layer: see
        :func:`models.cnn.with_noise`.
    spike_costs : ndarray, shape of one sample, optional
        What a neuron adds to the training's loss when it fires at ``max_rate``, on the mean over
        samples.
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
        on_chip=False,
        noise=0.0,
        spike_costs=None,
        smoothing=0.1,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self.max_rate = max_rate
        self.gain = gain_for(max_rate, tau_rc, tau_ref)
        self.noise = noise
        self.spike_costs = spike_costs
        self.smoothing = smoothing
        if on_chip:
            self.tau_rc, refractory = on_chip_time_constants(tau_rc, tau_ref)
            self.shortest_interval = refractory + DT / 2
        else:
            self.tau_rc, self.shortest_interval = tau_rc, tau_ref

    def call(self, inputs, training=None):
        """Rates relative to ``max_rate``; adds the cost of the spikes to the loss in training."""
        rates = self.rates(inputs)
        if training and self.spike_costs is not None:
            self.add_loss(tf.reduce_mean(self.cost(rates)))
        return rates

    @as_written
    def rates(self, inputs):
        """Rates relative to ``max_rate``, with the gradient of the smoothed rate.

        With the smoothed excess x = smoothing * softplus(gain z / smoothing) and the interval
        T(x) = shortest_interval + tau_rc log(1 + 1/x), the smoothed rate 1 / (T(x) max_rate) has

            d rate / dz = gain sigmoid(gain z / smoothing) tau_rc / (x (x + 1) T(x)^2 max_rate).

        It is written out because TensorFlow's own differentiation computes the smoothed rate, which
        nothing else needs, in the forward pass too.
        """

        @tf.custom_gradient
        def rates(z):
            exact = tf.where(z > 0, 1 / (self._interval(self.gain * z) * self.max_rate), 0.0)

            def gradient(upstream):
                scaled = self.gain * z / self.smoothing
                excess = tf.maximum(self.smoothing * tf.math.softplus(scaled), LEAST_EXCESS)
                steepness = self.gain * self.tau_rc / self.max_rate * tf.sigmoid(scaled)
                interval = self._interval(excess)
                return upstream * steepness / (excess * (excess + 1) * tf.square(interval))

            return exact, gradient

        return rates(inputs)

    @as_written
    def cost(self, rates):
        """Cost of the spikes of each sample; the last dimensions are those of ``spike_costs``."""
        dimensions = len(self.spike_costs.shape)
        return tf.reduce_sum(rates * self.spike_costs, axis=tuple(range(-dimensions, 0)))

    def _interval(self, excess):
        """Seconds between spikes at a current that exceeds the threshold by ``excess``."""
        rise = tf.math.log1p(1 / tf.maximum(excess, LEAST_EXCESS))
        return self.shortest_interval + self.tau_rc * rise
