"""Training: the paper's CNN, and the same network with rate-based LIF neurons."""

from __future__ import annotations

import csv
from dataclasses import dataclass

import numpy as np
import tensorflow as tf

from deploy.errors import UserError
from deploy.files import replacing
from models.cnn import build_cnn, get_weights, predict, set_weights
from models.lif import RateLIF
from models.notation import parse
from models.quantised import EightBitConv2D
from pipeline.settings import Settings

PERCENTILE = 99.9
"""Of a layer's activations that becomes 1 when a CNN's weights are carried over."""


@dataclass(frozen=True)
class Trained:
    """A trained network.

    Attributes
    ----------
    weights : dict of str to ndarray
        See :func:`models.cnn.get_weights`.
    history : list of dict
        One row an epoch: ``epoch``, ``loss``, ``accuracy``, and ``val_loss`` and ``val_accuracy``
        where there are validation samples.
    """

    weights: dict
    history: list


def train_cnn(settings: Settings, data, seed: int, validation=None, advance=None) -> Trained:
    """Train the paper's CNN (Section 3.2.1).

    Parameters
    ----------
    settings : Settings
    data : (images, labels)
        Of the training samples.
    seed : int
        Same seed, same machine: same weights.
    validation : (images, labels), optional
        Only watched.
    advance : callable, optional
        ``advance(1, note)`` after each epoch.

    Returns
    -------
    Trained
    """
    make_deterministic(seed)
    model = build_cnn(parse(settings.cnn.architecture))
    history = fit(model, settings.cnn, data, validation, advance)
    return Trained(get_weights(model), history)


def build_rate_network(settings: Settings) -> tf.keras.Model:
    """The network with rate-based LIF neurons, as the recipe wants it."""
    snn = settings.snn
    on_chip = snn.recipe == "loihi"
    try:
        return build_cnn(
            parse(settings.cnn.architecture),
            activation=lambda index: RateLIF(
                snn.max_rate(index), snn.tau_rc, snn.tau_ref, whole_steps=on_chip
            ),
            convolution=EightBitConv2D if on_chip else None,
        )
    except ValueError as error:
        raise UserError(f"settings: snn.max_rates: {error}") from error


def train_rate_network(
    settings: Settings, data, seed: int, cnn_weights=None, validation=None, advance=None
) -> Trained:
    """Train with rate-based LIF neurons (paper, Section 3.2.2).

    With ``recipe = "paper"`` from new weights; with ``"loihi"`` from the CNN's, scaled so that the
    activations fit the neurons' range, with the chip's rates and weights in the forward pass.

    Parameters
    ----------
    settings, data, seed, validation, advance
        As in :func:`train_cnn`.
    cnn_weights : dict, optional
        Needed for ``"loihi"``.

    Returns
    -------
    Trained
    """
    make_deterministic(seed)
    model = build_rate_network(settings)
    if settings.snn.recipe == "loihi":
        set_weights(model, scale_to_unit(settings, cnn_weights, data[0]))
    history = fit(model, settings.snn, data, validation, advance)
    return Trained(get_weights(model), history)


def scale_to_unit(settings: Settings, weights: dict, images) -> dict:
    """Scale a ReLU network's weights so that each layer's activations reach 1.

    The function of the network is unchanged: what a layer's weights are divided by, the next
    layer's are multiplied with.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Of the CNN.
    images : ndarray
        Training images, on which the activations are measured.
    """
    architecture = parse(settings.cnn.architecture)
    model = build_cnn(architecture)
    set_weights(model, weights)
    names = [f"conv{index + 1}" for index in range(len(architecture.convs))]
    probe = tf.keras.Model(model.input, [model.get_layer(f"{n}_neurons").output for n in names])
    outputs = probe.predict(images, batch_size=512, verbose=0)
    outputs = outputs if isinstance(outputs, list) else [outputs]
    scaled, before = dict(weights), 1.0
    for name, output in zip(names, outputs, strict=True):
        scale = max(float(np.percentile(output, PERCENTILE)), 1e-6)
        scaled[f"{name}.kernel"] = weights[f"{name}.kernel"] * before / scale
        scaled[f"{name}.bias"] = weights[f"{name}.bias"] / scale
        before = scale
    scaled["output.kernel"] = weights["output.kernel"] * before
    return scaled


def fit(model, training, data, validation=None, advance=None) -> list:
    """Train a model that puts out logits: sparse categorical cross-entropy, RMSProp.

    Parameters
    ----------
    model : tf.keras.Model
    training : settings with ``epochs``, ``batch_size`` and ``learning_rate``
    data, validation : (images, labels)
    advance : callable, optional

    Returns
    -------
    list of dict
        The history, one row an epoch.
    """
    model.compile(
        tf.keras.optimizers.RMSprop(training.learning_rate),
        tf.keras.losses.SparseCategoricalCrossentropy(from_logits=True),
        metrics=["accuracy"],
    )
    history = []

    class Rows(tf.keras.callbacks.Callback):
        def on_epoch_end(self, epoch, logs=None):
            history.append({"epoch": epoch + 1, **{k: float(v) for k, v in logs.items()}})
            if advance is not None:
                advance(1, f"accuracy {logs['accuracy']:.3f}")

    model.fit(
        *data,
        batch_size=training.batch_size,
        epochs=training.epochs,
        validation_data=validation,
        callbacks=[Rows()],
        verbose=0,
    )
    return history


def make_deterministic(seed: int):
    """Same seed, same machine: same weights."""
    tf.keras.backend.clear_session()
    tf.keras.utils.set_random_seed(seed)
    tf.config.experimental.enable_op_determinism()


def cnn_logits(settings: Settings, weights: dict, images) -> np.ndarray:
    """Logits of the CNN, shape (n_samples, 10)."""
    model = build_cnn(parse(settings.cnn.architecture))
    set_weights(model, weights)
    return predict(model, images)


def rate_logits(settings: Settings, weights: dict, images) -> np.ndarray:
    """Logits of the rate-based network, shape (n_samples, 10)."""
    model = build_rate_network(settings)
    set_weights(model, weights)
    return predict(model, images)


def write_history(path, history: list):
    """Write a training's history as CSV, one row an epoch."""
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, fieldnames=list(history[0]))
        writer.writeheader()
        writer.writerows(history)
