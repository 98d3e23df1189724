"""Train the paper's CNN, and the same network with rate-LIF neurons."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from deploy.arithmetic import thin
from deploy.errors import UserError
from deploy.network.chip import DT
from models.architecture import Architecture, parse
from models.chain import make_links
from models.cnn import (
    RateLIF,
    build_cnn,
    call_with_noise,
    compute_activations,
    find_gain,
    get_weights,
    list_dropped_layers,
    list_noisy_layers,
    make_relu,
    predict,
    set_weights,
)
from models.keras.keras2 import as_written, tf
from pipeline.recordings.images import ALTERED_AT_ONCE
from pipeline.settings import Settings
from pipeline.training.schedules import (
    TrainingSchedule,
    make_cnn_schedule,
    make_snn_schedule,
)

# Quantile of a layer's activations that is scaled to 1 when a CNN's weights are reused.
PERCENTILE = 99.9


# Candidate threshold shifts for weights that are reused without training.
SHIFTS = tuple(np.arange(0, 1.01, 0.02).tolist())

# Maximum number of noise values, of 4 bytes each, drawn in advance.
NOISE_AHEAD = 1 << 23

# Maximum number of values of images that are computed in advance.
IMAGES_AHEAD = 1 << 24

# Maximum number of training samples on which the activations of the layers are measured.
MAX_MEASURED_SAMPLES = 1 << 14

# Maximum number of these activations, of 4 bytes each: large networks are measured on fewer
# samples. Networks such as the paper's, of some thousand neurons, have fewer on all samples.
MAX_MEASURED_ACTIVATIONS = 1 << 26

# Number of steps whose synaptic operations ``snn.spike_penalty`` penalises. It is independent of
# the presentation, so that the same weights can be used with any number of steps.
PRICED_STEPS = 100


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network, with methods to run it.

    Attributes
    ----------
    settings : Settings
        The settings of the training.
    weights : dict of str to ndarray
        See :func:`models.cnn.get_weights`.
    history : list of dict
        One row per epoch: ``epoch``, ``loss``, ``accuracy``, and ``val_loss`` and ``val_accuracy``
        if there are validation samples; empty if the network was loaded.
    """

    settings: Settings
    weights: dict
    history: list = field(default_factory=list)

    def compute_logits(self, inputs) -> np.ndarray:
        """Logits, shape (n_samples, classes)."""
        return predict(self._model, inputs)

    def compute_activations(self, inputs) -> dict:
        """Outputs of the neurons of each layer, shape (n_samples, n_neurons), by the layer."""
        return compute_activations(self._model, inputs)

    @functools.cached_property
    def _model(self):
        model = self.build(self.settings)
        set_weights(model, self.weights)
        return model


class TrainedCNN(TrainedNetwork):
    """The paper's CNN; its activations are the outputs of ReLUs."""

    @staticmethod
    def build(settings: Settings) -> tf.keras.Model:
        """Build the network without its trained weights."""
        return build_cnn(parse(settings.cnn.architecture))


class TrainedRates(TrainedNetwork):
    """The network with rate-LIF neurons; an activation of 1 means ``max_rate``."""

    @staticmethod
    def build(settings: Settings) -> tf.keras.Model:
        """Build the network without its trained weights."""
        return build_rate_network(settings)


@dataclass(frozen=True)
class TrainingSamples:
    """What a network on images is trained on.

    Attributes
    ----------
    images : ndarray, shape (n_samples, rows, columns, channels)
    labels : ndarray of int, shape (n_samples,)
    altered : callable, optional
        ``altered(rng, indices)`` returns the images of some samples for an epoch, such as
        :meth:`pipeline.recordings.dataset.Dataset.make_altered_images`.  Default: the images
        themselves, whatever ``cnn.augment`` is.
    validation : (images, labels), optional
        Samples that are evaluated for the history only.
    """

    images: np.ndarray
    labels: np.ndarray
    altered: Callable | None = None
    validation: tuple | None = None

    def __len__(self):
        return len(self.labels)


