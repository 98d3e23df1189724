"""A spiking network on events in TensorFlow; the equations are in :mod:`models.spiking`."""

from dataclasses import dataclass

import numpy as np

from deploy.network.chip import LOIHI
from models.architecture import Architecture
from models.integers import Integers
from models.keras.keras2 import quiet_compiler, tf
from models.quantised import find_weight_scale, pass_gradient_through
from models.spiking.neurons import find_length, fire

# Smallest share of current and voltage that remains after a step.
MIN_KEEP_4096THS = 2

# Largest voltage that a bias alone may cause, as a share of the threshold.
BIAS_CAP = 0.9

# Ratio of the output's kernel to its trained variable, which makes the learning steps of the output
# smaller than those of the other layers.
OUTPUT_SCALE = 0.2


@dataclass(frozen=True)
class Neuron:
    """Neuron parameters: the constants of all layers, and the initial time constants.

    Attributes
    ----------
    tau_u, tau_v : tuple of float
        Initial time constants of current and voltage in steps, one per layer; the last entry also
        applies to all later layers.
    floor : float
        Lower voltage bound in units of the threshold; rounded to a power of two in the chip's
        integers.
    beta : float
        Steepness of the surrogate gradient; larger is narrower.
    """

    tau_u: tuple = (1.5,)
    tau_v: tuple = (4.0,)
    floor: float = -2.0
    beta: float = 4.0

    def __post_init__(self):
        if min(*self.tau_u, *self.tau_v, self.beta) <= 0 or self.floor > 0:
            raise ValueError("Neuron: time constants and beta must be above 0, the floor at most 0")


