"""Keras models of the networks of :mod:`models.architecture`, with ReLUs or rate-LIF neurons.

The forward pass of their layers may use weights quantised as on a chip (:mod:`models.quantised`).

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

import numpy as np

from deploy.network.chip import LOIHI, Chip
from models.architecture import Architecture
from models.keras.keras2 import as_written, tf

# Lower bound for the excess over the threshold, which keeps the logarithm finite.
MIN_EXCESS = 1e-12


def round_time_constants(tau_rc: float, tau_ref: float, chip: Chip = LOIHI):
    """Time constants in seconds on a chip: a rounded decay, a refractory period in whole steps."""
    decay = np.round(-np.expm1(-chip.dt / tau_rc) * chip.decay_levels) / chip.decay_levels
    return -chip.dt / np.log1p(-decay), chip.dt * np.round(tau_ref / chip.dt)


def find_gain(max_rate: float, tau_rc: float, tau_ref: float) -> float:
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
        :func:`call_with_noise`.
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

    def __init__(  # noqa: PLR0913 - Keras stores a layer's parameters one by one
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
        self.gain = find_gain(max_rate, tau_rc, tau_ref)
        self.noise = noise
        self.dropout = dropout
        self.spike_costs = spike_costs
        self.smoothing = smoothing
        self.tau_rc = tau_rc
        self.shortest_interval = tau_ref
        if on_chip:
            self.tau_rc, refractory = round_time_constants(tau_rc, tau_ref)
            self.shortest_interval = refractory + LOIHI.dt / 2

    def call(self, inputs, training=None):
        """Rates relative to ``max_rate``; in training the spike penalty is added to the loss."""
        rates = self.compute_rates(inputs)
        if training and self.spike_costs is not None:
            self.add_loss(tf.reduce_mean(self.compute_cost(rates)))
        return rates

    @as_written
    def compute_rates(self, inputs):
        """Rates relative to ``max_rate``, with the gradient of the smoothed rate.

        With the smoothed excess x = smoothing * softplus(gain z / smoothing) and the interval
        T(x) = shortest_interval + tau_rc log(1 + 1/x), the smoothed rate 1 / (T(x) max_rate) has

            d rate / dz = gain sigmoid(gain z / smoothing) tau_rc / (x (x + 1) T(x)^2 max_rate).

        The gradient is explicit because TensorFlow's automatic differentiation would compute the
        smoothed rate in the forward pass too, where it is not needed.
        """

        @tf.custom_gradient
        def rates(z):
            exact = tf.where(
                z > 0, 1 / (self._compute_interval(self.gain * z) * self.max_rate), 0.0
            )

            def gradient(upstream):
                scaled = self.gain * z / self.smoothing
                excess = tf.maximum(self.smoothing * tf.math.softplus(scaled), MIN_EXCESS)
                steepness = self.gain * self.tau_rc / self.max_rate * tf.sigmoid(scaled)
                interval = self._compute_interval(excess)
                return upstream * steepness / (excess * (excess + 1) * tf.square(interval))

            return exact, gradient

        return rates(inputs)

    @as_written
    def compute_cost(self, rates):
        """Spike penalty of each sample; the last dimensions of ``rates`` match ``spike_costs``."""
        dimensions = len(self.spike_costs.shape)
        return tf.reduce_sum(rates * self.spike_costs, axis=tuple(range(-dimensions, 0)))

    def _compute_interval(self, excess):
        """Interspike interval in seconds at a current ``excess`` above the threshold."""
        rise = tf.math.log1p(1 / tf.maximum(excess, MIN_EXCESS))
        return self.shortest_interval + self.tau_rc * rise


def build_cnn(architecture: Architecture, activation=None, gain=None) -> tf.keras.Model:
    """Build the Keras model of an architecture; its outputs are logits (the loss has the softmax).

    Parameters
    ----------
    architecture : Architecture
    activation : callable, optional
        ``activation(index)`` returns the activation layer of layer ``index``, counted from 0 over
        the convolutions and hidden dense layers.  Default: ReLU.
    gain : callable, optional
        ``gain(index)`` returns the gain of that layer's neurons; the layers then have the chip's
        quantised weights (:mod:`models.quantised`).  Default: weights in floating point.

    Returns
    -------
    tf.keras.Model
        Input (n, rows, columns, channels), output (n, outputs).  Layers are named ``conv1``,
        ``conv1_neurons``, ``pool1``, ``dense1``, ..., ``output``.

    Raises
    ------
    ValueError
        The Keras layer of an operation has variables of other names than the arrays that the
        operation declares.
    """
    activation = activation or (lambda index: tf.keras.layers.ReLU())
    signal = inputs = tf.keras.Input(architecture.input_shape, name="image")
    index = 0
    for name, layer in zip(architecture.names, architecture.layers, strict=True):
        if not layer.is_spatial and len(signal.shape) > 2:
            signal = tf.keras.layers.Flatten(name="flatten")(signal)
        has_neurons = layer.has_neurons and not layer.is_output
        signal = layer.make_keras_layer(name, gain(index) if gain and has_neurons else None)(signal)
        if has_neurons:
            neurons = activation(index)
            neurons._name = f"{name}_neurons"
            signal = neurons(signal)
            index += 1
    model = tf.keras.Model(inputs, signal)
    _require_declared_arrays(model, architecture)
    return model


def _require_declared_arrays(model, architecture):
    """Refuse a Keras layer that names its variables otherwise than its operation does."""
    declared = set(architecture.weight_shapes)
    present = set(_name_variables(model))
    if present != declared:
        raise ValueError(
            f"{architecture}: the Keras layers have the variables "
            f"{', '.join(sorted(present - declared)) or 'no others'}, where the operations declare "
            f"{', '.join(sorted(declared - present)) or 'no others'} in 'list_array_shapes'; "
            "name the variables in 'Operation.make_keras_layer' as the arrays"
        )


def _name_variables(model) -> dict:
    """The trained variables of a model by ``<layer>.<variable>``, such as ``conv1.kernel``."""
    return {
        f"{layer.name}.{variable.name.split('/')[-1].split(':')[0]}": variable
        for layer in model.layers
        for variable in layer.trainable_weights
    }


def get_weights(model: tf.keras.Model) -> dict:
    """Trained arrays by name, ``<layer>.kernel`` and ``<layer>.bias``."""
    return {name: variable.numpy() for name, variable in _name_variables(model).items()}


def set_weights(model: tf.keras.Model, weights: dict):
    """Assign the arrays that :func:`get_weights` returned.

    Raises
    ------
    ValueError
        An array is missing or has the wrong shape.
    """
    for name, variable in _name_variables(model).items():
        if name not in weights or np.shape(weights[name]) != tuple(variable.shape):
            raise ValueError(f"no array {name!r} of shape {tuple(variable.shape)}")
        variable.assign(weights[name])


def make_relu(noise: float = 0.0, dropout: float = 0.0) -> tf.keras.layers.Layer:
    """A layer of ReLUs with the noise and the dropout of :func:`call_with_noise`."""
    layer = tf.keras.layers.ReLU()
    layer.noise = noise
    layer.dropout = dropout
    return layer


def call_with_noise(model: tf.keras.Model, images, noise, masks=()):
    """Call the network in training mode, with noise on the input of its neurons, and dropout.

    Parameters
    ----------
    model : tf.keras.Model
        A model that :func:`build_cnn` has returned.
    images : tensor, shape (n_samples, rows, columns, channels)
    noise : sequence of tensors
        One for each layer of :func:`list_noisy_layers`, shape (n_samples, \\*shape of its input);
        it is added.
    masks : sequence of tensors
        One for each layer of :func:`list_dropped_layers`, of the same shape; the output is
        multiplied.

    Returns
    -------
    tensor, shape (n_samples, outputs)
        Logits.
    """
    added = dict(zip(list_noisy_layers(model), noise, strict=True))
    dropped = dict(zip(list_dropped_layers(model), masks, strict=True))
    signal = images
    for layer in model.layers[1:]:  # the first is the input layer
        if layer in added:
            signal = signal + added[layer]
        signal = layer(signal, training=True)
        if layer in dropped:
            signal = signal * dropped[layer]
    return signal


def list_noisy_layers(model: tf.keras.Model) -> list:
    """The activation layers whose input is noisy during training."""
    return [layer for layer in model.layers if getattr(layer, "noise", 0)]


def list_dropped_layers(model: tf.keras.Model) -> list:
    """The activation layers whose output has dropout during training."""
    return [layer for layer in model.layers if getattr(layer, "dropout", 0)]


def compute_logits(model: tf.keras.Model, images) -> np.ndarray:
    """Logits of images (n_samples, rows, columns, channels), shape (n_samples, outputs)."""
    return np.concatenate([model(batch, training=False) for batch in _split_into_batches(images)])


def compute_activations(model: tf.keras.Model, images) -> dict:
    """Outputs of the neurons of each layer, by the layer's name.

    Returns
    -------
    dict of str to ndarray, shape (n_samples, n_neurons)
        ``"conv1"``, ..., ``"dense1"``, ...; neurons in the order (row, column, channel).
    """
    ending = "_neurons"
    layers = [layer for layer in model.layers if layer.name.endswith(ending)]
    probe = tf.keras.Model(model.input, {layer.name: layer.output for layer in layers})
    by_batch = [probe(batch, training=False) for batch in _split_into_batches(images)]
    outputs = {}
    for layer in layers:
        values = np.concatenate([batch[layer.name] for batch in by_batch])
        outputs[layer.name.removesuffix(ending)] = values.reshape(len(images), -1)
    return outputs


def _split_into_batches(images):
    """Split images into batches of 512.

    Calling the model on them is faster than Keras's ``predict``, which traces a graph for one use.
    """
    starts = range(0, max(len(images), 1), 512)
    return (np.asarray(images[start : start + 512], np.float32) for start in starts)
