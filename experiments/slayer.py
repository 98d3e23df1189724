"""SLAYER: spike response neurons trained directly on events (paper, Section 3.2.3).

The equations and their sections in Shrestha and Orchard, "SLAYER: Spike Layer Error Reassignment in
Time" (NeurIPS 2018) are below.  Time t counts steps; ``*`` is convolution and ``(x)`` correlation
in time; l is the layer, W its weights (a convolution or a dense layer, without bias).

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

Both kernels are impulse responses of a second-order linear filter: with d = exp(-1/tau),

    p(t) = d p(t-1) + s(t),    q(t) = d (q(t-1) + p(t-1)),    (eps * s)(t) = e/tau q(t).

The filter and the weights are linear, so that weights are applied to spikes, and responses are
computed for a layer's neurons rather than for its inputs:  W (eps * s) = eps * (W s).
"""

import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.architecture import parse_architecture
from models.keras.keras2 import quiet_compiler, tf
from models.spiking.network import compute_weighted_sums
from models.spiking.neurons import scan
from pipeline.recordings.columns import EventColumns
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.spike_frames import make_spike_frames
from pipeline.training.events import Checkpoint, train_epochs

_compiled = functools.partial(tf.function, jit_compile=True, autograph=False)


@dataclass(frozen=True)
class Slayer:
    """The recipe of a training with SLAYER (paper, Section 3.2.3).

    What the paper does not state is as in the SLAYER authors' published example on N-MNIST, a
    similar data set, except the batch size: theirs is 12.

    Attributes
    ----------
    architecture : str
        Notation as for the CNN, with a channel for each polarity.  Average pooling acts on the
        spikes and has no neurons.
    bins : int
        Time steps that a recording is divided into; of two seconds, 10 ms each (paper).
    epochs : int
        Passes over the training samples.
    batch_size : int
        Samples per training step.
    learning_rate : float
        Of Adam with the AMSGrad variant.
    true_count, false_count : float
        Desired spikes of the correct class's output neuron and of each other one (paper).
    tau_s, tau_r : float
        Time constants of the spike response and of the refractory response, in time steps.
    scale_ref : float
        Depth of the refractory response in units of the threshold.
    theta : float
        Threshold.
    tau_rho : float
        Width of the escape rate in units of the threshold.
    scale_rho : float
        Integral of the escape rate on either side of the threshold.
    conv_scale, dense_scale : float
        Range of the initial weights of convolutions and dense layers, in units of 1/sqrt(inputs).
        A tenth of `conv_scale` gives a higher accuracy.
    """

    architecture: str = "10x10x2-6c2-24c3-10o"
    bins: int = 200
    epochs: int = 100
    batch_size: int = 32
    learning_rate: float = 0.01
    true_count: float = 60.0
    false_count: float = 10.0
    tau_s: float = 10.0
    tau_r: float = 1.0
    scale_ref: float = 2.0
    theta: float = 10.0
    tau_rho: float = 1.0
    scale_rho: float = 1.0
    conv_scale: float = 100.0
    dense_scale: float = 10.0


def _compute_filter(tau):
    """Decay per step, and factor of q, of a kernel of unit peak with a time constant in steps."""
    return float(np.exp(-1 / tau)), float(np.e / tau)


class SlayerNetwork:
    """A network of convolutions and dense layers with spike response neurons.

    Parameters
    ----------
    recipe : Slayer
    seed : int
        Seed of the initial weights, which are uniform.

    Attributes
    ----------
    architecture : Architecture
    kernels : list of tf.Variable
        The kernel of each convolution, shape (k, k, input channels, filters), and of each dense
        layer, shape (inputs, units), the output last.
    """

    def __init__(self, recipe: Slayer, seed: int = 0):
        quiet_compiler()
        self.recipe = recipe
        self.architecture = parse_architecture(recipe.architecture)
        rng = np.random.default_rng(seed)
        self.kernels = []
        for name, shape in self.architecture.weight_shapes.items():
            if name.endswith(".kernel"):
                scale = recipe.conv_scale if len(shape) == 4 else recipe.dense_scale
                reach = scale / np.sqrt(np.prod(shape[:-1]))
                self.kernels.append(tf.Variable(rng.uniform(-reach, reach, shape).astype("f4")))

    def compute_layers(self, frames) -> list:
        """Potentials and spikes of every layer with weights, in order.

        Parameters
        ----------
        frames : tensor, shape (steps, samples, rows, columns, channels)
            1 where there is an event in the step, 0 elsewhere; any type.

        Returns
        -------
        list of (potential, spikes)
            Each of shape (steps, samples, rows, columns, filters) or (steps, samples, units): u,
            including the refractory response, and 1 or 0.
        """
        signal = tf.cast(frames, tf.float32)
        layers = []
        kernels = iter(self.kernels)
        for layer in self.architecture.layers:
            if not layer.has_neurons:
                signal = _pool(signal, layer.size)
            else:
                layers.append(
                    fire(compute_weighted_sums(layer, next(kernels), signal), self.recipe)
                )
                signal = layers[-1][1]
        return layers

    def compute_gradients(self, frames, desired) -> tuple:
        """The spike count loss E = 1/2 sum over all t of e(t)^2, e(t) = (count - desired)/T.

        Parameters
        ----------
        frames : tensor, shape (steps, samples, rows, columns, channels)
            As in :meth:`compute_layers`.
        desired : tensor, shape (samples, outputs)
            Desired spike counts.

        Returns
        -------
        loss : tensor
            Mean over the samples.
        counts : tensor, shape (samples, outputs)
        gradients : list of tensor
            Of the loss with respect to each of `kernels`.
        """
        steps, samples = frames.shape[:2]
        decay, factor = _compute_filter(self.recipe.tau_s)
        t = np.arange(steps)
        # The correlation eps (x) 1 with the error, which is constant.
        constant = np.cumsum(factor * t * decay**t)[::-1].astype(np.float32)[:, None, None]
        with tf.GradientTape() as tape:
            spikes = self.compute_layers(frames)[-1][1]
            counts = tf.reduce_sum(spikes, 0)
            error = tf.stop_gradient(counts - desired) / steps
            credited = tf.reduce_sum(constant * error * spikes) / samples
        loss = 0.5 * steps * tf.reduce_sum(error**2) / samples
        return loss, counts, tape.gradient(credited, self.kernels)