class SpikingNetwork(tf.Module):
    """A network of convolutions and dense layers with current-based neurons, and a linear output.

    Parameters
    ----------
    architecture : Architecture
        Without pooling, with at least one layer before the output.
    neuron : Neuron
    seed : int
        Seed of the initial weights, which are normal with a variance of one over the fan-in.
    section_starts : tuple of int
        First step of each section of a sample, which has output weights of its own.

    Raises
    ------
    ValueError
        The architecture has pooling, or no layer with neurons.
    """

    def __init__(
        self,
        architecture: Architecture,
        neuron: Neuron | None = None,
        seed: int = 0,
        section_starts: tuple = (0,),
    ):
        super().__init__()
        quiet_compiler()
        self.architecture = architecture
        self.neuron = neuron or Neuron()
        self.section_starts = tuple(section_starts)
        if not all(layer.has_neurons for layer in architecture.layers):
            raise ValueError(f"{architecture}: spikes are not pooled; use a stride")
        if len(architecture.layers) < 2:
            raise ValueError(f"{architecture}: there is no layer of neurons before the output")
        self.names = architecture.names[:-1]
        rng = np.random.default_rng(seed)
        self.variables_by_name: dict[str, tf.Variable] = {}
        layers = zip(architecture.names, architecture.layers, architecture.shapes, strict=False)
        for index, (name, layer, input_shape) in enumerate(layers):
            shapes = layer.list_array_shapes(input_shape)
            scale = 1 / np.sqrt(layer.count_fan_in(input_shape))
            kernel = rng.normal(0, scale, shapes["kernel"])
            if name == "output":
                self._add("output.kernel", np.tile(kernel, (len(self.section_starts), 1)))
                continue
            self._add(f"{name}.kernel", kernel)
            self._add(f"{name}.bias", np.zeros(shapes["bias"]))
            for tau in ("tau_u", "tau_v"):
                values = getattr(self.neuron, tau)
                self._add(f"{name}.{tau}", _compute_logit(values[min(index, len(values) - 1)]))

    def _add(self, name, value):
        variable = tf.Variable(np.asarray(value, np.float32), name=name.replace(".", "_"))
        self.variables_by_name[name] = variable

    @property
    def variables_in_order(self) -> list:
        """The trained variables in a fixed order."""
        return list(self.variables_by_name.values())

    def get_weights(self) -> dict:
        """Trained arrays by name: ``"conv1.kernel"``, ``.bias``, ``.tau_u`` and ``.tau_v`` (steps).

        The output's kernel holds the contribution of a spike to each output, in the first section
        of the sample, then in the second, and so on: its shape is (sections * neurons, outputs).
        Kernels and biases of neurons are in units of their threshold.
        """
        return self.name_arrays(variable.numpy() for variable in self.variables_in_order)

    def name_arrays(self, arrays) -> dict:
        """The arrays of :func:`get_weights` for other values of the variables, in their order."""
        weights = {}
        for name, value in zip(self.variables_by_name, arrays, strict=True):
            tau = name.endswith((".tau_u", ".tau_v"))
            weights[name] = _compute_steps(value) if tau else np.array(value)
            if name == "output.kernel":
                weights[name] = weights[name] * OUTPUT_SCALE
        return weights

    def set_weights(self, weights: dict):
        """Assign the arrays that :func:`get_weights` returned.

        Raises
        ------
        ValueError
            An array is missing or has the wrong shape.
        """
        for name, variable in self.variables_by_name.items():
            if name not in weights or np.shape(weights[name]) != tuple(variable.shape):
                raise ValueError(f"no array {name!r} of shape {tuple(variable.shape)}")
            value = np.asarray(weights[name], np.float32)
            if name.endswith((".tau_u", ".tau_v")):
                value = _compute_logit(value)
            variable.assign(value / OUTPUT_SCALE if name == "output.kernel" else value)

    def __call__(self, frames, dropout_factors=None, dtype=tf.float32, values=None):
        """Run the network on event frames from its resting state (no current).

        Parameters
        ----------
        frames : tensor, shape (steps, samples, rows, columns, channels)
            1 where there is a spike, 0 elsewhere; any type.
        dropout_factors : list of tensor, optional
            Dropout: for each layer the factors that multiply its spikes before the next layer,
            of a shape that broadcasts to (samples, neurons).
        dtype : tf.DType
            float64 computes the chip's integers exactly; float32 may be off by one unit where the
            product of a current or voltage and its decay exceeds 24 bits.
        values : dict of str to tensor, optional
            Used instead of the variables.

        Returns
        -------
        outputs : tensor, shape (steps, samples, outputs)
            y(t) at every step.
        spikes : list of tensor, shape (steps, samples, neurons)
            The spikes of each layer, 0 or 1.
        """
        values = self.variables_by_name if values is None else values
        steps, samples = tf.unstack(tf.shape(frames)[:2])  # one trace for any number
        signal = tf.cast(frames, dtype)
        spikes = []
        layers = zip(self.names, self.architecture.layers, self.architecture.shapes, strict=False)
        for index, (name, layer, before) in enumerate(layers):
            parameters = self._round_to_chip(name, values, dtype)
            current = compute_weighted_sums(layer, parameters["kernel"], signal)
            current = tf.reshape(current, (steps, samples, self.architecture.n_values[name]))
            parameters = _repeat_bias(parameters, current.shape[2])
            spikes.append(fire(current, parameters, self.neuron.beta))
            signal = spikes[-1]
            if dropout_factors is not None:
                signal = signal * dropout_factors[index]
            signal = tf.reshape(signal, (steps, samples, *layer.compute_shape(before)))
        kernel = tf.cast(values["output.kernel"], dtype) * OUTPUT_SCALE
        kernels = tf.split(kernel, len(self.section_starts))
        ends = (*self.section_starts[1:], None)
        added = []
        for first, end, section_kernel in zip(self.section_starts, ends, kernels, strict=True):
            section = tf.reshape(signal[first:end], (-1, section_kernel.shape[0]))
            added.append(tf.matmul(section, section_kernel))
        added = tf.reshape(tf.concat(added, 0), (steps, samples, kernel.shape[1]))
        return tf.cumsum(added), spikes

    def _round_to_chip(self, name, values, dtype):
        """The chip's integers as tensors, with gradients to the trained variables."""
        kernel, bias, tau_u, tau_v = (
            tf.cast(values[f"{name}.{array}"], dtype)
            for array in ("kernel", "bias", "tau_u", "tau_v")
        )
        scale = find_weight_scale(kernel)
        unit = LOIHI.threshold_unit
        threshold = unit * tf.round(LOIHI.weight_unit / unit / scale)
        threshold = tf.clip_by_value(threshold, unit, LOIHI.max_threshold)
        keep_u_4096ths, keep_v_4096ths = (
            tf.clip_by_value(
                pass_gradient_through(tf.round, LOIHI.decay_unit * tf.sigmoid(tau)),
                MIN_KEEP_4096THS,
                LOIHI.decay_levels,
            )
            for tau in (tau_u, tau_v)
        )
        cap = tf.stop_gradient(BIAS_CAP * (1 - keep_v_4096ths / LOIHI.decay_unit))
        capped = bias + tf.stop_gradient(tf.minimum(bias, cap) - bias)
        return {
            "kernel": LOIHI.weight_unit * pass_gradient_through(tf.round, kernel / scale),
            "bias": pass_gradient_through(_round_to_twelve_bits, capped * threshold),
            "threshold": threshold,
            "floor": -_round_to_power_of_two(1 - self.neuron.floor * threshold) + 1,
            "keep_u_4096ths": keep_u_4096ths,
            "keep_v_4096ths": keep_v_4096ths,
        }

    def compute_integers(self) -> dict:
        """The integers of each layer on the chip, by name.

        Returns
        -------
        dict of str to Integers
        """
        layers = {}
        for name in self.names:
            chip = self._round_to_chip(name, self.variables_by_name, tf.float64)
            kernel = np.rint(chip["kernel"].numpy() / LOIHI.weight_unit).astype(np.int32)
            layers[name] = Integers(
                kernel=kernel,
                bias=chip["bias"].numpy().astype(np.int32),
                threshold=int(chip["threshold"].numpy()),
                floor=int(chip["floor"].numpy()),
                keep_u_4096ths=int(chip["keep_u_4096ths"].numpy()),
                keep_v_4096ths=int(chip["keep_v_4096ths"].numpy()),
            )
        return layers