def train_cnn(
    settings: Settings, samples: TrainingSamples, seed: int, advance=None, weights=None
) -> TrainedCNN:
    """Train the paper's CNN (Section 3.2.1).

    Parameters
    ----------
    settings : Settings
    samples : TrainingSamples
    seed : int
        The weights are reproducible on the same kind of processor, for any number of cores, if
        TensorFlow has computed nothing in this process before.
    advance : callable, optional
        ``advance(1, note)`` after each epoch.
    weights : dict, optional
        Weights at the beginning.  Default: new ones.

    Returns
    -------
    TrainedCNN
    """
    model = build_new_cnn(settings, seed)
    if weights is not None:
        set_weights(model, weights)
    schedule = make_cnn_schedule(settings.cnn, len(samples))
    history = fit(model, schedule, samples, seed, advance)
    return TrainedCNN(settings, get_weights(model), history)


def train_matched(
    settings: Settings, samples: TrainingSamples, seed: int, cnn_weights, advance=None
) -> TrainedCNN:
    """Train the paper's CNN further, as :func:`train_rate_network` trains the spiking network.

    Both start from the same weights and have the same epochs, annealing, noise, dropout and
    altered images, so that what their accuracies differ by is due to the neurons and the chip's
    weights.

    Parameters
    ----------
    settings, samples, seed, cnn_weights, advance
        As in :func:`train_rate_network`, with ``snn.recipe = "loihi"``.

    Returns
    -------
    TrainedCNN
    """
    make_deterministic(seed)
    snn = settings.snn
    model = build_cnn(
        parse(settings.cnn.architecture), lambda index: make_relu(snn.noise, snn.dropout)
    )
    set_weights(model, scale_to_unit(settings, cnn_weights, samples.images))
    schedule = make_snn_schedule(snn, len(samples))
    history = fit(model, schedule, samples, seed, advance)
    return TrainedCNN(settings, get_weights(model), history)


def build_new_cnn(settings: Settings, seed: int) -> tf.keras.Model:
    """The CNN with its initial weights."""
    make_deterministic(seed)
    return TrainedCNN.build(settings)


def build_rate_network(settings: Settings) -> tf.keras.Model:
    """Build the network with rate-LIF neurons, as ``snn.recipe`` defines it."""
    snn = settings.snn
    architecture = parse(settings.cnn.architecture)
    on_chip = snn.is_on_chip
    is_noisy = snn.recipe == "loihi"
    costs = None
    if is_noisy and snn.spike_penalty:
        costs = _compute_spike_costs(settings, architecture)

    def neurons(index):
        return RateLIF(
            snn.get_max_rate(index),
            snn.tau_rc,
            snn.tau_ref,
            on_chip=on_chip,
            noise=snn.noise if is_noisy else 0.0,
            dropout=snn.dropout if is_noisy else 0.0,
            spike_costs=None if costs is None else costs[index],
        )

    def gain(index):
        return find_gain(snn.get_max_rate(index), snn.tau_rc, snn.tau_ref)

    for rate in snn.max_rates:
        try:
            find_gain(rate, snn.tau_rc, snn.tau_ref)
        except ValueError as error:
            raise UserError(f"settings: snn.max_rates: {error}") from error
    return build_cnn(architecture, neurons, gain if on_chip else None)


def _compute_spike_costs(settings, architecture):
    """For each layer the penalty for a neuron that fires at ``max_rate`` for `PRICED_STEPS`."""
    synapses = [link.fan_out for link in make_links(architecture)]
    operations = sum(int(layer.sum()) for layer in synapses)
    seconds = PRICED_STEPS * DT
    return [
        (
            settings.snn.spike_penalty
            * settings.snn.get_max_rate(index)
            * seconds
            * layer
            / operations
        ).astype(np.float32)
        for index, layer in enumerate(synapses[1:])
    ]


