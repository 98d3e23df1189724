"""SLAYER: spike response neurons trained directly on events (Shrestha and Orchard 2018).

The equations and their sections in "SLAYER: Spike Layer Error Reassignment in Time" (NeurIPS 2018)
are below.  Time t counts steps of ``dt``; ``*`` is convolution and ``(x)`` correlation in time; l
is the layer, W its weights (here a convolution or a dense layer, without bias).

=========================  =====================================================  ===============
spike response             a = eps * s,  eps(t) = t/tau_s exp(1 - t/tau_s)        Section 2.1
refractory response        nu(t) = -scale_ref theta t/tau_r exp(1 - t/tau_r)      Section 2.1
membrane potential         u_l = W_l a_(l-1) + nu * s_l                           Section 2.1
spikes                     s_l(t) = 1 where u_l(t) >= theta                       Section 2.1
spike escape rate          rho(t) = scale_rho/tau exp(-abs(u(t) - theta)/tau),    Section 3.2
                           tau = tau_rho theta
error of the layer         e_l = W_(l+1)^T delta_(l+1)                            Section 3.3
credit over time           delta_l = rho_l . (eps (x) e_l)                        Section 3.3
gradient                   dE/dW_l = sum over t of delta_l(t) a_(l-1)(t)^T        Section 3.3
error of the output        e(t) = (count - desired count)/T                       Section 3.1
=========================  =====================================================  ===============

rho replaces the derivative of a spike with respect to the potential (the stochastic neuron of
Section 3.2); the correlation distributes an error at time t over the earlier inputs that caused it.
As in the paper, the refractory response influences rho through u but is not differentiated.

Both kernels are impulse responses of a second-order linear filter, so that a convolution over time
costs a few operations per step for any time constant: with d = exp(-1/tau),

    p(t) = d p(t-1) + s(t),    q(t) = d (q(t-1) + p(t-1)),    (eps * s)(t) = e/tau q(t).

Layers with weights process all steps of all samples at once; only :func:`fire` iterates over steps,
in one loop compiled by XLA that computes both filters, and its gradient is one such reverse loop.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from models.architecture import Architecture
from models.keras2 import tf
from models.time_steps import scan, weighted_sums


@dataclass(frozen=True)
class SpikeResponse:
    """Parameters of a spike response neuron; times in seconds.

    The defaults are those of the authors' published example on N-MNIST, a similar data set: time
    constants of 10 and 1 steps, theta = 10, refractory scale 2.  The ST-MNIST paper does not state
    its values.

    Attributes
    ----------
    dt : float
        Length of a time step; ST-MNIST paper, Section 3.2.3: bins of 0.01 s.
    tau_s : float
        Time constant of the spike response kernel.
    tau_r : float
        Time constant of the refractory kernel.
    scale_ref : float
        Depth of the refractory response in units of the threshold.
    theta : float
        Threshold.
    tau_rho : float
        Width of the escape rate in units of the threshold.
    scale_rho : float
        Integral of the escape rate on either side of the threshold.
    """

    dt: float = 0.01
    tau_s: float = 0.1
    tau_r: float = 0.01
    scale_ref: float = 2.0
    theta: float = 10.0
    tau_rho: float = 1.0
    scale_rho: float = 1.0

    def __post_init__(self):
        for name in ("dt", "tau_s", "tau_r", "theta", "tau_rho"):
            if getattr(self, name) <= 0:
                raise ValueError(f"SpikeResponse: {name} must be above zero")

    def decay(self, tau: float) -> float:
        """Decay factor per step of a trace with time constant ``tau``."""
        return float(np.exp(-self.dt / tau))

    def gain(self, tau: float) -> float:
        """Factor that scales q to a kernel of unit peak: e/tau with tau in steps."""
        return float(np.e * self.dt / tau)


def spike_response(spikes, neuron: SpikeResponse):
    """The response a = eps * s to spikes without a gradient, such as the network's input.

    Parameters
    ----------
    spikes : tensor of float32, shape (steps, ...)
        1 where there is a spike, 0 elsewhere.

    Returns
    -------
    tensor of float32, shape (steps, ...)
    """
    flat = tf.reshape(spikes, (spikes.shape[0], -1))
    return tf.stop_gradient(tf.reshape(_respond(flat, neuron), tf.shape(spikes)))


def fire(current, neuron: SpikeResponse):
    """Simulate the neurons of a layer, and the synaptic response to their spikes.

    Parameters
    ----------
    current : tensor of float32, shape (steps, ...)
        W a, the weighted responses of the previous layer.

    Returns
    -------
    response : tensor, shape (steps, ...)
        a = eps * s.  Its gradient with respect to ``current`` is delta of the module's docstring.
    potential : tensor, shape (steps, ...)
        u, including the refractory response; the neuron fires where it reaches theta.  This output
        has no gradient.
    """

    @tf.custom_gradient
    def fire_with_credit(current):
        # Without it TensorFlow would also differentiate the loop itself, which XLA cannot do.
        response, potential = _fire(tf.stop_gradient(current), neuron)

        def credit(error, _):
            return _assign_credit(error, potential, neuron)

        return (response, potential), credit

    # XLA fuses the neurons of a step into one loop if they are one dimension.
    flat = tf.reshape(current, (current.shape[0], -1))
    response, potential = (tf.reshape(x, tf.shape(current)) for x in fire_with_credit(flat))
    response.set_shape(current.shape)
    potential.set_shape(current.shape)
    return response, tf.stop_gradient(potential)


_compiled = functools.partial(tf.function, jit_compile=True, autograph=False)


@_compiled
def _respond(spikes, neuron):
    decay, gain = neuron.decay(neuron.tau_s), neuron.gain(neuron.tau_s)

    def step(t, traces):
        p, q = traces
        q = decay * (q + p)
        return (decay * p + spikes[t], q), (gain * q,)

    return scan(step, spikes, _zeros(spikes, 2), outputs=1)[0]


@_compiled
def _fire(current, neuron):
    decay_s, gain_s = neuron.decay(neuron.tau_s), neuron.gain(neuron.tau_s)
    decay_r = neuron.decay(neuron.tau_r)
    gain_r = -neuron.scale_ref * neuron.theta * neuron.gain(neuron.tau_r)

    def step(t, traces):
        p, q, p_r, q_r = traces
        q, q_r = decay_s * (q + p), decay_r * (q_r + p_r)
        potential = current[t] + gain_r * q_r
        spikes = tf.cast(potential >= neuron.theta, current.dtype)
        return (decay_s * p + spikes, q, decay_r * p_r + spikes, q_r), (gain_s * q, potential)

    return scan(step, current, _zeros(current, 4), outputs=2)


@_compiled
def _assign_credit(error, potential, neuron):
    decay, gain = neuron.decay(neuron.tau_s), neuron.gain(neuron.tau_s)
    tau = neuron.tau_rho * neuron.theta

    def step(t, traces):
        p, q = traces
        q = decay * (q + p)
        rho = neuron.scale_rho / tau * tf.exp(-tf.abs(potential[t] - neuron.theta) / tau)
        return (decay * p + error[t], q), (rho * (gain * q),)

    return scan(step, error, _zeros(error, 2), outputs=1, backwards=True)[0]


def _zeros(like, count):
    """Traces before the first step."""
    return tuple(tf.zeros_like(like[0]) for _ in range(count))


def spike_count_loss(response, potential, desired, neuron: SpikeResponse):
    """The spike count loss E = 1/2 sum over all t of e(t)^2 with e(t) = (count - desired)/T.

    Parameters
    ----------
    response, potential : tensors, shape (steps, samples, outputs)
        Outputs of :func:`fire` for the output layer.
    desired : tensor of float32, shape (samples, outputs)
        Desired spike counts.

    Returns
    -------
    scalar tensor
        Mean over the samples.  Its gradient with respect to ``response`` is e(t)/samples: the paper
        defines the error of the synaptic response, before credit is assigned over time.
    """
    steps = response.shape[0]
    error = tf.stop_gradient((spike_counts(potential, neuron) - desired) / steps)
    value = 0.5 * steps * tf.reduce_mean(tf.reduce_sum(error**2, -1))
    carrier = tf.reduce_mean(tf.reduce_sum(error * response, (0, 2)))
    return value + (carrier - tf.stop_gradient(carrier))


def spike_counts(potential, neuron: SpikeResponse):
    """Number of spikes over all steps, float32, shape (samples, ...)."""
    return tf.reduce_sum(tf.cast(potential >= neuron.theta, tf.float32), 0)


class SlayerNetwork(tf.Module):
    """A network of convolutions and dense layers with spike response neurons.

    Parameters
    ----------
    architecture : Architecture
        For example ``architecture.parse("10x10x2-6c2-24c3-10o")``.  Average pooling acts on the
        responses and has no neurons.
    neuron : SpikeResponse
    seed : int
        Seed of the initial weights, which are uniform in +-scale/sqrt(fan-in).
    conv_scale, dense_scale : float
        Scales of the initial weights.  They must be large enough for spikes to reach the output;
        without spikes there is no gradient.  The defaults are those of the authors' code.

    Attributes
    ----------
    kernels : list of Variable
        The kernel of each convolution, shape (k, k, input channels, filters), and of each dense
        layer, shape (inputs, units), the output last.
    """

    def __init__(
        self,
        architecture: Architecture,
        neuron: SpikeResponse | None = None,
        seed: int = 0,
        conv_scale: float = 100.0,
        dense_scale: float = 10.0,
    ):
        super().__init__()
        self.architecture, self.neuron = architecture, neuron or SpikeResponse()
        rng = np.random.default_rng(seed)

        def uniform(name, scale, shape):
            reach = scale / np.sqrt(np.prod(shape[:-1]))
            return tf.Variable(rng.uniform(-reach, reach, shape), dtype=tf.float32, name=name)

        self.kernels = []
        for name, shape in architecture.weight_shapes.items():
            layer, _, array = name.partition(".")
            if array == "kernel":
                scale = conv_scale if len(shape) == 4 else dense_scale
                self.kernels.append(uniform(layer, scale, shape))

    def __call__(self, events):
        """Run the network on events.

        Parameters
        ----------
        events : tensor, shape (samples, steps, rows, columns, channels)
            1 where there is an event in the step, 0 elsewhere; any type.

        Returns
        -------
        response, potential : tensors, shape (steps, samples, outputs)
            Outputs of :func:`fire` for the output layer.
        """
        *_, output = self.layers(events)
        return output

    def layers(self, events):
        """Response and potential of every layer with weights, in order.

        Returns
        -------
        list of (response, potential)
            Each of shape (steps, samples, rows, columns, filters) or (steps, samples, units).
        """
        spikes = tf.transpose(tf.cast(events, tf.float32), (1, 0, 2, 3, 4))
        response, results, kernels = spike_response(spikes, self.neuron), [], iter(self.kernels)
        for layer in self.architecture.layers:
            if layer.kind == "pool":
                response = _averaged(response, layer.size)
                continue
            results.append(fire(weighted_sums(layer, next(kernels), response), self.neuron))
            response = results[-1][0]
        return results


def _averaged(response, size):
    """Average pooling over square windows."""
    steps, samples = response.shape[0], tf.shape(response)[1]
    frames = tf.reshape(response, (-1, *response.shape[2:]))
    mean = tf.nn.avg_pool2d(frames, size, size, "VALID")
    return tf.reshape(mean, (steps, samples, *mean.shape[1:]))