def _pool(signal, size):
    """Means over windows that do not overlap, shape (steps, samples, rows, columns, channels)."""
    frames = tf.reshape(signal, (-1, *signal.shape[2:]))
    means = tf.nn.avg_pool2d(frames, size, size, "VALID")
    return tf.reshape(means, (*signal.shape[:2], *means.shape[1:]))


def fire(drive, recipe: Slayer) -> tuple:
    """Potential and spikes of neurons, with SLAYER's gradient of the spikes.

    Parameters
    ----------
    drive : tensor, shape (steps, ...)
        Weighted sums W s of the spikes that arrive.
    recipe : Slayer

    Returns
    -------
    potential, spikes : tensor, shape (steps, ...)
        u, and 1 or 0.
    """

    @tf.custom_gradient
    def spiking(drive):
        potential = _compute_potential(tf.stop_gradient(drive), recipe)
        spikes = tf.cast(potential >= recipe.theta, tf.float32)
        return (potential, spikes), lambda _, error: _credit(error, potential, recipe)

    return spiking(drive)


@_compiled
def _compute_potential(drive, recipe):
    decay, factor = _compute_filter(recipe.tau_s)
    after, back = _compute_filter(recipe.tau_r)
    back *= -recipe.scale_ref * recipe.theta

    def step(t, state):
        p, q, refractory_p, refractory_q = state
        q = decay * (q + p)
        refractory_q = after * (refractory_q + refractory_p)
        potential = factor * q + back * refractory_q
        spikes = tf.cast(potential >= recipe.theta, tf.float32)
        return (decay * p + drive[t], q, after * refractory_p + spikes, refractory_q), (potential,)

    (potential,) = scan(step, drive, (tf.zeros_like(drive[0]),) * 4, 1)
    return potential


@_compiled
def _credit(error, potential, recipe):
    """The gradient eps (x) (rho . error) of the drive, for that of the spikes, eps (x) e."""
    decay, factor = _compute_filter(recipe.tau_s)
    tau = recipe.tau_rho * recipe.theta
    delta = error * recipe.scale_rho / tau * tf.exp(-tf.abs(potential - recipe.theta) / tau)

    def step(t, state):
        p, q = state
        q = decay * (q + p)
        return (decay * p + delta[t], q), (factor * q,)

    (credit,) = scan(step, error, (tf.zeros_like(error[0]),) * 2, 1, backwards=True)
    return credit


@dataclass(frozen=True)
class SlayerSamples:
    """Samples of a training with SLAYER.

    Attributes
    ----------
    frames : ndarray of uint8, shape (bins, n_samples, rows, columns, 2)
        See :func:`bin_events`.
    labels : ndarray of int, shape (n_samples,)
    train, test : ndarray of int
        Indices of samples.
    """

    frames: np.ndarray
    labels: np.ndarray
    train: np.ndarray
    test: np.ndarray


