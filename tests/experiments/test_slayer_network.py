"""SLAYER against a plain NumPy version written from the paper's sums, and finite differences."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.slayer import Slayer, SlayerNetwork, fire
from models.keras.keras2 import tf
from tests.untraced import untraced

NEURON = Slayer(tau_s=4.0, tau_r=2.0, theta=2.0)
STEPS = 30


@pytest.fixture(autouse=True)
def as_written():
    with untraced():
        yield


def alpha(steps, tau):
    """The kernel of unit peak t/tau exp(1 - t/tau), tau in steps."""
    t = np.arange(steps)
    return t / tau * np.exp(1 - t / tau)


def convolve(kernel, signal):
    """Convolution along the first axis, as a sum over all pairs of times."""
    out = np.zeros_like(signal)
    for t in range(len(signal)):
        for k in range(t + 1):
            out[t] += kernel[t - k] * signal[k]
    return out


class Reference:
    """One neuron at a time, one step at a time, in double precision."""

    def __init__(self, neuron, steps):
        self.neuron = neuron
        self.eps = alpha(steps, neuron.tau_s)
        self.nu = -neuron.scale_ref * neuron.theta * alpha(steps, neuron.tau_r)

    def fire(self, current):
        potential, spikes = current.copy(), np.zeros_like(current)
        for index in np.ndindex(current.shape[1:]):
            for t in range(len(current)):
                at = (t, *index)
                if potential[at] >= self.neuron.theta:
                    spikes[at] = 1
                    for later in range(t, len(current)):
                        potential[(later, *index)] += self.nu[later - t]
        return spikes, potential

    def rho(self, potential):
        tau = self.neuron.tau_rho * self.neuron.theta
        return self.neuron.scale_rho / tau * np.exp(-np.abs(potential - self.neuron.theta) / tau)

    def smooth_spike(self, potential):
        """The antiderivative of rho: what SLAYER differentiates in place of a spike."""
        tau = self.neuron.tau_rho * self.neuron.theta
        x = (potential - self.neuron.theta) / tau
        return self.neuron.scale_rho * np.where(x < 0, np.exp(-abs(x)), 2 - np.exp(-abs(x)))


def weigh(response, kernel, layer=None):
    """The weighted sums of a layer, of shape (steps, ...)."""
    if kernel.ndim == 2:
        return response.reshape(len(response), -1) @ kernel
    before = response.shape[1:]
    frames = np.pad(response, [(0, 0), *layer.compute_padding(before), (0, 0)])
    out = np.zeros((len(frames), *layer.compute_shape(before)))
    for y, x in np.ndindex(out.shape[1:3]):
        row, column = y * layer.stride, x * layer.stride
        window = frames[:, row : row + layer.kernel_size, column : column + layer.kernel_size]
        out[:, y, x] = np.tensordot(window, kernel, 3)
    return out


def pooled(response, size):
    """Means over windows that do not overlap."""
    if size == 1:
        return response
    rows, columns = (n // size for n in response.shape[1:3])
    inside = response[:, : rows * size, : columns * size]
    return inside.reshape(len(response), rows, size, columns, size, -1).mean((2, 4))


@pytest.fixture(scope="module")
def reference():
    return Reference(NEURON, STEPS)


def one_layer(weights, seed):
    """A network of an output layer alone, with the input spikes (steps, 1, 1, n) of a sample."""
    network = network_of(f"1x1x{len(weights)}-{weights.shape[1]}o")
    network.kernels[0].assign(weights)
    spikes = np.random.default_rng(seed).random((STEPS, 1, 1, len(weights))) < 0.2
    return network, spikes


def network_of(notation, seed=0, **scales):
    return SlayerNetwork(dataclasses.replace(NEURON, architecture=notation, **scales), seed)


def layers_of(network, sample):
    """Potential and spikes of each layer for one sample."""
    layers = network.compute_layers(sample[:, None])
    return [(potential.numpy()[:, 0], spikes.numpy()[:, 0]) for potential, spikes in layers]


def test_a_single_spike_gives_the_kernel_of_unit_peak():
    spikes = np.zeros((STEPS, 1, 1, 1))
    spikes[0] = 1
    network, _ = one_layer(np.ones((1, 2)), 0)
    potential = layers_of(network, spikes)[0][0][:, 0]
    assert potential.argmax() == 4  # tau_s is 4 steps
    assert potential.max() == pytest.approx(1, abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_layer_fires_as_in_numpy(reference, seed):
    weights = np.random.default_rng([seed, 1]).normal(0.5, 1, (6, 5)).astype(np.float32)
    network, arriving = one_layer(weights, seed)
    current = weigh(convolve(reference.eps, arriving.astype(float)), weights.astype(float))
    spikes, potential = reference.fire(current)
    if np.abs(potential - NEURON.theta).min() < 1e-4:
        return  # too close to call in single precision
    ((result, fired),) = layers_of(network, arriving)
    np.testing.assert_allclose(result, potential, atol=1e-4)
    np.testing.assert_array_equal(fired, spikes)


def test_refractory_response_separates_spikes():
    """By hand: 3 - 4 k/2 exp(1 - k/2) is 2 or more again from k = 8 steps after a spike on."""
    decay = np.exp(-1 / 4)
    network, _ = one_layer(np.full((1, 2), 3 / (np.e / 4 * decay / (1 - decay) ** 2)), 0)
    ((_, spikes),) = layers_of(network, np.ones((140, 1, 1, 1)))  # a potential of 3 after 60 steps
    assert set(np.diff(np.flatnonzero(spikes[60:, 0]))) == {8}


@pytest.mark.parametrize("distance", [0.0, 0.3, -1.7, 20.0, -60.0])
def test_the_gradient_of_a_spike_is_the_escape_rate(distance):
    """The gradient of a spike in the second step, for the weighted spikes of the first."""
    kernel = np.e / 4 * np.exp(-1 / 4)  # t = 1, tau_s = 4 steps
    drive = tf.constant([[NEURON.theta * (1 + distance) / kernel], [0]], tf.float32)
    with tf.GradientTape() as tape:
        tape.watch(drive)
        last = fire(drive, NEURON)[1][1]
    expected = np.exp(-abs(distance)) / NEURON.theta * kernel
    assert float(tape.gradient(last, drive)[0, 0]) == pytest.approx(expected, rel=1e-5, abs=1e-12)


NETWORKS = {
    "two convolutions": ("5x5x2-3c2-4c3-3o", 16),
    "pooling, stride, padding": ("9x7x2-4c3s2p-2a-5c2p-3o", 60),
    "pooling before dense layers": ("7x7x2-8c3p-3a-6-3o", 16),
}


@pytest.fixture(params=NETWORKS.values(), ids=NETWORKS)
def small(request):
    notation, scale = request.param
    network = network_of(notation, 7, conv_scale=scale, dense_scale=28)
    shape = (2, STEPS, *network.architecture.input_shape)
    samples = (np.random.default_rng(5).random(shape) < 0.1).astype(np.uint8)
    return network, np.moveaxis(samples, 0, 1)


def forward(reference, network, kernels, sample, smooth_around=None):
    """All layers for one sample.

    With ``smooth_around`` (the potentials of an earlier call) spikes are those of the earlier call
    plus the change of the smooth spike, whose derivative there is rho.
    """
    response, held, potentials, spikes = convolve(reference.eps, sample.astype(float)), [], [], []
    remaining = iter(enumerate(kernels))
    for layer in network.architecture.layers:
        if layer.kind == "pool":
            response = pooled(response, layer.size)
            continue
        i, kernel = next(remaining)
        current = weigh(response, kernel, layer)
        if smooth_around is None:
            fired, potential = reference.fire(current)
        else:
            before = smooth_around["potential"][i]
            potential = current + smooth_around["held"][i]
            change = reference.smooth_spike(potential) - reference.smooth_spike(before)
            fired = smooth_around["spikes"][i] + change
        held.append(potential - current)
        potentials.append(potential)
        spikes.append(fired)
        response = convolve(reference.eps, fired)
    return {"response": response, "held": held, "potential": potentials, "spikes": spikes}


def test_network_agrees_with_numpy_layer_by_layer(reference, small):
    network, events = small
    kernels = [k.numpy().astype(float) for k in network.kernels]
    for sample in np.moveaxis(events, 1, 0):
        expected = forward(reference, network, kernels, sample)
        layers = zip(
            layers_of(network, sample), expected["spikes"], expected["potential"], strict=True
        )
        for (potential, fired), spikes, expected_potential in layers:
            assert spikes.sum() >= 5, "a layer that hardly fires tests nothing"
            np.testing.assert_array_equal(fired, spikes)
            np.testing.assert_allclose(potential, expected_potential, atol=2e-4)


def test_weight_gradients_agree_with_finite_differences(reference, small):
    """Of the loss's gradient through all layers, in both kinds of weights."""
    network, events = small
    desired = np.array([[8.0, 1, 1], [1, 1, 8]], np.float32)
    loss, counts, gradients = network.compute_gradients(events, desired)
    kernels, samples = [k.numpy().astype(float) for k in network.kernels], np.moveaxis(events, 1, 0)
    bases = [forward(reference, network, kernels, sample) for sample in samples]
    np.testing.assert_array_equal(counts, [b["spikes"][-1].sum(0) for b in bases])
    errors = [(b["spikes"][-1].sum(0) - d) / STEPS for b, d in zip(bases, desired, strict=True)]
    expected_loss = np.mean([0.5 * STEPS * (e**2).sum() for e in errors])
    assert float(loss) == pytest.approx(expected_loss, rel=1e-5)

    def functional(kernels):
        outputs = [
            forward(reference, network, kernels, sample, base)["response"]
            for sample, base in zip(samples, bases, strict=True)
        ]
        return np.mean([(o * e).sum() for o, e in zip(outputs, errors, strict=True)])

    rng = np.random.default_rng(6)
    for layer, gradient in enumerate(g.numpy() for g in gradients):
        assert np.abs(gradient).max() > 1e-3
        for _ in range(6):
            index = tuple(rng.integers(0, n) for n in kernels[layer].shape)
            difference = 0.0
            for sign in (1, -1):
                moved = [k.copy() for k in kernels]
                moved[layer][index] += sign * 1e-5
                difference += sign * functional(moved) / 2e-5
            assert float(gradient[index]) == pytest.approx(difference, rel=2e-3, abs=1e-5)


def test_kernels_have_the_shapes_of_the_notation():
    network = SlayerNetwork(Slayer(architecture="10x10x2-6c2-24c3-10o"))
    assert [tuple(k.shape) for k in network.kernels] == [
        (2, 2, 2, 6),
        (3, 3, 6, 24),
        (7 * 7 * 24, 10),
    ]
