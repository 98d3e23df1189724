"""Rate-based leaky integrate-and-fire neurons as Keras layers.

A LIF neuron with input current J (in units of its threshold) fires at

    r(J) = 1 / (tau_ref + tau_rc * log(1 + 1 / (J - 1)))   for J > 1, else 0

spikes per second (Hunsberger and Eliasmith 2016, eq. 2).  Here ``J = 1 + gain * z`` with z the
layer's weighted input, so that the neuron begins to fire at z = 0 like a rectified linear unit;
``gain`` is chosen such that z = 1 gives ``max_rate``, and the output is r / max_rate.

On Loihi a neuron fires at discrete time steps, so its interspike intervals are rounded up to whole
steps, and its time constants are rounded too.  With a constant input the rate would be a staircase.
The input of a deployed neuron fluctuates with every spike that arrives, so that the interval ends
at any point within a step and the rounding adds half a step on average:

    r(J) = 1 / (dt / 2 + tau_ref' + tau_rc' * log(1 + 1 / (J - 1)))

Training uses this rate; noise on the input during training models the fluctuation.
"""

from __future__ import annotations

import numpy as np

from deploy.network.chip import LOIHI
from models.keras2 import as_written, tf

# Time step in seconds.
DT = LOIHI.dt

# Lower bound for the excess over the threshold, which keeps the logarithm finite.
LEAST_EXCESS = 1e-12

# Largest decay value of a compartment.
DECAY_LEVELS = LOIHI.decay_levels


def on_chip_time_constants(tau_rc: float, tau_ref: float):
    """Time constants in seconds on Loihi: a 12-bit decay, a refractory period in whole steps."""
    decay = np.round(-np.expm1(-DT / tau_rc) * DECAY_LEVELS) / DECAY_LEVELS
    return -DT / np.log1p(-decay), DT * np.round(tau_ref / DT)


def gain_for(max_rate: float, tau_rc: float, tau_ref: float) -> float:
    """Gain for which z = 1 makes a neuron fire at ``max_rate`` spikes per second.

    Raises
    ------
    ValueError
        The refractory period does not allow this rate.
    """
    if not 0 < max_rate * tau_ref < 1:
        raise ValueError(
            f"max_rate {max_rate:g} Hz is out of reach with a refractory period of {tau_ref:g} s"
        )
    return float(1 / np.expm1((1 / max_rate - tau_ref) / tau_rc))


class RateLIF(tf.keras.layers.Layer):
    """Firing rates of LIF neurons, relative to ``max_rate``.

    Parameters
    ----------
    max_rate : float
        Spikes per second at z = 1.
    tau_rc, tau_ref : float
        Membrane time constant and refractory period in seconds.
    on_chip : bool
        Use the mean rate on Loihi, with rounded intervals and time constants.
    noise : float
        Standard deviation of the normal noise added to z in training, outside of this layer: see
        :func:`models.cnn.with_noise`.
    dropout : float
        Share of the neurons that are left out in training, in the same way.
    spike_costs : ndarray, shape of one sample, optional
        Penalty in the training loss for a neuron that fires at ``max_rate``, averaged over samples.
    smoothing : float
        The backward pass uses the soft LIF of Hunsberger and Eliasmith (2016, eq. 4), in which
        ``smoothing * softplus((J - 1) / smoothing)`` replaces J - 1, because the slope of the rate
        is infinite at the threshold.

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
        dropout=0.0,
        spike_costs=None,
        smoothing=0.1,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self.max_rate = max_rate
        self.gain = gain_for(max_rate, tau_rc, tau_ref)
        self.noise, self.dropout = noise, dropout
        self.spike_costs = spike_costs
        self.smoothing = smoothing
        if on_chip:
            self.tau_rc, refractory = on_chip_time_constants(tau_rc, tau_ref)
            self.shortest_interval = refractory + DT / 2
        else:
            self.tau_rc, self.shortest_interval = tau_rc, tau_ref

    def call(self, inputs, training=None):
        """Rates relative to ``max_rate``; in training the spike penalty is added to the loss."""
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

        The gradient is explicit because TensorFlow's automatic differentiation would compute the
        smoothed rate in the forward pass too, where it is not needed.
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
        """Spike penalty of each sample; the last dimensions of ``rates`` match ``spike_costs``."""
        dimensions = len(self.spike_costs.shape)
        return tf.reduce_sum(rates * self.spike_costs, axis=tuple(range(-dimensions, 0)))

    def _interval(self, excess):
        """Interspike interval in seconds at a current ``excess`` above the threshold."""
        rise = tf.math.log1p(1 / tf.maximum(excess, LEAST_EXCESS))
        return self.shortest_interval + self.tau_rc * rise
