"""Train a spiking network on events for the chip; the network is in :mod:`models.spiking`.

Let c be a sample's label, p(t) the softmax of the outputs at step t, T the step of the last event,
and o the synaptic operations of an inference in multiples of the CNN's (``CNN_MACS``).  The loss is

    - log p_c(end) - early mean over t <= T of log p_c(t) + price max(o - budget, 0)

The first term rewards the right answer at the end.  The second term rewards an early right answer
and makes the softmax of the outputs a confidence.  The third term, a penalty on the mean of a
batch, keeps the synaptic operations within the budget.
"""

from __future__ import annotations

import functools
import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import read_arrays, reporting_damage, write_arrays
from deploy.network.decision import (
    HIDDEN,
    Estimator,
    Threshold,
    choose_threshold,
    delayed,
    estimator_inputs,
)
from deploy.network.stimulus import last_steps
from models.architecture import parse
from models.keras.keras2 import tf
from models.spiking import Neuron, SpikingNetwork, operations
from pipeline.paper import CNN_MACS
from pipeline.recordings.altering import AUGMENTATIONS, Alteration, alter
from pipeline.recordings.columns import EventColumns
from pipeline.recordings.steps import EventTable, spike_frames
from pipeline.run.settings import EventTraining, Input, Settings
from pipeline.training.networks import make_deterministic
from pipeline.training.recipe import epochs_for

# Training of the confidence estimator; see :mod:`deploy.network.decision`.
ESTIMATOR_EPOCHS, ESTIMATOR_BATCH, ESTIMATOR_LEARNING_RATE = 4, 512, 0.002

# Number of steps after a sample's last event in which its spikes still reach the outputs.
TAIL = 3

# Number of augmented copies of each held-out sample that are used, with the sample itself, to
# choose the confidence for an early decision. Half a percentage point of a few hundred samples is
# two or three samples, so a choice on these alone would overestimate the accuracy.
ALTERED = 4

# The number of steps of a batch is rounded up to a multiple of this, since each length is compiled
# separately.
LENGTHS = 16

# Initial mean firing rate of the neurons, in spikes per second of recording time. Silent neurons
# have no gradient.
FIRST_RATE = 5.0


# The remedy for a damaged checkpoint.
FROM_THE_START = "delete it to train from the start"


@dataclass(frozen=True)
class EventRecipe:
    """Hyperparameters of a network on events and of its training.

    Attributes
    ----------
    architecture : str
        See :mod:`models.architecture`.
    step_ms : float
        Recording time in milliseconds that one step of the chip represents.
    refractory : int
        Refractory period of a taxel in steps; see
        :func:`pipeline.recordings.steps.spike_frames`.
    tau_u_ms, tau_v_ms : tuple of float
        Initial time constants of current and voltage, in milliseconds of recording time.
    floor, beta : float
        See :class:`models.spiking.Neuron`.
    starts : tuple of int
        First step of each part of a sample with readout weights of its own.
    epochs, batch_size : int
        0 epochs: as many as :func:`pipeline.training.recipe.epochs_for` says.
    learning_rate : float
        Learning rate of Adam after a short warm-up; it then falls to 0 along a half cosine.
    average : float
        Decay per batch of the running mean of the weights; the running mean is the result.
    dropout : float
        Share of a layer's neurons whose spikes are dropped in a sample.
    early, price, budget : float
        See the module's docstring.
    alteration : Alteration
        Augmentation of training samples, drawn again in each epoch.
    """

    architecture: str = EventTraining.architecture
    step_ms: float = Input.step
    refractory: int = Input().refractory_steps
    tau_u_ms: tuple = (30.0,)
    tau_v_ms: tuple = (80.0,)
    floor: float = -2.0
    beta: float = 4.0
    starts: tuple = (0,)
    epochs: int = EventTraining.epochs
    batch_size: int = EventTraining.batch_size
    learning_rate: float = EventTraining.learning_rate
    average: float = 0.998
    dropout: float = EventTraining.dropout
    early: float = EventTraining.early
    price: float = 3.0
    budget: float = EventTraining.budget
    alteration: Alteration = AUGMENTATIONS["space"]

    def alter_samples(self, rng, table: EventTable, indices) -> EventColumns:
        """Some samples altered."""
        events = EventColumns(*table.pick(indices))
        return alter(self.alteration, rng, events, len(indices), self.step_ms, table.size)

    def frames_of(self, events: EventColumns, samples: int, steps: int, size: tuple) -> np.ndarray:
        """Frames of events; see :func:`pipeline.recordings.steps.spike_frames`."""
        sample, time_ms, *place = events
        step = time_ms / self.step_ms
        return spike_frames(sample, step, *place, samples, steps, size, self.refractory)

    @classmethod
    def of(cls, settings: Settings) -> EventRecipe:
        """Make the recipe from the settings."""
        shown = settings.input
        values = asdict(settings.events)
        how = values.pop("augment")
        how = AUGMENTATIONS["space" if how == "auto" else how]  # auto: not fitted, so simulated
        values |= {
            "step_ms": shown.step,
            "refractory": shown.refractory_steps,
            "starts": settings.part_starts,
        }
        del values["parts"], values["part"]
        return cls(**values, alteration=how)

    def for_samples(self, samples: int) -> EventRecipe:
        """The recipe with its number of epochs, for some number of training samples."""
        if self.epochs:
            return self
        return replace(
            self, epochs=epochs_for(samples, self.batch_size, bool(self.alteration.turn))
        )


