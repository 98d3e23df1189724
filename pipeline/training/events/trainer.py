"""Train the weights of a network on events."""

from __future__ import annotations

import functools

import numpy as np
from threadpoolctl import threadpool_limits

from deploy.arithmetic import divide_up
from deploy.errors import UserError
from deploy.network.stimulus import find_last_steps
from models.architecture import parse_architecture
from models.spiking.gradient import Batch, SpikingGradient
from pipeline.paper import CNN_MACS
from pipeline.training.event_samples import EventSamples
from pipeline.training.event_updates import TAIL_STEPS
from pipeline.training.events.checkpoint import Checkpoint, train_epochs
from pipeline.training.events.design import EventDesign
from pipeline.training.events.estimator import train_estimator
from pipeline.training.events.network import TrainedOnEvents, delay_as_on_chip
from pipeline.training.events.optimizer import Adam
from pipeline.training.images.epochs import make_deterministic

# Training samples that the estimator of the confidence is trained on: its inputs are some 40
# numbers for each step of each sample, which would be gigabytes for all of 30,000 samples.
MAX_ESTIMATOR_SAMPLES = 6000

# Initial mean firing rate of the neurons, in spikes per second of recording time: silent neurons
# have no gradient. A start above the budget is no loss: the penalty lowers the operations within
# some epochs, and a start within it, on ST-MNIST at 0.7 Hz, cost 1.4 points.
FIRST_RATE_HZ = 5.0

# Maximum number of samples on which the initial weights are scaled.
MAX_CALIBRATION_SAMPLES = 64

# Batches among whose samples batches of similar length are made.
SORTED_BATCHES = 16

# Samples that are evaluated together.
EVALUATION_SAMPLES = 100


def train_events(
    design: EventDesign,
    samples: EventSamples,
    seed: int,
    checkpoint: Checkpoint | None = None,
    advance=None,
) -> TrainedOnEvents:
    """Train a network on events.

    Parameters
    ----------
    design : EventDesign
    samples : EventSamples
        Training samples without events are left out; those that are held out are evaluated for the
        history only.
    seed : int
        Seed of the initial weights, the order of the samples, data augmentation and dropout.  The
        weights are reproducible on the same machine.
    checkpoint : Checkpoint, optional
        The file for the state after each epoch; an interrupted training resumes from it, with the
        same result as without the interruption.
    advance : callable, optional
        ``advance(1, note)`` after each epoch, including those of an earlier session.

    Returns
    -------
    TrainedOnEvents

    Raises
    ------
    UserError
        The checkpoint is damaged, or there is no training sample with an event.
    """
    make_deterministic(seed)  # of the estimator
    design = design.with_epochs_for(len(samples.train))
    train = samples.train[np.diff(samples.table.offsets)[samples.train] > 0]
    if not len(train):
        raise UserError("no training sample has an event; give other recordings")
    with threadpool_limits(1, "blas"):  # samples are in several threads already
        trainer = Trainer(design, samples._replace(train=train), seed)
        held_out = samples.held_out
        watch = functools.partial(trainer.evaluate, held_out) if len(held_out) else None
        history = train_epochs(
            trainer.train_epoch, design.epochs, trainer.state, checkpoint, watch, advance
        )
        outputs, right = trainer.compute_outputs_in_time(_draw_estimator_samples(train, seed))
    estimator = train_estimator(outputs, right, seed)
    return TrainedOnEvents(design, {**trainer.weights, **estimator.to_arrays()}, history)


def _draw_estimator_samples(train, seed):
    """At most `MAX_ESTIMATOR_SAMPLES` training samples for the estimator of the confidence."""
    if len(train) <= MAX_ESTIMATOR_SAMPLES:
        return train
    order = np.random.default_rng([seed, 0x5A3E]).permutation(train)
    return np.sort(order[:MAX_ESTIMATOR_SAMPLES])


