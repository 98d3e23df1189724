"""SLAYER against a plain NumPy version written from the paper's sums, and finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import architecture, slayer
from models.keras2 import tf

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


def correlate(kernel, signal):
    out = np.zeros_like(signal)
    for t in range(len(signal)):
        for k in range(t, len(signal)):
            out[t] += kernel[k - t] * signal[k]
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


def conv2d(frames, kernel):
    rows, columns = (frames.shape[i] - kernel.shape[i - 1] + 1 for i in (1, 2))
    out = np.zeros((len(frames), rows, columns, kernel.shape[3]))
    for i in range(kernel.shape[0]):
        for j in range(kernel.shape[1]):
            out += frames[:, i : i + rows, j : j + columns] @ kernel[i, j]
    return out


def weigh(response, kernel):
    if kernel.ndim == 2:
        return response.reshape(len(response), -1) @ kernel
    return conv2d(response, kernel)


def noisy_current(seed, shape):
    return np.random.default_rng(seed).normal(1, 1.5, shape)


@pytest.fixture(scope="module")
def reference():
    return Reference(NEURON, STEPS)


def test_spike_response_is_the_convolution_with_the_kernel(reference):
    spikes = (np.random.default_rng(0).random((STEPS, 3, 2)) < 0.2).astype(np.float32)
    response = slayer.spike_response(tf.constant(spikes), NEURON)
    np.testing.assert_allclose(response, convolve(reference.eps, spikes), atol=1e-5)


def test_a_single_spike_gives_the_kernel_of_unit_peak():
    spikes = np.zeros((STEPS, 1), np.float32)
    spikes[0] = 1
    response = slayer.spike_response(tf.constant(spikes), NEURON).numpy()[:, 0]
    assert response.argmax() == 4  # tau_s is 4 steps
    assert response.max() == pytest.approx(1, abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_fire_agrees_with_numpy(reference, seed):
    current = noisy_current(seed, (STEPS, 2, 3)).astype(np.float32).astype(float)
    spikes, potential = reference.fire(current)
    if np.abs(potential - NEURON.theta).min() < 1e-4:
        return  # too close to call in single precision
    response, got = slayer.fire(tf.constant(current, tf.float32), NEURON)
    np.testing.assert_allclose(got, potential, atol=1e-4)
    np.testing.assert_allclose(response, convolve(reference.eps, spikes), atol=1e-4)
    counts = slayer.spike_counts(got, NEURON)
    np.testing.assert_array_equal(counts, spikes.sum(0))


def test_fire_spikes_at_all(reference):
    spikes, _ = reference.fire(noisy_current(0, (STEPS, 50)))
    assert 0.05 < spikes.mean() < 0.5


def test_refractory_response_separates_spikes():
    """By hand: 3 - 4 k/2 exp(1 - k/2) is 2 or more again from k = 8 steps after a spike on."""
    _, potential = slayer.fire(tf.fill((17, 1), 3.0), NEURON)
    spikes = np.flatnonzero(potential.numpy()[:, 0] >= NEURON.theta)
    assert spikes.tolist() == [0, 8, 16]


def test_credit_is_rho_times_the_correlation_with_the_kernel(reference):
    rng = np.random.default_rng(1)
    current = tf.constant(noisy_current(1, (STEPS, 4)), tf.float32)
    error = rng.normal(size=(STEPS, 4))
    with tf.GradientTape() as tape:
        tape.watch(current)
        response, potential = slayer.fire(current, NEURON)
    delta = tape.gradient(response, current, tf.constant(error, tf.float32))
    expected = reference.rho(potential.numpy()) * correlate(reference.eps, error)
    np.testing.assert_allclose(delta, expected, atol=1e-5)


def test_credit_is_the_derivative_of_smooth_spikes(reference):
    """Finite differences: rho is the derivative of its antiderivative, refractory part held."""
    current = noisy_current(2, (STEPS, 2))
    _, potential = reference.fire(current)
    held = potential - current
    error = np.random.default_rng(3).normal(size=current.shape)

    def functional(current):
        return (error * convolve(reference.eps, reference.smooth_spike(current + held))).sum()

    numeric = np.zeros_like(current)
    for index in np.ndindex(current.shape):
        step = np.zeros_like(current)
        step[index] = 1e-5
        numeric[index] = (functional(current + step) - functional(current - step)) / 2e-5
    x = tf.constant(current, tf.float32)
    with tf.GradientTape() as tape:
        tape.watch(x)
        response, _ = slayer.fire(x, NEURON)
    np.testing.assert_allclose(
        tape.gradient(response, x, tf.constant(error, tf.float32)), numeric, atol=1e-4
    )


def test_errors_do_not_flow_through_the_potential():
    x = tf.constant(noisy_current(4, (STEPS, 2)), tf.float32)
    with tf.GradientTape() as tape:
        tape.watch(x)
        _, potential = slayer.fire(x, NEURON)
        loss = tf.reduce_sum(potential)
    assert tape.gradient(loss, x) is None


ARCHITECTURE = architecture.parse("5x5x2-3c2-4c3-3o")


@pytest.fixture(scope="module")
def small():
    network = slayer.SlayerNetwork(ARCHITECTURE, NEURON, 7, conv_scale=8, dense_scale=14)
    events = (np.random.default_rng(5).random((2, STEPS, 5, 5, 2)) < 0.1).astype(np.uint8)
    return network, events


def forward(reference, kernels, sample, smooth_around=None):
    """All layers for one sample.

    With ``smooth_around`` (the potentials of an earlier call) spikes are those of the earlier call
    plus the change of the smooth spike, whose derivative there is rho.
    """
    response, held, potentials, spikes = convolve(reference.eps, sample.astype(float)), [], [], []
    for i, kernel in enumerate(kernels):
        current = weigh(response, kernel)
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
    layers = network.layers(events)
    kernels = [k.numpy().astype(float) for k in network.kernels]
    for n, sample in enumerate(events):
        expected = forward(reference, kernels, sample)
        for (response, potential), spikes in zip(layers, expected["spikes"], strict=True):
            assert spikes.sum() >= 5, "a layer that hardly fires tests nothing"
            np.testing.assert_array_equal(potential[:, n] >= NEURON.theta, spikes)
            np.testing.assert_allclose(response[:, n], convolve(reference.eps, spikes), atol=1e-4)


def test_weight_gradients_agree_with_finite_differences(reference, small):
    """Of the loss's gradient through all layers, in both kinds of weights."""
    network, events = small
    desired = np.array([[8.0, 1, 1], [1, 1, 8]], np.float32)
    with tf.GradientTape() as tape:
        response, potential = network(events)
        loss = slayer.spike_count_loss(response, potential, desired, NEURON)
    gradients = tape.gradient(loss, network.kernels)

    kernels = [k.numpy().astype(float) for k in network.kernels]
    bases = [forward(reference, kernels, sample) for sample in events]
    errors = [(b["spikes"][-1].sum(0) - d) / STEPS for b, d in zip(bases, desired, strict=True)]
    expected_loss = np.mean([0.5 * STEPS * (e**2).sum() for e in errors])
    assert float(loss) == pytest.approx(expected_loss, rel=1e-5)

    def functional(kernels):
        outputs = [
            forward(reference, kernels, sample, base)["response"]
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
    _, events = small
    network = slayer.SlayerNetwork(ARCHITECTURE, NEURON, 7, conv_scale=8, dense_scale=14)
    desired = np.array([[8.0, 1, 1], [1, 1, 8]], np.float32)
    optimizer = tf.keras.optimizers.Adam(0.02)
    losses = []
    for _ in range(40):
        with tf.GradientTape() as tape:
            response, potential = network(events)
            loss = slayer.spike_count_loss(response, potential, desired, NEURON)
        losses.append(float(loss))
        gradients = tape.gradient(loss, network.kernels)
        optimizer.apply_gradients(zip(gradients, network.kernels, strict=True))
    assert min(losses[-5:]) < losses[0] / 4


def test_the_same_seed_gives_the_same_weights():
    one, two, other = (slayer.SlayerNetwork(ARCHITECTURE, seed=s) for s in (1, 1, 2))
    for a, b, c in zip(one.kernels, two.kernels, other.kernels, strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)


def test_kernels_have_the_shapes_of_the_notation():
    network = slayer.SlayerNetwork(architecture.parse("10x10x2-6c2-24c3-10o"))
    assert [tuple(k.shape) for k in network.kernels] == [
        (2, 2, 2, 6),
        (3, 3, 6, 24),
        (7 * 7 * 24, 10),
    ]


@pytest.mark.parametrize("name", ["dt", "tau_s", "tau_r", "theta", "tau_rho"])
def test_a_parameter_of_zero_is_refused(name):
    with pytest.raises(ValueError, match=name):
        slayer.SpikeResponse(**{name: 0})
