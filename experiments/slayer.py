"""Train a spiking network on events with SLAYER (paper, Section 3.2.3)."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  (Numba's products call it; its threads are limited)
from threadpoolctl import threadpool_limits

from experiments.slayer_network import SlayerNetwork, SpikeResponse
from models.architecture import parse
from pipeline.data.events import Recordings
from pipeline.paper import DURATION_S
from pipeline.training.events import Checkpoint, train_epochs


@dataclass(frozen=True)
class Slayer:
    """The recipe of a training with SLAYER (paper, Section 3.2.3).

    Attributes
    ----------
    architecture : str
        Notation as for the CNN, with a channel for each polarity.
    bins : int
        Time steps that a recording of two seconds is divided into; 10 ms each (paper).
    epochs : int
        Passes over the training samples.
    batch_size : int
        Samples per training step.  Not given in the paper; the SLAYER authors' code has 12 for this
        kind of network.
    learning_rate : float
        Not given in the paper; like the optimiser, it is from the examples of the SLAYER authors.
    true_count, false_count : float
        Desired spikes of the correct class's output neuron and of each other one (paper).
    tau_s, tau_r : float
        Time constants in seconds of a neuron's response to a spike and of its refractory response.
        Not given in the paper; the SLAYER authors' examples have 10 and 1 time steps.
    conv_scale : float
        Range of the initial weights of a convolution, in units of 1/sqrt(inputs): that of the
        SLAYER authors' code, which the paper used unmodified.  10 gives a higher accuracy.
    dense_scale : float
        Range of the initial weights of the output layer, from the same code.
    """

    architecture: str = "10x10x2-6c2-24c3-10o"
    bins: int = 200
    epochs: int = 100
    batch_size: int = 32
    learning_rate: float = 0.01
    true_count: float = 60.0
    false_count: float = 10.0
    tau_s: float = 0.1
    tau_r: float = 0.01
    conv_scale: float = 100.0
    dense_scale: float = 10.0


# In one thread: matrix products of a few steps take ten times as long in several threads on a busy
# machine.
_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")


@dataclass(frozen=True)
class TrainedSlayer:
    """A network trained with SLAYER.

    Attributes
    ----------
    kernels : list of ndarray
        See :class:`experiments.slayer_network.SlayerNetwork`.
    history : list of dict
        One row per epoch: ``epoch``, ``loss``, ``accuracy`` (of the training samples during
        training), ``test_accuracy`` (for the history only), ``seconds``.
    counts : ndarray, shape (n_test, outputs)
        Spike counts of the test samples after the last epoch; the largest is the prediction.
    """

    kernels: list
    history: list
    counts: np.ndarray


def train_slayer(
    settings: Slayer,
    frames,
    labels,
    train,
    test,
    seed: int,
    checkpoint: Checkpoint | None = None,
    advance=None,
    duration_s: float = DURATION_S,
) -> TrainedSlayer:
    """Train for all epochs, then evaluate the test samples.

    Parameters
    ----------
    settings : Slayer
    frames : ndarray of uint8, shape (n_samples, bins, rows, columns, 2)
        See :func:`bin_events`.
    labels : ndarray of int, shape (n_samples,)
    train, test : ndarray of int
        Indices of samples.
    seed : int
        Seed of the initial weights and of the order of the samples.
    checkpoint : Checkpoint, optional
        File for the state after each epoch; an interrupted training resumes from it, with the same
        result as without the interruption.  Its key must identify all arguments but the number of
        epochs, which may differ.
    advance : callable, optional
        ``advance(1, note)`` after each epoch, including those of an earlier session.
    duration_s : float
        Length of a recording, which is divided into bins.

    Returns
    -------
    TrainedSlayer

    Raises
    ------
    UserError
        The checkpoint is damaged.
    """
    trainer = Trainer(settings, frames, labels, seed, duration_s)

    def watch():
        right = trainer.count(test).argmax(1) == labels[test]
        return {"test_accuracy": float(np.mean(right))}

    history = train_epochs(
        lambda epoch: trainer.epoch(train, epoch),
        settings.epochs,
        trainer.state,
        checkpoint,
        watch,
        advance,
    )
    return TrainedSlayer(trainer.network.kernels, history, trainer.count(test))


def spike_response(settings: Slayer, duration_s: float = DURATION_S) -> SpikeResponse:
    """The neuron that the settings describe, in time steps of one bin."""
    return SpikeResponse(duration_s / settings.bins, settings.tau_s, settings.tau_r)


class Trainer:
    """The network and the optimiser."""

    def __init__(self, settings, frames, labels, seed, duration_s):
        self.settings, self.seed, self.frames, self.labels = settings, seed, frames, labels
        architecture = parse(settings.architecture)
        neuron = spike_response(settings, duration_s)
        scales = settings.conv_scale, settings.dense_scale
        self.network = SlayerNetwork(architecture, neuron, seed, *scales)
        self.optimizer = Adam(self.network.kernels, settings.learning_rate)
        outputs = np.eye(architecture.outputs, dtype=np.float32)[labels]
        self.desired = settings.false_count + outputs * (settings.true_count - settings.false_count)

    @_one_thread
    def epoch(self, train, epoch):
        """Train for one epoch; returns the mean loss and the share of right answers."""
        order = np.random.default_rng([self.seed, epoch, 0x51A]).permutation(train)
        loss, right = 0.0, 0
        for start in range(0, len(order), self.settings.batch_size):
            batch = order[start : start + self.settings.batch_size]
            batch_loss, counts, gradients = self.network.gradients(
                self.frames[batch], self.desired[batch]
            )
            self.optimizer.apply(gradients)
            loss += batch_loss * len(batch)
            right += int(np.sum(counts.argmax(1) == self.labels[batch]))
        return {"loss": loss / len(order), "accuracy": right / len(order)}

    @_one_thread
    def count(self, indices):
        """Spike counts of the outputs, shape (n, outputs)."""
        return self.network.counts(self.frames[i] for i in indices)

    @property
    def state(self):
        """All arrays that the next epoch depends on, by name; they are changed in place."""
        kernels = {f"kernel{i}": kernel for i, kernel in enumerate(self.network.kernels)}
        return kernels | self.optimizer.state


class Adam:
    """Adam with the AMSGrad variant, as in Keras (Reddi, Kale and Kumar 2018, Algorithm 2).

    Parameters
    ----------
    weights : list of ndarray of float32
        Changed in place by :meth:`apply`.
    learning_rate : float

    Attributes
    ----------
    state : dict of str to ndarray
        Its own arrays, by name, changed in place.
    """

    BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-7

    def __init__(self, weights, learning_rate: float):
        self.weights, self.learning_rate = weights, learning_rate
        self.state = {"updates": np.zeros((), np.int64)}
        for i, array in enumerate(weights):
            for name in ("mean", "square", "largest"):
                self.state[f"{name}{i}"] = np.zeros_like(array)

    def apply(self, gradients):
        """Update the weights with their gradients, a list of arrays of the same shapes."""
        self.state["updates"] += 1
        n = int(self.state["updates"])
        rate = self.learning_rate * np.sqrt(1 - self.BETA_2**n) / (1 - self.BETA_1**n)
        for i, (array, gradient) in enumerate(zip(self.weights, gradients, strict=True)):
            mean, square, largest = (self.state[f"{k}{i}"] for k in ("mean", "square", "largest"))
            mean += (gradient - mean) * np.float32(1 - self.BETA_1)
            square += (gradient**2 - square) * np.float32(1 - self.BETA_2)
            np.maximum(largest, square, out=largest)
            array -= np.float32(rate) * mean / (np.sqrt(largest) + np.float32(self.EPSILON))


def bin_events(recordings: Recordings, bins: int = 200) -> np.ndarray:
    """Frames that mark the events of each polarity in each bin (paper, Section 3.2.3).

    The bins divide a recording's duration evenly: of two seconds, 200 bins are 10 ms each.
    Several events of one taxel and polarity in one bin count as one spike.  The result is therefore
    the same whether or not the decoder's repeated columns were merged before.  Events
    after the duration are left out.

    Parameters
    ----------
    recordings : Recordings
    bins : int

    Returns
    -------
    ndarray of uint8, shape (n_samples, bins, rows, columns, 2)
        1 or 0 for each sample, bin, row and column of the tactile image, and polarity: first ON,
        then OFF, which is empty for a sensor that has only ON events.
    """
    events, taxels, sensor = recordings.events, recordings.taxels, recordings.sensor
    shape = (len(recordings), bins, sensor.rows, sensor.columns, 2)
    frames = np.zeros(shape, np.uint8)
    duration_ns = sensor.duration_s * 1e9
    time = (events.time_ns * bins / duration_ns).astype(np.int64)
    inside = (time >= 0) & (time < bins)
    taxel = events.taxel[inside]
    frames[
        recordings.sample_of_event[inside],
        time[inside],
        taxels.row[taxel],
        taxels.column[taxel],
        (events.polarity[inside] < 0).astype(np.int64),
    ] = 1
    return frames


def predictions_of(dataset, index, seed: int, conv_scale: float, checkpoint: Path) -> tuple:
    """Train on the events of a data set, and predict the classes of some of its samples.

    Parameters
    ----------
    dataset : pipeline.data.dataset.Dataset
    index : ndarray of int
        Samples to predict.
    seed : int
    conv_scale : float
        See :class:`Slayer`.
    checkpoint : Path
        File for the state after each epoch, from which an interrupted training goes on.

    Returns
    -------
    predictions : ndarray of int, shape (n,)
    history : list of dict
        See :class:`TrainedSlayer`.
    """
    recordings, sensor = dataset.recordings, dataset.recordings.sensor
    layers = Slayer().architecture.split("-")[1:-1]
    size = f"{sensor.rows}x{sensor.columns}x2"
    architecture = "-".join([size, *layers, f"{len(sensor.classes)}o"])
    recipe = Slayer(architecture=architecture, conv_scale=conv_scale)
    frames = bin_events(recordings, recipe.bins)
    made_from = f"{recipe} {seed} {dataset.origin.key}"
    trained = train_slayer(
        recipe,
        frames,
        recordings.labels,
        dataset.split.train,
        index,
        seed,
        Checkpoint(checkpoint, hashlib.sha256(made_from.encode()).hexdigest()),
        duration_s=sensor.duration_s,
    )
    return trained.counts.argmax(1), trained.history
