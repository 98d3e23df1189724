"""The compiled gradients against those of TensorFlow."""

import numpy as np
import pytest

from models import ops
from models.architecture import parse_architecture
from models.keras.keras2 import tf
from models.spiking.gradient import Batch, SpikingGradient
from models.spiking.network import SpikingNetwork, count_operations
from tests.extensions.test_from_outside import OneToOne
from tests.models.test_spiking import ARCHITECTURES, frames_for, network_of

EARLY, PRICE = 0.7, 1e-4


def values_of(network):
    return {name: value.numpy() for name, value in network.variables_by_name.items()}


def batch_for(network, samples=6, steps=40):
    rng = np.random.default_rng(2)
    frames = frames_for(network, samples, steps)
    dropout_factors = [
        ((rng.random((samples, neurons)) < 0.8) / 0.8).astype(np.float32)
        for neurons in network.architecture.n_values.values()
    ][:-1]
    labels = rng.integers(0, network.architecture.outputs, samples)
    last_step = rng.integers(10, steps - 3, samples)
    return Batch(np.moveaxis(frames, 0, 1), labels, last_step, dropout_factors)


def in_tensorflow(network, batch):
    """Sum of the losses, and the gradients with the price on operations, by TensorFlow."""
    frames = np.moveaxis(batch.frames, 0, 1)
    with tf.GradientTape() as tape:
        outputs, spikes = network(
            tf.constant(frames), [tf.constant(factors) for factors in batch.dropout_factors]
        )
        labels = tf.tile(tf.constant(batch.labels)[None], (len(frames), 1))
        loss_at = tf.nn.sparse_softmax_cross_entropy_with_logits(labels, outputs)
        writing = (np.arange(len(frames))[:, None] <= batch.last_step).astype(np.float32)
        mean = tf.reduce_sum(loss_at * writing, 0) / writing.sum(0)
        loss = tf.reduce_sum(loss_at[-1] + EARLY * mean)
        cost = tf.reduce_sum(count_operations(network.architecture, frames, spikes))
        total = loss + PRICE * cost
    gradients = tape.gradient(total, network.variables_in_order)
    named = zip(network.variables_by_name, gradients, strict=True)
    return float(loss), float(cost), {name: np.asarray(gradient) for name, gradient in named}


@pytest.mark.parametrize("text", [*ARCHITECTURES, "6x6x1-20-own-3o"])
def test_gradients_are_those_of_tensorflow(text, monkeypatch):
    monkeypatch.setitem(ops.OPERATIONS, "own", OneToOne)
    network = network_of(text)
    batch = batch_for(network)
    compiled = SpikingGradient(network.architecture, network.neuron)
    result = compiled.compute_gradients(values_of(network), batch, EARLY, PRICE)
    loss, cost, gradients = in_tensorflow(network, batch)
    assert result.operations == pytest.approx(cost, rel=1e-3)
    assert result.loss == pytest.approx(loss, rel=1e-2)
    assert result.gradients.keys() == gradients.keys()
    for name, expected in gradients.items():
        actual = result.gradients[name]
        assert np.shape(actual) == expected.shape
        size = np.abs(expected).max()
        assert size > 0
        np.testing.assert_allclose(actual, expected, atol=0.02 * size, err_msg=name)


@pytest.mark.parametrize("text", ARCHITECTURES)
def test_outputs_are_those_of_tensorflow(text):
    network = network_of(text)
    frames = frames_for(network, 6, 40)
    outputs, spikes = network(tf.constant(frames))
    compiled = SpikingGradient(network.architecture, network.neuron)
    result, cost, rates = compiled.compute_outputs(values_of(network), np.moveaxis(frames, 0, 1))
    for layer, expected in zip(rates, spikes, strict=True):
        assert np.mean(layer != expected.numpy().sum(0)) < 0.01
    assert np.abs(result - np.moveaxis(outputs.numpy(), 0, 1)).mean() < 0.01
    expected = count_operations(network.architecture, frames, spikes).numpy().sum(1)
    np.testing.assert_allclose(cost, expected, rtol=1e-2)


def test_sections_of_the_readout():
    network = SpikingNetwork(
        parse_architecture("6x6x1-20-12-3o"), seed=3, section_starts=(0, 10, 23)
    )
    for name in network.names:
        kernel = network.variables_by_name[f"{name}.kernel"]
        kernel.assign(2.5 * kernel)
    batch = batch_for(network)
    compiled = SpikingGradient(network.architecture, network.neuron, network.section_starts)
    result = compiled.compute_gradients(values_of(network), batch, EARLY, PRICE)
    _, _, gradients = in_tensorflow(network, batch)
    expected = gradients["output.kernel"]
    np.testing.assert_allclose(
        result.gradients["output.kernel"], expected, atol=0.02 * np.abs(expected).max()
    )