def train_rate_network(
    settings: Settings, samples: TrainingSamples, seed: int, cnn_weights=None, advance=None
) -> TrainedRates:
    """Train the network with rate-LIF neurons (paper, Section 3.2.2).

    With ``snn.recipe = "as-is"`` it is not trained: the CNN's weights are fitted to the neurons.
    With ``"paper"`` it starts from random weights.  With ``"loihi"`` it starts from the CNN's
    weights, scaled so that the activations fit the neurons' range, and uses the chip's rates and
    weights in the forward pass, noise on the neurons' input, and the settings' penalty on spikes.

    Parameters
    ----------
    settings, samples, seed, advance
        As in :func:`train_cnn`.
    cnn_weights : dict, optional
        Required for ``"loihi"`` and ``"as-is"``.

    Returns
    -------
    TrainedRates
    """
    if settings.snn.recipe == "as-is":
        return TrainedRates(settings, fit_to_rates(settings, cnn_weights, samples.images))
    model = build_new_rate_network(settings, seed, samples.images, cnn_weights)
    schedule = make_snn_schedule(settings.snn, len(samples))
    history = fit(model, schedule, samples, seed, advance)
    return TrainedRates(settings, get_weights(model), history)


def build_new_rate_network(
    settings: Settings, seed: int, images, cnn_weights=None
) -> tf.keras.Model:
    """The rate-based network with its initial weights, for training on some images."""
    make_deterministic(seed)
    model = build_rate_network(settings)
    if settings.snn.is_on_chip:
        set_weights(model, scale_to_unit(settings, cnn_weights, images))
    return model


