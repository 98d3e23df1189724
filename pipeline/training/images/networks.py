"""The networks on images, before and after their training."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from deploy.errors import UserError
from deploy.network.chip import DT
from models.architecture import parse_architecture
from models.chain import make_links
from models.cnn import (
    RateLIF,
    build_cnn,
    compute_activations,
    compute_logits,
    find_gain,
    set_weights,
)
from models.keras.keras2 import tf
from pipeline.settings import Settings

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
        return compute_logits(self._model, inputs)

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
        return build_cnn(parse_architecture(settings.cnn.architecture))


class TrainedRates(TrainedNetwork):
    """The network with rate-LIF neurons; an activation of 1 means ``max_rate``."""

    @staticmethod
    def build(settings: Settings) -> tf.keras.Model:
        """Build the network without its trained weights."""
        return build_rate_network(settings)


def build_rate_network(settings: Settings) -> tf.keras.Model:
    """Build the network with rate-LIF neurons, as ``snn.recipe`` defines it."""
    snn = settings.snn
    architecture = parse_architecture(settings.cnn.architecture)
    on_chip = snn.is_on_chip
    is_noisy = snn.recipe == "loihi"
    costs = None
    if is_noisy and snn.spike_penalty:
        costs = _compute_spike_costs(settings, architecture)

    def make_neurons(index):
        return RateLIF(
            snn.get_max_rate(index),
            snn.tau_rc,
            snn.tau_ref,
            on_chip=on_chip,
            noise=snn.noise if is_noisy else 0.0,
            dropout=snn.dropout if is_noisy else 0.0,
            spike_costs=None if costs is None else costs[index],
        )

    def find_layer_gain(index):
        return find_gain(snn.get_max_rate(index), snn.tau_rc, snn.tau_ref)

    for rate in snn.max_rates:
        try:
            find_gain(rate, snn.tau_rc, snn.tau_ref)
        except ValueError as error:
            raise UserError(f"settings: snn.max_rates: {error}") from error
    return build_cnn(architecture, make_neurons, find_layer_gain if on_chip else None)


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