def compute_weighted_sums(layer, kernel, signal):
    """Weighted sums of a layer's inputs, for all steps of all samples at once.

    Parameters
    ----------
    layer : layer of a :class:`models.architecture.Architecture`
        Any of its operations.
    kernel : tensor
        Shape (rows, columns, channels in, filters), or (inputs, units).
    signal : tensor, shape (steps, samples, ...)
        For a convolution: (steps, samples, rows, columns, channels).

    Returns
    -------
    tensor, shape (steps, samples, ...)
    """
    steps = find_length(signal, 0)
    samples = find_length(signal, 1)
    sums = layer.compute_tensor_sums(kernel, tf.reshape(signal, (-1, *signal.shape[2:])))
    return tf.reshape(sums, (steps, samples, *sums.shape[1:]))


def count_operations(architecture: Architecture, frames, spikes):
    """Synaptic operations of each sample by the receiving layer; differentiable.

    A spike counts once for each synapse that it reaches, as in
    ``NetworkSpec.count_synaptic_operations``.

    Parameters
    ----------
    architecture : Architecture
    frames : tensor, shape (steps, samples, rows, columns, channels)
    spikes : list of tensor, shape (steps, samples, neurons)

    Returns
    -------
    tensor of float32, shape (samples, layers)
        The last layer is the output.
    """
    totals = [tf.reduce_sum(tf.cast(sender, tf.float32), 0) for sender in (frames, *spikes)]
    return tf.stack(
        [
            tf.linalg.matvec(tf.reshape(total, (-1, fan_out.size)), fan_out.ravel().astype("f4"))
            for total, fan_out in zip(totals, architecture.fan_out.values(), strict=True)
        ],
        axis=1,
    )


def _repeat_bias(parameters, neurons):
    """The parameters with the bias repeated from channels to neurons."""
    bias = parameters["bias"]
    return {**parameters, "bias": tf.tile(bias, [neurons // bias.shape[0]])}


def _round_to_twelve_bits(bias):
    """Round to 12 bits times the smallest sufficient power of two, at most 2^7."""
    mantissa = LOIHI.max_bias_mantissa
    size = tf.abs(bias)[..., None] / mantissa
    limits = tf.constant(2.0 ** np.arange(LOIHI.bias_exponents - 1), bias.dtype)
    exponent = tf.reduce_sum(tf.cast(size > limits, bias.dtype), -1)
    unit = tf.pow(tf.constant(2, bias.dtype), exponent)
    return tf.round(tf.clip_by_value(bias / unit, -mantissa, mantissa)) * unit


def _round_to_power_of_two(x):
    """The power of two closest to x by ratio; computed without a float32 logarithm to be exact."""
    powers = np.arange(25)
    limits = 2.0 ** (powers - 0.5)
    rises = 2.0 ** np.maximum(powers - 1, 0)
    passed = tf.cast(x[..., None] > tf.constant(limits, x.dtype), x.dtype)
    return tf.reduce_sum(passed * tf.constant(rises, x.dtype), -1)


def _compute_logit(tau_steps):
    """The trained variable of a time constant: decay = sigmoid(logit) = exp(-1 / tau_steps)."""
    return -np.log(np.expm1(1 / np.asarray(tau_steps, np.float64)))


def _compute_steps(logit):
    """Time constant in steps: the inverse of `_compute_logit`."""
    return 1 / np.log1p(np.exp(-np.asarray(logit, np.float64)))
