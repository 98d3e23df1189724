"""A network that was trained on events: its predictions, and when it may decide early."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from deploy.network.decision import Estimator, Threshold, choose_threshold, delay_outputs
from deploy.network.stimulus import find_last_steps
from models.architecture import parse_architecture
from models.keras.keras2 import tf
from models.spiking.network import SpikingNetwork, count_operations
from pipeline.settings import Settings
from pipeline.training.events.design import EventDesign

# Number of augmented copies of each held-out sample that are used, with the sample itself, to
# choose the threshold for an early decision. Half a percentage point of a few hundred samples is
# two or three samples, so a choice on these alone would overestimate the accuracy.
COPIES = 4


@dataclass(frozen=True)
class TrainedOnEvents:
    """A trained network, with methods to run it.

    Attributes
    ----------
    design : EventDesign
    weights : dict of str to ndarray
        See :meth:`models.spiking.network.SpikingNetwork.get_weights`; also the arrays of the
        confidence estimator (:class:`deploy.network.decision.Estimator`).
    history : list of dict
        One row per epoch: ``epoch``, ``loss`` (without the penalty), ``accuracy`` and
        ``operations`` (in multiples of the CNN's) on the augmented training samples, ``seconds``,
        and ``val_accuracy`` and ``val_operations`` if there are validation samples.
    """

    design: EventDesign
    weights: dict
    history: list = field(default_factory=list)

    @classmethod
    def from_weights(cls, settings: Settings, weights: dict) -> TrainedOnEvents:
        """The network with given weights that was trained with some settings."""
        return cls(EventDesign.from_settings(settings), weights)

    def run_on_frames(self, frames, advance=None) -> NetworkOutputs:
        """Outputs, operations and spikes on event frames; see :func:`run_on_frames`."""
        return run_on_frames(self.design, self.weights, frames, advance)

    @property
    def estimator(self) -> Estimator:
        """The confidence estimator."""
        return Estimator.from_arrays(
            self.weights, parse_architecture(self.design.architecture).outputs
        )

    def choose_threshold(
        self, table, labels, held_out, n_steps: int, seed: int, loss: float
    ) -> Threshold:
        """Choose the threshold for early decisions on held-out samples.

        The samples and their augmented copies have equal weight in the choice; see
        :func:`deploy.network.decision.choose_threshold`.

        Parameters
        ----------
        table : EventTable
        labels : ndarray of int, shape (n_samples,)
        held_out : ndarray of int
            Indices of the held-out samples, which the network was not trained on.
        n_steps : int
            Number of steps for which each sample is presented.
        seed : int
            Seed of the data augmentation.
        loss : float
            Largest loss of accuracy by early decisions.
        """
        with_copies = np.tile(held_out, COPIES)
        rng = np.random.default_rng([seed, 0x7E57])
        events = self.design.alter_samples(rng, table, with_copies)
        altered = self.design.make_frames(events, len(with_copies), n_steps, table.size)
        as_they_are = self.design.make_frames_of_samples(table, held_out, n_steps)
        frames = np.moveaxis(np.concatenate([as_they_are, altered], 1), 0, 1)
        result = self.run_on_frames(frames)
        return choose_threshold(
            delay_as_on_chip(result.outputs, self.design),
            np.asarray(labels)[np.concatenate([held_out, with_copies])],
            result.last_step,
            loss,
            estimator=self.estimator,
            weights=np.repeat([1, 1 / COPIES], [len(held_out), len(with_copies)]),
        )

    def compute_logits(self, frames) -> np.ndarray:
        """Outputs at the last step, delayed as on the chip, shape (n_samples, classes)."""
        return delay_as_on_chip(self.run_on_frames(frames).outputs, self.design)[:, -1]


@dataclass(frozen=True)
class NetworkOutputs:
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


def run_on_frames(design: EventDesign, weights: dict, frames, advance=None) -> NetworkOutputs:
    """Run a trained network on event frames in the chip's integers, each sample from rest.

    Parameters
    ----------
    design : EventDesign
    weights : dict
        Weights of a :class:`TrainedOnEvents`.
    frames : ndarray of uint8, shape (n_samples, steps, rows, columns, channels)
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    NetworkOutputs
    """
    network = build_network(design, weights)
    run = _compile(design)
    values = _read_values(network.variables_by_name)
    by_batch = []
    for start in range(0, len(frames), 100):
        batch = frames[start : start + 100]
        outputs, costs, spikes = run(np.moveaxis(batch, 0, 1), values)
        by_batch.append(
            (np.moveaxis(outputs.numpy(), 0, 1), costs.numpy(), *(s.numpy() for s in spikes))
        )
        if advance is not None:
            advance(len(batch))
    outputs, costs, *spikes = (np.concatenate(column) for column in zip(*by_batch, strict=True))
    named = {n: s.astype(np.int32) for n, s in zip(network.names, spikes, strict=True)}
    return NetworkOutputs(outputs.astype(np.float32), costs, named, find_last_steps(frames))


def build_network(design: EventDesign, weights: dict) -> SpikingNetwork:
    """The network of a design with trained weights."""
    network = design.make_network()
    network.set_weights(weights)
    return network


def delay_as_on_chip(outputs, design: EventDesign) -> np.ndarray:
    """Delay outputs as on the chip, where the relay and every layer take one step each.

    Parameters
    ----------
    outputs : ndarray, shape (..., steps, outputs)
        Outputs of the trained network, which has no delays.
    design : EventDesign

    Returns
    -------
    ndarray of the same shape
    """
    return delay_outputs(outputs, len(parse_architecture(design.architecture).spiking) + 1)


def _compile(design):
    """``run(frames, values)``: outputs, operations per sample, spikes per neuron, in float64."""
    return _compile_network(design.architecture, design.neuron, design.section_starts)


@functools.lru_cache(maxsize=8)
def _compile_network(architecture, neuron, section_starts):
    # For any weights: networks of the same shape share one compilation, which takes seconds.
    network = SpikingNetwork(
        parse_architecture(architecture), neuron, section_starts=section_starts
    )
    variables = {
        name: tf.TensorSpec(v.shape, v.dtype) for name, v in network.variables_by_name.items()
    }

    @tf.function(autograph=False, input_signature=(_make_frames_signature(network), variables))
    def run(frames, values):
        outputs, spikes = network(frames, dtype=tf.float64, values=values)
        costs = count_operations(network.architecture, frames, spikes)
        return outputs, costs, [tf.reduce_sum(layer, 0) for layer in spikes]

    return run


def _make_frames_signature(network):
    """A tensor specification of frames with any number of steps, so that tracing occurs once."""
    return tf.TensorSpec((None, None, *network.architecture.input_shape), tf.uint8)


def _read_values(variables):
    """Current values of the variables, for :func:`_compile`."""
    return {name: tf.convert_to_tensor(variable) for name, variable in variables.items()}