class Trainer:
    """The network, the optimiser, and the samples.

    Parameters
    ----------
    design, samples, seed
        As for :func:`train_events`; each training sample has an event.
    """

    def __init__(self, design: EventDesign, samples: EventSamples, seed: int):
        self.design = design
        self.table = samples.table
        self.labels = samples.labels
        self.train = samples.train
        self.seed = seed
        self.batches = divide_up(len(samples.train), design.batch_size)
        self._network = design.make_network(seed)
        self._gradient = SpikingGradient(
            parse_architecture(design.architecture), design.neuron, design.section_starts
        )
        variables = self._network.variables_by_name.items()
        values = {name: variable.numpy() for name, variable in variables}
        self._calibrate(values)
        updates = design.epochs * self.batches
        self._optimizer = Adam(values, design.learning_rate, updates, design.average)
        self._cost = np.zeros(())  # operations of the last batch, in multiples of the CNN's

    @property
    def weights(self) -> dict:
        """The result of the training: the running mean of the weights."""
        return self._network.name_arrays(self._optimizer.means.values())

    @property
    def state(self) -> dict:
        """All arrays that the next epoch depends on, by name."""
        return {**self._optimizer.state, "cost": self._cost}

    def train_epoch(self, epoch: int) -> dict:
        """Train for one epoch, counted from 0; returns the epoch's row of the history."""
        rng = np.random.default_rng([self.seed, epoch, 0xE7E])
        sums = np.zeros(3)
        for index, batch in enumerate(self._draw_batches(rng)):
            sums += self._train_on(batch, rng, epoch * self.batches + index)
        self.table.release()
        loss, accuracy, cost = sums / self.batches
        return {"loss": loss, "accuracy": accuracy, "operations": cost}

    def evaluate(self, indices) -> dict:
        """Accuracy and operations on samples without augmentation, for the history."""
        right = []
        costs = []
        for batch, _, outputs, cost in self._compute_outputs(indices, self._make_frames):
            right.append(outputs[:, -1].argmax(-1) == self.labels[batch])
            costs.append(cost)
        cost = float(np.concatenate(costs).mean()) / CNN_MACS
        return {"val_accuracy": float(np.concatenate(right).mean()), "val_operations": cost}

    def compute_outputs_in_time(self, indices) -> tuple:
        """Delayed outputs up to the effect of the last event, and whether they are right.

        Each sample is used without augmentation and once augmented.  The network overfits the
        training samples, so that without augmentation the confidence would be overestimated.

        Returns
        -------
        outputs, right : list of ndarray
            As :func:`pipeline.training.events.estimator.train_estimator` takes them.
        """
        rng = np.random.default_rng([self.seed, 0x10D6E])
        by_sample = []
        right = []
        for frames_of in (self._make_frames, lambda batch: self._alter(batch, rng)[0]):
            for batch, frames, outputs, _ in self._compute_outputs(indices, frames_of):
                lengths = find_last_steps(frames) + 1 + TAIL_STEPS
                delayed = delay_as_on_chip(outputs, self.design)
                for sample, index, length in zip(delayed, batch, lengths, strict=True):
                    by_sample.append(sample[:length])
                    right.append(by_sample[-1].argmax(-1) == self.labels[index])
        return by_sample, right

    def _calibrate(self, values):
        """Scale the initial weights of each layer for a mean firing rate."""
        count = min(len(self.train), MAX_CALIBRATION_SAMPLES)
        indices = self.train[np.linspace(0, len(self.train) - 1, count).astype(int)]
        duration_ms = max(float(self.table.duration_ms[indices].mean()), self.design.step_ms)
        frames = self._make_frames(indices)
        self._scale_to_rate(values, frames, FIRST_RATE_HZ * duration_ms / 1000)

    def _scale_to_rate(self, values, frames, spikes):
        """Scale the weights of each layer so that a neuron has a mean number of spikes."""
        for index, name in enumerate(self._network.names):
            first = values[f"{name}.kernel"]
            low = -6.0
            high = 6.0
            for _ in range(12):
                middle = (low + high) / 2
                values[f"{name}.kernel"] = (first * np.exp(middle)).astype(np.float32)
                counts = self._gradient.compute_outputs(values, frames)[2][index]
                low, high = (low, middle) if counts.mean() > spikes else (middle, high)

    def _train_on(self, batch, rng, number):
        """One update; returns the loss, the share of right predictions, and the operations."""
        design = self.design
        n = len(batch)
        frames, last_step = self._alter(batch, rng)
        dropout_factors = [
            self._draw_dropout_factors(rng, n, neurons) for neurons in self._gradient.neurons
        ]
        # The operations are those of the batch before: a sum over the whole batch would keep the
        # states of all its samples.
        price = design.price / CNN_MACS if self._cost > design.budget else 0.0
        result = self._gradient.compute_gradients(
            self._optimizer.values,
            Batch(frames, self.labels[batch], last_step, dropout_factors),
            design.early,
            price,
        )
        gradients = {name: value / n for name, value in result.gradients.items()}
        self._optimizer.update(gradients, number)
        self._cost[...] = result.operations / n / CNN_MACS
        return result.loss / n, result.right / n, float(self._cost)

    def _draw_dropout_factors(self, rng, samples, neurons):
        """Factors of dropout, shape (samples, neurons)."""
        dropout = self.design.dropout
        if not dropout:
            return np.ones((samples, neurons), np.float32)
        kept = rng.random((samples, neurons), np.float32) >= dropout
        return kept / np.float32(1 - dropout)

    def _draw_batches(self, rng):
        """Training samples in random order, in batches of samples of similar length."""
        size = self.design.batch_size
        order = rng.permutation(self.train)
        order = np.concatenate([order, np.resize(order, -len(order) % size)])
        batches = []
        for start in range(0, len(order), SORTED_BATCHES * size):
            group = order[start : start + SORTED_BATCHES * size]
            group = group[np.argsort(self.table.duration_ms[group], kind="stable")]
            batches += np.split(group, len(group) // size)
        rng.shuffle(batches)
        return batches

    def _alter(self, indices, rng):
        """Frames and last steps of augmented samples."""
        n = len(indices)
        events = self.design.alter_samples(rng, self.table, indices)
        last_step = (events.measure_durations_ms(n) / self.design.step_ms).astype(np.int64)
        steps = int(last_step.max()) + 1 + TAIL_STEPS
        frames = self.design.make_frames(events, n, steps, self.table.size)
        return np.moveaxis(frames, 0, 1), last_step

    def _make_frames(self, indices):
        """Frames of samples without augmentation."""
        step_ms = self.design.step_ms
        steps = int(self.table.duration_ms[indices].max() / step_ms) + 1 + TAIL_STEPS
        return np.moveaxis(self.design.make_frames_of_samples(self.table, indices, steps), 0, 1)

    def _compute_outputs(self, indices, frames_of):
        """For some samples at a time: indices, frames, outputs and operations."""
        indices = np.asarray(indices)
        order = indices[np.argsort(self.table.duration_ms[indices], kind="stable")]
        for start in range(0, len(order), EVALUATION_SAMPLES):
            batch = order[start : start + EVALUATION_SAMPLES]
            frames = frames_of(batch)
            outputs, costs, _ = self._gradient.compute_outputs(self._optimizer.means, frames)
            yield batch, frames, outputs, costs