def select_measured(images, architecture: Architecture) -> np.ndarray:
    """Images on which activations are measured: all, or some at equal distances of many.

    Parameters
    ----------
    images : ndarray, shape (n_samples, ...)
    architecture : Architecture
        Of the network, which has activations for each of its neurons and each image.
    """
    neurons = max(sum(architecture.neurons.values()), 1)
    return thin(images, min(MAX_MEASURED_SAMPLES, max(MAX_MEASURED_ACTIVATIONS // neurons, 1)))


def scale_to_unit(settings: Settings, weights: dict, images) -> dict:
    """Scale a ReLU network's weights so that each layer's activations reach 1.

    The function of the network does not change: the weights of a layer are divided by a factor,
    and those of the next layer are multiplied by it.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the CNN.
    images : ndarray
        Training images, for measuring the activations.
    """
    scaled = dict(weights)
    before = 1.0
    measured = select_measured(images, parse(settings.cnn.architecture))
    for name, output in TrainedCNN(settings, weights).compute_activations(measured).items():
        scale = _find_reach(output)
        scaled[f"{name}.kernel"] = weights[f"{name}.kernel"] * (before / scale)
        scaled[f"{name}.bias"] = weights[f"{name}.bias"] / scale
        before = scale
    scaled["output.kernel"] = weights["output.kernel"] * before
    return scaled


def _find_reach(activations) -> float:
    """The value that a layer's activations reach; 1 for a silent layer.

    If nearly all activations are 0, it is the largest one.
    """
    reach = float(np.percentile(activations, PERCENTILE)) or float(np.max(activations, initial=0))
    return reach or 1.0


def fit_to_rates(settings: Settings, weights: dict, images) -> dict:
    """Adapt a ReLU network's weights to LIF neurons without training.

    A LIF neuron's rate ``f`` rises steeply at its threshold and then flattens, unlike a ReLU.  With
    activations y that reach 1 (:func:`scale_to_unit`), ``c f(a z - b)`` approximates
    ``y = max(z, 0)`` if the threshold is raised by a small b; a = 1 + b keeps ``max_rate`` at 1.
    For each layer, b is the value of `SHIFTS` with the least squared error over the activations
    above 0 on the images, and c is its best factor; a and b are applied to the layer's weights and
    bias, c to the next layer's weights.

    Parameters
    ----------
    settings, weights, images
        As in :func:`scale_to_unit`.

    Returns
    -------
    dict
        Weights of the rate-based network, whose logits approximate the CNN's.
    """
    snn = settings.snn
    fitted = dict(weights)
    before = 1.0
    measured = select_measured(images, parse(settings.cnn.architecture))
    outputs = TrainedCNN(settings, weights).compute_activations(measured)
    for index, (name, output) in enumerate(outputs.items()):
        scale = _find_reach(output)
        neurons = RateLIF(snn.get_max_rate(index), snn.tau_rc, snn.tau_ref, on_chip=snn.is_on_chip)
        shift, factor = _find_best_shift(neurons, output[output > 0] / scale)
        kernel = weights[f"{name}.kernel"]
        bias = weights[f"{name}.bias"]
        fitted[f"{name}.kernel"] = kernel * (before / scale * (1 + shift))
        fitted[f"{name}.bias"] = bias / scale * (1 + shift) - shift
        before = scale * factor
    fitted["output.kernel"] = weights["output.kernel"] * before
    return fitted


def _find_best_shift(neurons, activations):
    """(b, c) of :func:`fit_to_rates` for one layer."""
    if len(activations) == 0:
        return 0.0, 1.0
    # A thousand values are a sufficient sample of the distribution.
    wanted = np.quantile(activations, (np.arange(1000) + 0.5) / 1000)
    errors = []
    for shift in SHIFTS:
        rates = neurons.compute_rates(((1 + shift) * wanted - shift).astype(np.float32)).numpy()
        factor = float(rates @ wanted / max(rates @ rates, 1e-9))
        errors.append((float(np.square(factor * rates - wanted).sum()), shift, factor))
    return min(errors)[1:]


def fit(
    model, schedule: TrainingSchedule, samples: TrainingSamples, seed: int, advance=None
) -> list:
    """Train a model with logit outputs with sparse categorical cross-entropy.

    Parameters
    ----------
    model : tf.keras.Model
        Trained in place; losses added by its layers are included.
    schedule : TrainingSchedule
    samples : TrainingSamples
    seed : int
        Seed of the order of the samples, and of the noise.
    advance : callable, optional
        ``advance(1, note)`` after each epoch.

    Returns
    -------
    list of dict
        The history, one row per epoch.
    """
    history: list[dict] = []
    for row in train_epochs(model, schedule, samples, seed):
        history.append({"epoch": len(history) + 1, **row})
        if samples.validation is not None:
            images, labels = samples.validation
            history[-1] |= _evaluate(predict(model, images), labels)
        if advance is not None:
            advance(1, f"accuracy {row['accuracy']:.3f}")
    return history


def train_epochs(model, schedule: TrainingSchedule, samples: TrainingSamples, seed: int):
    """Train a model as :func:`fit` does; each value requested trains one epoch.

    An epoch is one call of a compiled loop over its batches, or a few calls if there is much noise.
    Keras's own ``fit`` returns to Python between batches, which for these small networks takes as
    much time as their arithmetic.

    Yields
    ------
    dict
        ``loss`` and ``accuracy`` of the epoch.
    """
    count = len(samples)
    rule = make_optimizer(schedule, count)
    rule.build(model.trainable_variables)
    train_on = _compile_training(model, rule, schedule.batch_size)
    batches = _compute_ahead(_draw_samples(model, samples, schedule, seed))
    for _ in range(schedule.epochs):
        sums = tf.zeros(2)
        shown = 0
        while shown < count:
            images, labels, *draws = next(batches)
            sums += train_on(images, labels, *draws)
            shown += len(labels)
        loss, right = (float(n) / count for n in sums.numpy())
        yield {"loss": loss, "accuracy": right}


def _compile_training(model, rule, batch_size):
    """``train_on(images, labels, noise, masks) -> [sum of losses, number of right answers]``."""
    variables = model.trainable_variables

    @as_written
    def step(images, wanted, noise, masks):
        with tf.GradientTape() as tape:
            logits = call_with_noise(model, images, noise, masks)
            losses = tf.nn.sparse_softmax_cross_entropy_with_logits(wanted, logits)
            loss = tf.reduce_mean(losses) + tf.add_n([0.0, *model.losses])
        rule.apply_gradients(
            zip(tape.gradient(loss, variables), variables, strict=True),
            skip_gradients_aggregation=True,
        )
        right = tf.reduce_sum(tf.cast(tf.argmax(logits, 1, tf.int32) == wanted, tf.float32))
        return tf.stack([loss * tf.cast(tf.shape(wanted)[0], tf.float32), right])

    @tf.function
    def train_on(images, labels, noise, masks):
        sums = tf.zeros(2)
        for start in tf.range(0, len(labels), batch_size):
            batch = slice(start, start + batch_size)
            noise_of_batch = [layer[batch] for layer in noise]
            masks_of_batch = [layer[batch] for layer in masks]
            sums += step(images[batch], labels[batch], noise_of_batch, masks_of_batch)
        return sums

    return train_on


def _draw_samples(model, samples, schedule, seed):
    """The training samples of all epochs: images, labels, noise and masks for dropout.

    Yields as many whole batches of an epoch at once as `NOISE_AHEAD` allows.  NumPy draws the noise
    in two thirds of TensorFlow's time, and concurrently with the training steps.
    """
    noisy = list_noisy_layers(model)
    dropped = list_dropped_layers(model)
    images = samples.images
    labels = np.asarray(samples.labels, np.int32)
    numbers = sum(int(np.prod(layer.input_shape[1:])) for layer in (*noisy, *dropped))
    some = _count_samples_ahead(schedule.batch_size, numbers, int(np.prod(images.shape[1:])))
    # Separate random streams, so that no number depends on how many are drawn at once.
    noises = [np.random.default_rng([seed, 0, 1 + index]) for index in range(len(noisy))]
    masks = [np.random.default_rng([seed, 1, 1 + index]) for index in range(len(dropped))]
    for epoch in range(schedule.epochs):
        order = np.random.default_rng([seed, epoch]).permutation(len(labels))
        alterations = np.random.default_rng([seed, epoch, 2])
        for start in range(0, len(order), some):
            part = slice(start, start + some)
            drawn = []
            for rng, layer in zip(noises, noisy, strict=True):
                values = rng.standard_normal((len(order[part]), *layer.input_shape[1:]), np.float32)
                drawn.append(tf.constant(np.multiply(values, layer.noise, out=values)))
            kept = []
            for rng, layer in zip(masks, dropped, strict=True):
                shape = (len(order[part]), *layer.input_shape[1:])
                values = rng.random(shape, np.float32) >= layer.dropout
                kept.append(tf.constant(values / np.float32(1 - layer.dropout)))
            if samples.altered is None:
                shown = images[order[part]]
            else:
                shown = samples.altered(alterations, order[part])
            shown = tf.constant(np.asarray(shown, np.float32))
            yield shown, tf.constant(labels[order[part]]), drawn, kept


def _count_samples_ahead(batch_size, numbers, pixels):
    """Samples that are drawn at once: whole batches, and whole groups of altered images."""
    unit = math.lcm(batch_size, ALTERED_AT_ONCE)
    groups = min(NOISE_AHEAD // (unit * max(numbers, 1)), IMAGES_AHEAD // (unit * max(pixels, 1)))
    return unit * max(groups, 1)


def _compute_ahead(values):
    """Iterate over values; a thread computes the next one while the current one is in use."""
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(next, values, None)
        while (value := made.result()) is not None:
            made = pool.submit(next, values, None)
            yield value


def _evaluate(logits, labels):
    """Loss and accuracy on validation samples, as in a row of the history."""
    losses = tf.nn.sparse_softmax_cross_entropy_with_logits(np.asarray(labels, np.int32), logits)
    right = np.mean(np.argmax(logits, 1) == labels)
    return {"val_loss": float(np.mean(losses)), "val_accuracy": float(right)}


def make_optimizer(schedule: TrainingSchedule, n_samples: int) -> tf.keras.optimizers.Optimizer:
    """The schedule's optimiser for a number of training samples."""
    if not schedule.annealed:
        return tf.keras.optimizers.RMSprop(schedule.learning_rate)
    steps = schedule.count_batches(n_samples) * schedule.epochs
    return tf.keras.optimizers.Adam(
        tf.keras.optimizers.schedules.CosineDecay(schedule.learning_rate, steps)
    )


def make_deterministic(seed: int):
    """Seed TensorFlow so that the same machine computes the same weights."""
    tf.keras.backend.clear_session()
    tf.keras.utils.set_random_seed(int(seed))
    tf.config.experimental.enable_op_determinism()