@dataclass(frozen=True)
class TrainedOnEvents:
    """A trained network, with methods to run it.

    Attributes
    ----------
    recipe : EventRecipe
    weights : dict of str to ndarray
        See :meth:`models.spiking.SpikingNetwork.get_weights`; also the arrays of the confidence
        estimator (:class:`deploy.network.decision.Estimator`).
    history : list of dict
        One row per epoch: ``epoch``, ``loss`` (without the penalty), ``accuracy`` and
        ``operations`` (in multiples of the CNN's) on the augmented training samples, ``seconds``,
        and ``val_accuracy`` and ``val_operations`` if there are validation samples.
    """

    recipe: EventRecipe
    weights: dict
    history: list = field(default_factory=list)

    @classmethod
    def of(cls, settings: Settings, weights: dict) -> TrainedOnEvents:
        """The network with given weights that was trained with some settings."""
        return cls(EventRecipe.of(settings), weights)

    def answers(self, frames, advance=None) -> Answers:
        """Outputs, operations and spikes on event frames; see :func:`answer_frames`."""
        return answer_frames(self.recipe, self.weights, frames, advance)

    @property
    def estimator(self) -> Estimator:
        """The confidence estimator."""
        return Estimator.from_arrays(self.weights, parse(self.recipe.architecture).outputs)

    def threshold(self, table, labels, held_out, steps: int, seed: int, loss: float) -> Threshold:
        """Choose the confidence for early decisions on held-out samples.

        The samples and their augmented copies have equal weight in the choice; see
        :func:`deploy.network.decision.choose_threshold`.

        Parameters
        ----------
        table : EventTable
        labels : ndarray of int, shape (n_samples,)
        held_out : ndarray of int
            Indices of the held-out samples, which the network was not trained on.
        steps : int
            Number of steps for which each sample is presented.
        seed : int
            Seed of the data augmentation.
        loss : float
            Largest loss of accuracy by early decisions.
        """
        often, rng = np.tile(held_out, ALTERED), np.random.default_rng([seed, 0x7E57])
        events = self.recipe.alter_samples(rng, table, often)
        altered = self.recipe.frames_of(events, len(often), steps, table.size)
        as_they_are = table.frames(held_out, self.recipe.step_ms, steps, self.recipe.refractory)
        shown = self.answers(np.moveaxis(np.concatenate([as_they_are, altered], 1), 0, 1))
        return choose_threshold(
            arriving(shown.outputs, self.recipe),
            np.asarray(labels)[np.concatenate([held_out, often])],
            shown.last_step,
            loss,
            estimator=self.estimator,
            weights=np.repeat([1, 1 / ALTERED], [len(held_out), len(often)]),
        )

    def logits(self, frames) -> np.ndarray:
        """Outputs at the last step, delayed as on the chip, shape (n_samples, classes)."""
        return arriving(self.answers(frames).outputs, self.recipe)[:, -1]


