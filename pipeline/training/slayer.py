"""Train a spiking network on events with SLAYER (paper, Section 3.2.3)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from models.architecture import parse
from models.keras2 import tf
from models.slayer import SlayerNetwork, SpikeResponse, spike_count_loss, spike_counts
from pipeline.paper import DURATION_S
from pipeline.settings import Slayer
from pipeline.training.checkpoint import Checkpoint, train_epochs


@dataclass(frozen=True)
class TrainedSlayer:
    """A network trained with SLAYER.

    Attributes
    ----------
    kernels : list of ndarray
        See :class:`models.slayer.SlayerNetwork`.
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
    checkpoint=None,
    advance=None,
    duration_s: float = DURATION_S,
) -> TrainedSlayer:
    """Train for all epochs, then evaluate the test samples.

    Parameters
    ----------
    settings : Slayer
    frames : ndarray of uint8, shape (n_samples, bins, rows, columns, 2)
        See :func:`pipeline.inputs.frames.bin_events`.
    labels : ndarray of int, shape (n_samples,)
    train, test : ndarray of int
        Indices of samples.
    seed : int
        Seed of the initial weights and of the order of the samples.
    checkpoint : path-like, optional
        File for the state after each epoch; an interrupted training resumes from it, with the same
        result as without the interruption.
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
    trainer = _Trainer(settings, frames, labels, seed, duration_s)
    kept = None
    if checkpoint is not None:
        key = _identity(settings, labels, train, test, seed, duration_s)
        kept = Checkpoint(Path(checkpoint), key)

    def watch():
        right = trainer.count(test).argmax(1) == labels[test]
        return {"test_accuracy": float(np.mean(right))}

    history = train_epochs(
        lambda epoch: trainer.epoch(train, epoch),
        settings.epochs,
        trainer.state,
        kept,
        watch,
        advance,
    )
    kernels = [kernel.numpy() for kernel in trainer.network.kernels]
    return TrainedSlayer(kernels, history, trainer.count(test))


def spike_response(settings: Slayer, duration_s: float = DURATION_S) -> SpikeResponse:
    """The neuron that the settings describe, in time steps of one bin."""
    return SpikeResponse(duration_s / settings.bins, settings.tau_s, settings.tau_r)


class _Trainer:
    """The network, the optimiser, and the compiled steps."""

    def __init__(self, settings, frames, labels, seed, duration_s):
        self.settings, self.seed, self.labels = settings, seed, labels
        architecture = parse(settings.architecture)
        neuron = spike_response(settings, duration_s)
        scales = settings.conv_scale, settings.dense_scale
        self.network = network = SlayerNetwork(architecture, neuron, seed, *scales)
        self.optimizer = tf.keras.optimizers.Adam(settings.learning_rate, amsgrad=True)
        self.optimizer.build(network.kernels)
        outputs = np.eye(network.architecture.outputs, dtype=np.float32)[labels]
        self.desired = settings.false_count + outputs * (settings.true_count - settings.false_count)
        # On the CPU even if there is a GPU: the frames stay in host memory as bytes.
        with tf.device("CPU"):
            frames = tf.constant(frames)

        @tf.function(autograph=False)
        def step(indices, desired):
            with tf.GradientTape() as tape:
                response, potential = network(tf.gather(frames, indices))
                loss = spike_count_loss(response, potential, desired, network.neuron)
            gradients = tape.gradient(loss, network.kernels)
            self.optimizer.apply_gradients(zip(gradients, network.kernels, strict=True))
            return loss, spike_counts(potential, network.neuron)

        @tf.function(autograph=False)
        def count(indices):
            _, potential = network(tf.gather(frames, indices))
            return spike_counts(potential, network.neuron)

        self._step, self._count = step, count

    def epoch(self, train, epoch):
        """Train for one epoch; returns the mean loss and the share of right answers."""
        order = np.random.default_rng([self.seed, epoch, 0x51A]).permutation(train)
        loss, right = 0.0, 0
        for batch in self._batches(order):
            batch_loss, counts = self._step(batch, self.desired[batch])
            loss += float(batch_loss) * len(batch)
            right += int(np.sum(counts.numpy().argmax(1) == self.labels[batch]))
        return {"loss": loss / len(order), "accuracy": right / len(order)}

    def count(self, indices):
        """Spike counts of the outputs, shape (n, outputs)."""
        return np.concatenate([self._count(batch).numpy() for batch in self._batches(indices)])

    def _batches(self, indices):
        size = self.settings.batch_size
        return (indices[start : start + size] for start in range(0, len(indices), size))

    @property
    def state(self):
        """All variables that the next epoch depends on, by name."""
        kinds = {"kernel": self.network.kernels, "optimizer": self.optimizer.variables}
        return {
            f"{kind}{i}": v for kind, variables in kinds.items() for i, v in enumerate(variables)
        }


def _identity(settings, labels, train, test, seed, duration_s):
    """Values that must match for a checkpoint to be resumed; the number of epochs may differ."""
    plain = {**asdict(settings), "epochs": None, "seed": seed}
    parts = [np.asarray(part).astype(int) for part in (labels, train, test)]
    sums = [int(np.dot(part, np.arange(1, len(part) + 1)) % (1 << 61)) for part in parts]
    return json.dumps([plain, asdict(spike_response(settings, duration_s)), sums])
