"""The epochs of a training on images: batches, noise, updates and the history."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from models.cnn import call_with_noise, compute_logits, list_dropped_layers, list_noisy_layers
from models.keras.keras2 import as_written, tf
from pipeline.recordings.images import ALTERED_AT_ONCE
from pipeline.training.images.schedules import TrainingSchedule

# Maximum number of noise values, of 4 bytes each, drawn in advance.
MAX_NOISE_AHEAD = 1 << 23

# Maximum number of values of images that are computed in advance.
MAX_IMAGES_AHEAD = 1 << 24


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


def fit_model(
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
            history[-1] |= _evaluate(compute_logits(model, images), labels)
        if advance is not None:
            advance(1, f"accuracy {row['accuracy']:.3f}")
    return history


def train_epochs(model, schedule: TrainingSchedule, samples: TrainingSamples, seed: int):
    """Train a model as :func:`fit_model` does; each value requested trains one epoch.

    An epoch is one call of a compiled loop over its batches, or a few calls if there is much noise.
    Keras's own ``fit`` returns to Python between batches, which for these small networks takes as
    much time as their arithmetic.

    Yields
    ------
    dict
        ``loss`` and ``accuracy`` of the epoch.
    """
    count = len(samples)
    optimizer = make_optimizer(schedule, count)
    optimizer.build(model.trainable_variables)
    train_on = _compile_training(model, optimizer, schedule.batch_size)
    batches = _compute_ahead(_draw_samples(model, samples, schedule, seed))
    for _ in range(schedule.epochs):
        sums = tf.zeros(2)
        n_seen = 0
        while n_seen < count:
            images, labels, *draws = next(batches)
            sums += train_on(images, labels, *draws)
            n_seen += len(labels)
        loss, right = (float(n) / count for n in sums.numpy())
        yield {"loss": loss, "accuracy": right}


def _compile_training(model, optimizer, batch_size):
    """A function that trains on samples, and returns the sum of losses and of right predictions.

    It takes the arguments ``images, labels, noise, masks``.
    """
    variables = model.trainable_variables

    @as_written
    def step(images, labels, noise, masks):
        with tf.GradientTape() as tape:
            logits = call_with_noise(model, images, noise, masks)
            losses = tf.nn.sparse_softmax_cross_entropy_with_logits(labels, logits)
            loss = tf.reduce_mean(losses) + tf.add_n([0.0, *model.losses])
        optimizer.apply_gradients(
            zip(tape.gradient(loss, variables), variables, strict=True),
            skip_gradients_aggregation=True,
        )
        right = tf.reduce_sum(tf.cast(tf.argmax(logits, 1, tf.int32) == labels, tf.float32))
        return tf.stack([loss * tf.cast(tf.shape(labels)[0], tf.float32), right])

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

    Yields as many whole batches of an epoch at once as `MAX_NOISE_AHEAD` allows.  NumPy draws the
    noise in two thirds of TensorFlow's time, and concurrently with the training steps.
    """
    noisy = list_noisy_layers(model)
    dropped = list_dropped_layers(model)
    labels = np.asarray(samples.labels, np.int32)
    numbers = sum(int(np.prod(layer.input_shape[1:])) for layer in (*noisy, *dropped))
    pixels = int(np.prod(samples.images.shape[1:]))
    n_ahead = _count_samples_ahead(schedule.batch_size, numbers, pixels)
    # Separate random streams, so that no number depends on how many are drawn at once.
    noise_rngs = [np.random.default_rng([seed, 0, 1 + index]) for index in range(len(noisy))]
    mask_rngs = [np.random.default_rng([seed, 1, 1 + index]) for index in range(len(dropped))]
    for epoch in range(schedule.epochs):
        order = np.random.default_rng([seed, epoch]).permutation(len(labels))
        alterations = np.random.default_rng([seed, epoch, 2])
        for start in range(0, len(order), n_ahead):
            indices = order[start : start + n_ahead]
            noise = _draw_noise(noise_rngs, noisy, len(indices))
            masks = _draw_masks(mask_rngs, dropped, len(indices))
            if samples.altered is None:
                images = samples.images[indices]
            else:
                images = samples.altered(alterations, indices)
            images = tf.constant(np.asarray(images, np.float32))
            yield images, tf.constant(labels[indices]), noise, masks


def _draw_noise(rngs, layers, n_samples):
    """The noise on the input of each noisy layer."""
    noise = []
    for rng, layer in zip(rngs, layers, strict=True):
        values = rng.standard_normal((n_samples, *layer.input_shape[1:]), np.float32)
        noise.append(tf.constant(np.multiply(values, layer.noise, out=values)))
    return noise


def _draw_masks(rngs, layers, n_samples):
    """The factors of dropout of each layer that has it."""
    masks = []
    for rng, layer in zip(rngs, layers, strict=True):
        kept = rng.random((n_samples, *layer.input_shape[1:]), np.float32) >= layer.dropout
        masks.append(tf.constant(kept / np.float32(1 - layer.dropout)))
    return masks


def _count_samples_ahead(batch_size, numbers, pixels):
    """Samples that are drawn at once: whole batches, and whole groups of altered images."""
    unit = math.lcm(batch_size, ALTERED_AT_ONCE)
    groups = min(
        MAX_NOISE_AHEAD // (unit * max(numbers, 1)),
        MAX_IMAGES_AHEAD // (unit * max(pixels, 1)),
    )
    return unit * max(groups, 1)


def _compute_ahead(values):
    """Iterate over values; a thread computes the next one while the current one is in use."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(next, values, None)
        while (value := future.result()) is not None:
            future = pool.submit(next, values, None)
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
