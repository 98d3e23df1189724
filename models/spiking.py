"""The deployed network as Keras sees it: spikes in time, with a surrogate for their gradient.

The forward pass follows Loihi's neurons step by step.  With the weighted input ``c[t]`` of a layer
(spikes of the layer before, one step late), the synapse's decay ``a = exp(-dt / tau_s)`` and the
membrane's ``d = 1 - exp(-dt / tau_rc)``, both rounded to 12 bits,

    u[t] = a * u[t-1] + (1 - a) * c[t]
    v[t] = v[t-1] + d * (1 + gain * (u[t] + b) - v[t-1])      outside the refractory period
    s[t] = 1 if v[t] > 1, which sets v[t] to 0

A layer's spikes over all steps are known before the next layer's are needed, so the convolutions
run over all steps at once and only the membranes go step by step.

The backward pass takes for ds/dv the fast sigmoid's slope ``1 / (1 + k |v - 1|)^2`` (Zenke and
Ganguli 2018, eq. 3.3) and does not go through the reset.
"""

from __future__ import annotations

import numpy as np
import tensorflow as tf

from models.lif import DECAY_LEVELS, DT, gain_for
from models.notation import Architecture
from models.quantised import eight_bits

SLOPE = 5.0
"""k of the surrogate gradient."""


@tf.custom_gradient
def spike(excess):
    """1 where ``v - 1`` is above 0, with the surrogate's gradient."""

    def gradient(upstream):
        return upstream / tf.square(1 + SLOPE * tf.abs(excess))

    return tf.cast(excess > 0, excess.dtype), gradient


def encode(images, steps: int, rate: float, phase: float) -> np.ndarray:
    """Spikes of the input layer: evenly spaced, ``rate * v`` a second for a pixel of value v.

    Parameters
    ----------
    images : ndarray, shape (n, rows, columns, channels)
        Values from 0; at most one spike a step.
    steps : int
    rate : float
        Spikes a second at value 1.
    phase : float
        Of a spike, done at the start.

    Returns
    -------
    ndarray of float32, shape (n, steps, rows, columns, channels)
    """
    charge = np.maximum(np.asarray(images, np.float64), 0)[:, None] * (rate * DT)
    time = np.arange(steps + 1).reshape(1, -1, 1, 1, 1)
    return np.diff(np.floor(phase + charge * time), axis=1).clip(0, 1).astype(np.float32)


def decay_of(tau: float) -> float:
    """Decay a step, ``exp(-dt / tau)``, as the 12 bits of a compartment hold it."""
    return 1 - round(-np.expm1(-DT / tau) * DECAY_LEVELS) / DECAY_LEVELS if tau else 0.0


class SpikingNetwork(tf.keras.Model):
    """Convolutions with Loihi's LIF neurons and a linear readout of their spikes.

    Parameters
    ----------
    architecture : Architecture
    max_rates : sequence of float
        Spikes a second of each convolution's neurons at activation 1.
    tau_rc, tau_ref, synapse : float
        Membrane time constant, refractory period and synaptic time constant in seconds.

    Attributes
    ----------
    weights_of : dict of str to tf.Variable
        By the names of :func:`models.cnn.get_weights`.
    """

    def __init__(
        self, architecture: Architecture, max_rates, tau_rc=0.02, tau_ref=0.001, synapse=0.005
    ):
        super().__init__()
        self.architecture = architecture
        self.max_rates = tuple(max_rates)
        self.gains = [gain_for(rate, tau_rc, tau_ref) for rate in max_rates]
        self.leak = 1 - decay_of(tau_rc)
        self.dead_steps = round(tau_ref / DT)
        self.synapse_decay = decay_of(synapse)
        self.weights_of = {}
        channels = [shape[-1] for shape in architecture.shapes]
        for index, conv in enumerate(architecture.convs):
            shape = (conv.kernel, conv.kernel, channels[index], conv.filters)
            self._make(f"conv{index + 1}", shape)
        self._make("output", (int(np.prod(architecture.shapes[-1])), architecture.outputs))

    def _make(self, name, shape):
        for part, size in (("kernel", shape), ("bias", shape[-1:])):
            self.weights_of[f"{name}.{part}"] = self.add_weight(name=f"{name}.{part}", shape=size)

    def call(self, spikes):
        """Run from a fresh state.

        Parameters
        ----------
        spikes : tensor, shape (n, steps, rows, columns, channels)
            Of the input layer, 0 or 1, divided by their rate times dt.

        Returns
        -------
        logits : tensor, shape (n, steps, outputs)
            The readout at each step, not yet averaged over time.
        layers : list of tensor, shape (n, steps, rows, columns, filters)
            Spikes of each convolution, 0 or 1.
        """
        signal, layers = spikes, []
        for index, rate in enumerate(self.max_rates):
            name = f"conv{index + 1}"
            signal = self._convolve(signal, eight_bits(self.weights_of[f"{name}.kernel"]))
            drive = self._filter(signal)
            gain = self.gains[index]
            current = 1 + gain * (drive + self.weights_of[f"{name}.bias"])
            layers.append(self._membranes(current))
            signal = layers[-1] / (rate * DT)
        flat = tf.reshape(signal, (tf.shape(signal)[0], tf.shape(signal)[1], -1))
        logits = flat @ self.weights_of["output.kernel"] + self.weights_of["output.bias"]
        return logits, layers

    def _convolve(self, signal, kernel):
        shape = tf.shape(signal)
        merged = tf.reshape(signal, (-1, *signal.shape[2:]))
        result = tf.nn.conv2d(merged, kernel, strides=1, padding="VALID")
        return tf.reshape(result, (shape[0], shape[1], *result.shape[1:]))

    def _filter(self, signal):
        a = self.synapse_decay
        steps = tf.unstack(signal, axis=1)
        state, outputs = tf.zeros_like(steps[0]), []
        for arriving in [state, *steps[:-1]]:  # one step late
            state = a * state + (1 - a) * arriving
            outputs.append(state)
        return tf.stack(outputs, axis=1)

    def _membranes(self, current):
        steps = tf.unstack(current, axis=1)
        voltage = tf.zeros_like(steps[0])
        recent = [voltage] * self.dead_steps
        outputs = []
        for drive in steps:
            ready = 1.0
            for fired in recent:
                ready = ready * (1 - fired)
            voltage = voltage + self.leak * ready * (drive - voltage)
            fired = spike(voltage - 1)
            outputs.append(fired)
            held = tf.stop_gradient(fired)
            voltage = voltage * (1 - held)
            recent = [*recent[1:], held] if self.dead_steps else []
        return tf.stack(outputs, axis=1)