def train_slayer(
    recipe: Slayer, samples: SlayerSamples, seed: int, checkpoint=None, advance=None
) -> tuple:
    """Train for all epochs, then evaluate the test samples.

    Parameters
    ----------
    recipe : Slayer
    samples : SlayerSamples
    seed : int
        Seed of the initial weights and of the order of the samples.
    checkpoint : Checkpoint, optional
        File for the state after each epoch; an interrupted training resumes from it.  Its key must
        identify all arguments but the number of epochs, which may differ.
    advance : callable, optional
        ``advance(1, note)`` after each epoch, including those of an earlier session.

    Returns
    -------
    network : SlayerNetwork
    history : list of dict
        One row per epoch: ``epoch``, ``loss``, ``accuracy`` (of the training samples during
        training), ``test_accuracy`` (for the history only), ``seconds``.
    counts : ndarray, shape (n_test, outputs)
        Spike counts of the test samples after the last epoch; the largest is the prediction.

    Raises
    ------
    UserError
        The checkpoint is damaged.
    """
    network = SlayerNetwork(recipe, seed)
    frames = samples.frames
    labels = samples.labels
    size = recipe.batch_size
    optimizer = tf.keras.optimizers.Adam(recipe.learning_rate, amsgrad=True)
    optimizer.build(network.kernels)
    is_label = np.eye(network.architecture.outputs, dtype=np.float32)[labels]
    desired = recipe.false_count + is_label * (recipe.true_count - recipe.false_count)

    @tf.function(autograph=False)
    def update(frames, desired):
        loss, counts, gradients = network.compute_gradients(frames, desired)
        optimizer.apply_gradients(zip(gradients, network.kernels, strict=True))
        return loss, counts

    counted = tf.function(
        lambda frames: tf.reduce_sum(network.compute_layers(frames)[-1][1], 0), autograph=False
    )

    def count(indices):
        batches = np.array_split(indices, -(-len(indices) // size))
        return np.concatenate([counted(tf.constant(frames[:, batch])) for batch in batches])

    def train_for(epoch):
        order = np.random.default_rng([seed, epoch, 0x51A]).permutation(samples.train)
        loss = 0.0
        right = 0
        for start in range(0, len(order), size):
            batch = order[start : start + size]
            of_batch, counts = update(tf.constant(frames[:, batch]), desired[batch])
            loss += float(of_batch) * len(batch)
            right += int(np.sum(np.argmax(counts, 1) == labels[batch]))
        return {"loss": loss / len(order), "accuracy": right / len(order)}

    def watch():
        right = count(samples.test).argmax(1) == labels[samples.test]
        return {"test_accuracy": float(np.mean(right))}

    variables = (*network.kernels, *optimizer.variables)
    state = {f"variable{i}": variable for i, variable in enumerate(variables)}
    history = train_epochs(train_for, recipe.epochs, state, checkpoint, watch, advance)
    return network, history, count(samples.test)


def bin_events(recordings: Recordings, bins: int = 200) -> np.ndarray:
    """Frames that mark the events of each polarity in each bin (paper, Section 3.2.3).

    The bins divide a recording's duration evenly: of two seconds, 200 bins are 10 ms each.
    Several events of one taxel and polarity in one bin count as one spike.  Events after the
    duration are left out.

    Parameters
    ----------
    recordings : Recordings
    bins : int

    Returns
    -------
    ndarray of uint8, shape (bins, n_samples, rows, columns, 2)
        1 or 0; polarities are first ON, then OFF.
    """
    events = recordings.events
    taxels = recordings.taxels
    sensor = recordings.sensor
    step = events.time_ns * (bins / (sensor.duration_s * 1e9))
    columns = EventColumns(
        sample=recordings.sample_of_event,
        time_ms=step,  # in steps, each of one unit
        row=taxels.row[events.taxel],
        column=taxels.column[events.taxel],
        polarity=(events.polarity < 0).astype(int),
    )
    return make_spike_frames(columns, 1.0, len(recordings), bins, (sensor.rows, sensor.columns))


def train_and_predict(dataset, index, seed: int, conv_scale: float, checkpoint: Path) -> tuple:
    """Train on the events of a data set, and predict the classes of some of its samples.

    Parameters
    ----------
    dataset : pipeline.recordings.dataset.Dataset
    index : ndarray of int
        Samples to predict.
    seed : int
    conv_scale : float
        See :class:`Slayer`.
    checkpoint : Path
        File for the state after each epoch, from which an interrupted training continues.

    Returns
    -------
    predictions : ndarray of int, shape (n,)
    history : list of dict
        See :func:`train_slayer`.
    """
    recordings = dataset.recordings
    sensor = dataset.recordings.sensor
    layers = Slayer().architecture.split("-")[1:-1]
    size = f"{sensor.rows}x{sensor.columns}x2"
    architecture = "-".join([size, *layers, f"{len(sensor.classes)}o"])
    recipe = Slayer(architecture=architecture, conv_scale=conv_scale)
    key = hashlib.sha256(f"{recipe} {seed} {dataset.origin.key}".encode()).hexdigest()
    samples = SlayerSamples(
        bin_events(recordings, recipe.bins), recordings.labels, dataset.split.train, index
    )
    state = Checkpoint(checkpoint, key)
    _, history, counts = train_slayer(recipe, samples, seed, state)
    return counts.argmax(1), history
