"""SLAYER against a plain NumPy version written from the paper's sums, and finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import slayer_kernels
from experiments import slayer_network as slayer
from experiments.slayer import Adam
from models import architecture

NEURON = slayer.SpikeResponse(tau_s=0.04, tau_r=0.02, theta=2.0)
STEPS = 30


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
        self.eps = alpha(steps, neuron.tau_s / neuron.dt)
        self.nu = -neuron.scale_ref * neuron.theta * alpha(steps, neuron.tau_r / neuron.dt)

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


def weigh(response, kernel, folded=None):
    """The weighted sums of a layer, of shape (steps, ...)."""
    if kernel.ndim == 2:
        return response.reshape(len(response), -1) @ kernel
    layer = folded.layer
    frames = np.pad(response, [(0, 0), *layer.pads(folded.pooled_shape), (0, 0)])
    out = np.zeros((len(frames), *folded.shape))
    for y, x in np.ndindex(folded.shape[:2]):
        row, column = y * layer.stride, x * layer.stride
        window = frames[:, row : row + layer.kernel, column : column + layer.kernel]
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
    network = slayer.SlayerNetwork(
        architecture.parse(f"1x1x{len(weights)}-{weights.shape[1]}o"), NEURON
    )
    network.kernels[0][:] = weights
    spikes = np.random.default_rng(seed).random((STEPS, 1, 1, len(weights))) < 0.2
    return network, spikes


def test_a_single_spike_gives_the_kernel_of_unit_peak():
    spikes = np.zeros((STEPS, 1, 1, 1))
    spikes[0] = 1
    network, _ = one_layer(np.ones((1, 2)), 0)
    potential = network.layers(spikes)[0][0][:, 0]
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
    ((got, fired),) = network.layers(arriving)
    np.testing.assert_allclose(got, potential, atol=1e-4)
    np.testing.assert_array_equal(fired, spikes)
    np.testing.assert_array_equal(network.counts([arriving]), [spikes.sum(0)])


def test_refractory_response_separates_spikes():
    """By hand: 3 - 4 k/2 exp(1 - k/2) is 2 or more again from k = 8 steps after a spike on."""
    decay = np.exp(-1 / 4)
    network, _ = one_layer(np.full((1, 2), 3 / (np.e / 4 * decay / (1 - decay) ** 2)), 0)
    ((_, spikes),) = network.layers(np.ones((140, 1, 1, 1)))  # a potential of 3 after 60 steps
    assert set(np.diff(np.flatnonzero(spikes[60:, 0]))) == {8}


@pytest.mark.parametrize("distance", [0.0, 0.3, -1.7, 20.0, -60.0])
def test_the_escape_rate_has_the_accuracy_of_a_float32(distance):
    potential = np.full((2, 1), NEURON.theta * (1 + distance), np.float32)
    error, traces = np.ones((2, 1), np.float32), np.zeros((2, 16), np.float32)
    slayer_kernels.assign_credit(error, potential, traces, NEURON.credit)
    expected = np.exp(-abs(float(potential[0, 0]) - NEURON.theta) / NEURON.theta) / NEURON.theta
    kernel = np.e / 4 * np.exp(-1 / 4)  # t = 1, tau_s = 4 steps
    assert error[0, 0] == pytest.approx(max(expected, 2.0**-64 / NEURON.theta) * kernel, rel=1e-6)


NETWORKS = {
    "two convolutions": ("5x5x2-3c2-4c3-3o", 16),
    "pooling, stride, padding": ("9x7x2-4c3s2p-2a-5c2p-3o", 60),
    "pooling before dense layers": ("7x7x2-8c3p-3a-6-3o", 16),
    "channels of several groups": ("4x4x9-3c2-3o", 16),
}


@pytest.fixture(scope="module", params=NETWORKS.values(), ids=NETWORKS)
def small(request):
    notation, scale = request.param
    parsed = architecture.parse(notation)
    network = slayer.SlayerNetwork(parsed, NEURON, 7, conv_scale=scale, dense_scale=28)
    shape = (2, STEPS, *parsed.input_shape)
    return network, (np.random.default_rng(5).random(shape) < 0.1).astype(np.uint8)


def forward(reference, network, kernels, sample, smooth_around=None):
    """All layers for one sample.

    With ``smooth_around`` (the potentials of an earlier call) spikes are those of the earlier call
    plus the change of the smooth spike, whose derivative there is rho.
    """
    response, held, potentials, spikes = convolve(reference.eps, sample.astype(float)), [], [], []
    folded_layers = slayer.folded_layers(network.architecture)
    for i, (folded, kernel) in enumerate(zip(folded_layers, kernels, strict=True)):
        current = weigh(pooled(response, folded.pool), kernel, folded)
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
    kernels = [k.astype(float) for k in network.kernels]
    for sample in events:
        expected = forward(reference, network, kernels, sample)
        layers = zip(network.layers(sample), expected["spikes"], expected["potential"], strict=True)
        for (potential, fired), spikes, expected_potential in layers:
            assert spikes.sum() >= 5, "a layer that hardly fires tests nothing"
            np.testing.assert_array_equal(fired, spikes)
            np.testing.assert_allclose(potential, expected_potential, atol=2e-4)


def test_parts_of_the_time_make_no_difference(small, monkeypatch):
    network, events = small
    desired = np.eye(3, dtype=np.float32)[[0, 1]] * 8
    whole = network.gradients(events, desired)
    monkeypatch.setattr(slayer, "PART", 7)
    loss, counts, gradients = network.gradients(events, desired)
    assert loss == pytest.approx(whole[0])
    np.testing.assert_array_equal(counts, whole[1])
    for got, expected in zip(gradients, whole[2], strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_weight_gradients_agree_with_finite_differences(reference, small):
    """Of the loss's gradient through all layers, in both kinds of weights."""
    network, events = small
    desired = np.array([[8.0, 1, 1], [1, 1, 8]], np.float32)
    loss, _, gradients = network.gradients(events, desired)
    kernels = [k.astype(float) for k in network.kernels]
    bases = [forward(reference, network, kernels, sample) for sample in events]
    errors = [(b["spikes"][-1].sum(0) - d) / STEPS for b, d in zip(bases, desired, strict=True)]
    expected_loss = np.mean([0.5 * STEPS * (e**2).sum() for e in errors])
    assert loss == pytest.approx(expected_loss, rel=1e-5)

    def functional(kernels):
        outputs = [
            forward(reference, network, kernels, sample, base)["response"]
            for sample, base in zip(events, bases, strict=True)
        ]
        return np.mean([(o * e).sum() for o, e in zip(outputs, errors, strict=True)])

    rng = np.random.default_rng(6)
    for layer, gradient in enumerate(gradients):
        assert np.abs(gradient).max() > 1e-3
        for _ in range(6):
            index = tuple(rng.integers(0, n) for n in kernels[layer].shape)
            difference = 0.0
            for sign in (1, -1):
                moved = [k.copy() for k in kernels]
                moved[layer][index] += sign * 1e-5
                difference += sign * functional(moved) / 2e-5
            assert float(gradient[index]) == pytest.approx(difference, rel=2e-3, abs=1e-5)


def test_training_lowers_the_loss(small):
    network, events = small
    before = [kernel.copy() for kernel in network.kernels]
    desired = np.array([[8.0, 1, 1], [1, 1, 8]], np.float32)
    optimizer, losses = Adam(network.kernels, 0.02), []
    for _ in range(40):
        loss, _, gradients = network.gradients(events, desired)
        losses.append(loss)
        optimizer.apply(gradients)
    for kernel, value in zip(network.kernels, before, strict=True):
        kernel[:] = value
    assert min(losses[-5:]) < losses[0] / 4


def test_kernels_have_the_shapes_of_the_notation():
    network = slayer.SlayerNetwork(architecture.parse("10x10x2-6c2-24c3-10o"))
    assert [tuple(k.shape) for k in network.kernels] == [
        (2, 2, 2, 6),
        (3, 3, 6, 24),
        (7 * 7 * 24, 10),
    ]