@dataclass(frozen=True)
class Answers:
    """Outputs of a trained network.

    Attributes
    ----------
    outputs : ndarray of float32, shape (n_samples, steps, outputs)
        Outputs after every step of a sample; the largest is the prediction.
    operations : ndarray of float32, shape (n_samples, layers)
        Synaptic operations by the receiving layer, the readout last.
    spikes : dict of str to ndarray of int32, shape (n_samples, neurons)
        Number of spikes of each neuron of each layer, over all steps.
    last_step : ndarray of int64, shape (n_samples,)
        Step of each sample's last event.
    """

    outputs: np.ndarray
    operations: np.ndarray
    spikes: dict
    last_step: np.ndarray


def train_events(
    recipe: EventRecipe,
    table: EventTable,
    labels,
    train,
    seed: int,
    validation=(),
    checkpoint: Checkpoint | None = None,
    advance=None,
) -> TrainedOnEvents:
    """Train a network on events.

    Parameters
    ----------
    recipe : EventRecipe
    table : EventTable
    labels : ndarray of int, shape (n_samples,)
    train : ndarray of int
        Indices of the training samples; those without events are left out.
    seed : int
        Seed of the initial weights, the order of the samples, data augmentation and dropout.  The
        weights are reproducible on the same machine.
    validation : ndarray of int, optional
        Indices of samples that are evaluated for the history only.
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
    recipe, train = recipe.for_samples(len(train)), np.asarray(train)
    train = train[np.diff(table.offsets)[train] > 0]
    if not len(train):
        raise UserError("no training sample has an event; give other recordings")
    trainer = _Trainer(recipe, table, np.asarray(labels), train, seed)
    history = train_epochs(
        trainer.epoch,
        recipe.epochs,
        trainer.state,
        checkpoint,
        (lambda: trainer.watch(validation)) if len(validation) else None,
        advance,
    )
    estimator = train_estimator(*trainer.outputs_of(train), seed)
    return TrainedOnEvents(recipe, {**trainer.weights(), **estimator.arrays()}, history)


def answer_frames(recipe: EventRecipe, weights: dict, frames, advance=None) -> Answers:
    """Run a trained network on event frames in the chip's integers, each sample from rest.

    Parameters
    ----------
    recipe : EventRecipe
    weights : dict
        Weights of a :class:`TrainedOnEvents`.
    frames : ndarray of uint8, shape (n_samples, steps, rows, columns, channels)
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    Answers
    """
    network = network_of(recipe, weights)
    run, values, parts = _compiled(recipe, tf.float64), _now(network.variables_by_name), []
    for start in range(0, len(frames), 100):
        part = frames[start : start + 100]
        outputs, costs, spikes = run(np.moveaxis(part, 0, 1), values)
        parts.append(
            (np.moveaxis(outputs.numpy(), 0, 1), costs.numpy(), *(s.numpy() for s in spikes))
        )
        if advance is not None:
            advance(len(part))
    outputs, costs, *spikes = (np.concatenate(column) for column in zip(*parts, strict=True))
    named = {n: s.astype(np.int32) for n, s in zip(network.names, spikes, strict=True)}
    return Answers(outputs.astype(np.float32), costs, named, last_steps(frames))


def network_of(recipe: EventRecipe, weights: dict) -> SpikingNetwork:
    """The network of a recipe with trained weights."""
    network = SpikingNetwork(parse(recipe.architecture), _neuron(recipe), starts=recipe.starts)
    network.set_weights(weights)
    return network


def arriving(outputs, recipe: EventRecipe) -> np.ndarray:
    """Delay outputs as on the chip, where the relay and every layer take one step each.

    Parameters
    ----------
    outputs : ndarray, shape (..., steps, outputs)
        Outputs of the trained network, which has no delays.
    recipe : EventRecipe

    Returns
    -------
    ndarray of the same shape
    """
    return delayed(outputs, len(parse(recipe.architecture).spiking) + 1)


def _neuron(recipe):
    taus = (tuple(t / recipe.step_ms for t in ms) for ms in (recipe.tau_u_ms, recipe.tau_v_ms))
    return Neuron(*taus, recipe.floor, recipe.beta)


def _compiled(recipe, dtype):
    """``run(frames, values)``: outputs, operations per sample, spikes per neuron."""
    return _compiled_network(recipe.architecture, _neuron(recipe), recipe.starts, dtype)


@functools.lru_cache(maxsize=8)
def _compiled_network(architecture, neuron, starts, dtype):
    # For any weights: networks of the same shape share one compilation, which takes seconds.
    network = SpikingNetwork(parse(architecture), neuron, starts=starts)
    variables = {
        name: tf.TensorSpec(v.shape, v.dtype) for name, v in network.variables_by_name.items()
    }

    @tf.function(autograph=False, input_signature=(_frames_of(network), variables))
    def run(frames, values):
        outputs, spikes = network(frames, dtype=dtype, values=values)
        costs = operations(network.architecture, frames, spikes)
        return outputs, costs, [tf.reduce_sum(layer, 0) for layer in spikes]

    return run


def _frames_of(network, samples=None):
    """A tensor specification of frames with any number of steps, so that tracing occurs once."""
    return tf.TensorSpec((None, samples, *network.architecture.input_shape), tf.uint8)


def _now(variables):
    """Current values of the variables, for :func:`_compiled`."""
    return {name: tf.convert_to_tensor(variable) for name, variable in variables.items()}


class _Trainer:
    """The network, the optimiser, the running mean of the weights, and the compiled steps."""

    def __init__(self, recipe, table, labels, train, seed):
        make_deterministic(seed)
        self.recipe, self.table, self.labels, self.seed = recipe, table, labels, seed
        self.train = train
        self.network = SpikingNetwork(
            parse(recipe.architecture), _neuron(recipe), seed, recipe.starts
        )
        self.variables = self.network.variables_in_order
        self.batches = -(-len(train) // recipe.batch_size)
        self.optimizer = tf.keras.optimizers.Adam(
            tf.keras.optimizers.schedules.CosineDecay(
                0.0,
                recipe.epochs * self.batches,
                warmup_target=recipe.learning_rate,
                warmup_steps=50,
            ),
            global_clipnorm=5.0,
        )
        self.optimizer.build(self.variables)
        self._calibrate()
        self.mean = [tf.Variable(variable) for variable in self.variables]
        samples = recipe.batch_size
        signature = (
            _frames_of(self.network, samples),
            tf.TensorSpec((samples,), self.labels.dtype),
            tf.TensorSpec((None, samples), tf.float32),
            tf.TensorSpec((), tf.int32),
        )
        self._step = tf.function(self._train_on, signature, autograph=False)

    def _calibrate(self):
        """Scale the initial weights of each layer so that its neurons fire at ``FIRST_RATE``."""
        some = self.train[np.linspace(0, len(self.train) - 1, min(len(self.train), 64)).astype(int)]
        seconds = max(float(self.table.duration_ms[some].mean()), self.recipe.step_ms) / 1000
        frames = self._frames(some)
        run, variables = _compiled(self.recipe, tf.float32), self.network.variables_by_name
        for index, name in enumerate(self.network.names):
            kernel = variables[f"{name}.kernel"]
            first, low, high = kernel.numpy(), -4.0, 6.0
            for _ in range(12):
                middle = (low + high) / 2
                kernel.assign(first * np.exp(middle))
                rate = float(tf.reduce_mean(run(frames, _now(variables))[2][index])) / seconds
                low, high = (low, middle) if rate > FIRST_RATE else (middle, high)

    def _train_on(self, frames, labels, writing, number):
        """One training step; returns the loss, the share of right answers, and the operations."""
        recipe, architecture = self.recipe, self.network.architecture
        with tf.GradientTape() as tape:
            outputs, spikes = self.network(frames, self._dropout(frames.shape[1], number))
            loss_at = tf.nn.sparse_softmax_cross_entropy_with_logits(
                tf.tile(labels[None], (tf.shape(frames)[0], 1)), outputs
            )
            throughout = tf.reduce_sum(loss_at * writing, 0) / tf.reduce_sum(writing, 0)
            loss = tf.reduce_mean(loss_at[-1] + recipe.early * throughout)
            costs = tf.reduce_sum(operations(architecture, frames, spikes), 1)
            cost = tf.reduce_mean(costs) / CNN_MACS
            total = loss + recipe.price * tf.nn.relu(cost - recipe.budget)
        gradients = tape.gradient(total, self.variables)
        self.optimizer.apply_gradients(zip(gradients, self.variables, strict=True))
        done = tf.cast(number, tf.float32)
        share = tf.minimum(recipe.average, (1 + done) / (10 + done))  # shorter at first
        for mean, variable in zip(self.mean, self.variables, strict=True):
            mean.assign(share * mean + (1 - share) * variable)
        right = tf.argmax(outputs[-1], -1, labels.dtype) == labels
        return loss, tf.reduce_mean(tf.cast(right, tf.float32)), cost

    def _dropout(self, samples, number):
        if not self.recipe.dropout:
            return None
        heard = []
        for index, name in enumerate(self.network.names):
            shape = (samples, self.network.architecture.neurons[name])
            draw = tf.random.stateless_uniform(shape, (self.seed + index * 2**20, number))
            heard.append(
                tf.cast(draw >= self.recipe.dropout, tf.float32) / (1 - self.recipe.dropout)
            )
        return heard

    def epoch(self, epoch):
        """Train for one epoch; returns the epoch's row of the history."""
        rng = np.random.default_rng([self.seed, epoch, 0xE7E])
        sums = np.zeros(3)
        for index, batch in enumerate(self._batches(rng)):
            number = tf.constant(epoch * self.batches + index)
            results = self._step(*self._altered(batch, rng), number)
            sums += [float(value) for value in results]
        loss, accuracy, cost = sums / self.batches
        return {"loss": loss, "accuracy": accuracy, "operations": cost}

    def _batches(self, rng):
        """Training samples in random order, in batches of samples of similar length."""
        recipe = self.recipe
        order = rng.permutation(self.train)
        short = -len(order) % recipe.batch_size  # only full batches fit the compiled function
        order = np.concatenate([order, np.resize(order, short)])
        batches = []
        for start in range(0, len(order), 16 * recipe.batch_size):
            part = order[start : start + 16 * recipe.batch_size]
            part = part[np.argsort(self.table.duration_ms[part], kind="stable")]
            batches += np.split(part, len(part) // recipe.batch_size)
        rng.shuffle(batches)
        return batches

    def _altered(self, batch, rng):
        """Frames, labels and last steps of augmented samples."""
        n = len(batch)
        events = self.recipe.alter_samples(rng, self.table, batch)
        last = (events.durations_ms(n) / self.recipe.step_ms).astype(np.int64)
        frames = self.recipe.frames_of(events, n, _padded(last.max()), self.table.size)
        writing = (np.arange(len(frames))[:, None] <= last).astype(np.float32)
        return frames, self.labels[batch], writing

    def _frames(self, indices):
        """Frames of samples without augmentation."""
        step, refractory = self.recipe.step_ms, self.recipe.refractory
        steps = _padded(int(self.table.duration_ms[indices].max() / step))
        return self.table.frames(indices, step, steps, refractory)

    def _answers(self, indices, frames_of, size=100):
        """For each batch: indices, frames, outputs and operations."""
        indices = np.asarray(indices)
        order = indices[np.argsort(self.table.duration_ms[indices], kind="stable")]
        run = _compiled(self.recipe, tf.float32)
        means = _now(dict(zip(self.network.variables_by_name, self.mean, strict=True)))
        for start in range(0, len(order), size):
            part = order[start : start + size]
            frames = frames_of(np.resize(part, size))
            outputs, cost, _ = run(frames, means)
            n = len(part)
            yield part, frames[:, :n], outputs.numpy()[:, :n], cost.numpy()[:n].sum(1)

    def watch(self, indices):
        """Accuracy and operations on samples without augmentation, for the history."""
        right, costs = [], []
        for part, _, outputs, cost in self._answers(indices, self._frames):
            right.append(outputs[-1].argmax(-1) == self.labels[part])
            costs.append(cost)
        cost = float(np.concatenate(costs).mean()) / CNN_MACS
        return {"val_accuracy": float(np.concatenate(right).mean()), "val_operations": cost}

    def outputs_of(self, indices):
        """Delayed outputs up to the effect of the last event, and whether they are right.

        Each sample is used without augmentation and once augmented.  The network overfits the
        training samples, so that without augmentation the confidence would be overestimated.
        """
        rng = np.random.default_rng([self.seed, 0x10D6E])
        every, right = [], []
        for frames_of in (self._frames, lambda batch: self._altered(batch, rng)[0]):
            for part, frames, outputs, _ in self._answers(indices, frames_of):
                outputs = arriving(np.moveaxis(outputs, 0, 1), self.recipe)
                lengths = last_steps(np.moveaxis(frames, 0, 1)) + 1 + TAIL
                for sample, index, length in zip(outputs, part, lengths, strict=True):
                    every.append(sample[:length])
                    right.append(every[-1].argmax(-1) == self.labels[index])
        return every, right

    def weights(self):
        """The result of the training: the running mean of the weights."""
        return self.network.named(variable.numpy() for variable in self.mean)

    @property
    def state(self):
        """All variables that the next epoch depends on, by name."""
        kinds = {"weight": self.variables, "mean": self.mean, "adam": self.optimizer.variables}
        return {
            f"{kind}{i}": v for kind, variables in kinds.items() for i, v in enumerate(variables)
        }


def _padded(last_step):
    """Number of steps of a batch whose last event is in ``last_step``."""
    return int(-(-(last_step + 1 + TAIL) // LENGTHS) * LENGTHS)


def train_estimator(outputs, right, seed: int) -> Estimator:
    """Train a confidence estimator on the outputs of a network.

    The loss is the cross-entropy between its confidence and whether the largest output was right,
    over all steps.

    Parameters
    ----------
    outputs : list of ndarray, each of shape (steps, classes)
        For each sample the accumulated readout, from its start to its last event.
    right : list of ndarray of bool, each of shape (steps,)
        True where the largest output is the label's.
    seed : int
        Seed of the initial weights and of the order of the training steps.

    Returns
    -------
    Estimator
    """
    inputs = np.concatenate([estimator_inputs(sample) for sample in outputs])
    right = np.concatenate(right).astype(np.float32)
    middle, spread = inputs.mean(0), np.maximum(inputs.std(0), 1e-3)
    inputs = ((inputs - middle) / spread).astype(np.float32)
    model, untouched = _estimator_model(inputs.shape[1])
    for variable, value in zip(model.optimizer.variables, untouched, strict=True):
        variable.assign(value)
    for index, layer in enumerate(model.layers):
        layer.kernel.assign(tf.keras.initializers.GlorotUniform(seed + index)(layer.kernel.shape))
        layer.bias.assign(tf.zeros_like(layer.bias))
    rng = np.random.default_rng([seed, 0x10D6])
    for _ in range(ESTIMATOR_EPOCHS):
        order = rng.permutation(len(inputs))
        model.fit(inputs[order], right[order], batch_size=ESTIMATOR_BATCH, shuffle=False, verbose=0)
    kernels, biases = zip(*(layer.get_weights() for layer in model.layers), strict=True)
    # Fold the scaling of the inputs into the first layer.
    first = kernels[0] / spread[:, None]
    return Estimator((first, *kernels[1:]), (biases[0] - middle @ first, *biases[1:]))


@functools.lru_cache(maxsize=1)
def _estimator_model(inputs):
    """A model and the initial values of its optimiser, reused with new initial weights.

    All trainings of a process share it because tracing its training step takes a second.
    """
    layers = [tf.keras.layers.Dense(n, activation="relu" if n > 1 else None) for n in (*HIDDEN, 1)]
    model = tf.keras.Sequential([tf.keras.Input((inputs,)), *layers])
    model.compile(
        tf.keras.optimizers.Adam(ESTIMATOR_LEARNING_RATE),
        tf.keras.losses.BinaryCrossentropy(from_logits=True),
    )
    model.optimizer.build(model.trainable_variables)
    return model, [variable.numpy() for variable in model.optimizer.variables]


# --- epoch by epoch -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checkpoint:
    """The file that stores the state of a training after each epoch.

    Attributes
    ----------
    path : Path
    key : str
        Identifies the training, such as the key of the origin of the network that is trained.  A
        checkpoint with another key is overwritten.
    """

    path: Path
    key: str


def train_epochs(
    train, epochs: int, state: dict, checkpoint: Checkpoint | None = None, watch=None, advance=None
) -> list:
    """Train, and store the state after each epoch.

    Parameters
    ----------
    train : callable
        ``train(epoch) -> dict``, ``loss`` and ``accuracy`` of an epoch, counted from 0.
    epochs : int
    state : dict of str to tf.Variable or ndarray
        All values that the next epoch depends on.
    checkpoint : Checkpoint, optional
        If it has the state of this training, the training resumes from it; the result is the same
        as without the interruption.
    watch : callable, optional
        ``watch() -> dict``, further values of the epoch, on samples that are not trained on.
    advance : callable, optional
        ``advance(1, note)`` after each epoch, including those of an earlier session.

    Returns
    -------
    list of dict
        The history, one row per epoch: ``epoch``, the values of ``train``, ``seconds``, the values
        of ``watch``.

    Raises
    ------
    UserError
        The checkpoint is damaged.
    """
    history = [] if checkpoint is None else _resumed(checkpoint, state, epochs)
    if advance is not None and history:
        advance(len(history), _note(history))
    for epoch in range(len(history), epochs):
        begun = time.perf_counter()
        row = {"epoch": epoch + 1, **train(epoch), "seconds": time.perf_counter() - begun}
        history.append(row | (watch() if watch else {}))
        if checkpoint is not None:
            arrays = {name: np.asarray(variable) for name, variable in state.items()}
            text = {"key": checkpoint.key, "history": json.dumps(history)}
            texts = {name: np.array(value) for name, value in text.items()}
            write_arrays(checkpoint.path, **texts, **arrays)
        if advance is not None:
            advance(1, _note(history))
    return history


def _resumed(checkpoint, state, epochs):
    """The history of an earlier session, after restoring its state."""
    path = checkpoint.path
    if not path.exists():
        return []
    kept = read_arrays(path, FROM_THE_START)
    with reporting_damage(path, FROM_THE_START):
        if "key" not in kept or str(kept["key"]) != checkpoint.key:
            return []
        history = json.loads(str(kept["history"]))
        if len(history) > epochs:
            return []
        if [row["epoch"] for row in history] != list(range(1, len(history) + 1)):
            raise ValueError("epochs that do not follow each other")
        _note(history)
        for name, variable in state.items():
            if isinstance(variable, np.ndarray):
                variable[...] = kept[name]
            else:
                variable.assign(kept[name])
        return history


def _note(history):
    return f"accuracy {history[-1]['accuracy']:.3f}" if history else ""
