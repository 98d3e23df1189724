import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deploy.network.chip import LOIHI
from models.architecture import parse_architecture
from models.integers import Integers
from models.keras.keras2 import tf
from models.spiking.network import (
    Neuron,
    SpikingNetwork,
    _round_to_power_of_two,
    _round_to_twelve_bits,
    count_operations,
)
from models.spiking.neurons import fire
from tests.models import spiking_in_numpy
from tests.models.on_emulator import emulate

ARCHITECTURES = [
    "10x10x2-12c4s2-64-10o",
    "10x10x2-6c3p-8c3s2p-20-10o",
    "9x7x2-5c4s3-6c2-4o",
    "6x6x1-20-12-3o",
]


def network_of(text, seed=0, biases=0.1, scale=2.5, neuron=None):
    """A network of random weights that spikes."""
    rng = np.random.default_rng(seed)
    neuron = neuron or Neuron(tau_u=(2.0, 5.0), tau_v=(4.0, 20.0))
    network = SpikingNetwork(parse_architecture(text), neuron, seed)
    weights = network.get_weights()
    for name in network.names:
        weights[f"{name}.kernel"] *= scale
        weights[f"{name}.bias"] = rng.normal(0, biases, weights[f"{name}.bias"].shape)
    network.set_weights(weights)
    return network


def frames_for(network, samples=2, steps=50, share=0.06, seed=0):
    shape = (steps, samples, *network.architecture.input_shape)
    return (np.random.default_rng(seed).random(shape) < share).astype(np.uint8)


@pytest.mark.parametrize("text", ARCHITECTURES)
def test_the_forward_pass_is_the_integers_of_plain_numpy(text):
    network = network_of(text)
    frames = frames_for(network)
    outputs, spikes = network(tf.constant(frames), dtype=tf.float64)
    in_float32 = network(tf.constant(frames))[1]
    integers = network.compute_integers()
    for sample in range(frames.shape[1]):
        expected = spiking_in_numpy.network(network.architecture, integers, frames[:, sample])
        for layer, whole, single in zip(expected, spikes, in_float32, strict=True):
            assert layer.sum() > 20
            np.testing.assert_array_equal(whole[:, sample], layer)
            assert np.mean(single[:, sample] != layer) < 1e-3
        decoded = np.cumsum(expected[-1] @ network.get_weights()["output.kernel"], 0)
        np.testing.assert_allclose(outputs[:, sample], decoded, atol=1e-5)


def test_each_section_of_a_sample_has_its_output_weights():
    network = SpikingNetwork(
        parse_architecture("6x6x1-20-12-3o"), seed=3, section_starts=(0, 20, 33)
    )
    weights = network.get_weights()
    for name in network.names:
        weights[f"{name}.kernel"] *= 2.5
    kernels = np.random.default_rng(0).normal(size=(3, 12, 3))
    network.set_weights({**weights, "output.kernel": kernels.reshape(36, 3)})
    for steps in (50, 25):  # the last sections may be missing
        outputs, spikes = network(tf.constant(frames_for(network, steps=steps)), dtype=tf.float64)
        section = np.repeat([0, 1, 2], [20, 13, 17])[:steps]
        added = np.einsum("tsn,tnc->tsc", spikes[-1].numpy(), kernels[section])
        assert spikes[-1].numpy().sum() > 20
        np.testing.assert_allclose(outputs, np.cumsum(added, 0), atol=1e-5)


@pytest.mark.parametrize("text", ARCHITECTURES)
def test_nengoloihis_emulator_makes_the_same_spikes(text):
    network = network_of(text, biases=0.0)
    frames, integers = frames_for(network), network.compute_integers()
    for sample in range(frames.shape[1]):
        expected = spiking_in_numpy.network(network.architecture, integers, frames[:, sample])
        spikes, _ = emulate(network.architecture, integers, frames[:, sample])
        for in_numpy, emulated in zip(expected, spikes, strict=True):
            np.testing.assert_array_equal(emulated, in_numpy)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    keep_u_4096ths=st.integers(2, 4095),
    keep_v_4096ths=st.integers(2, 4095),
    threshold=st.integers(20, LOIHI.max_threshold // 64),
    floor=st.integers(0, 23),
    largest_bias=st.sampled_from([0, 100, 4095, 4095 << 7]),
)
# NengoLoihi halves a network whose threshold is one unit above this one.
@example(
    seed=0,
    keep_u_4096ths=273,
    keep_v_4096ths=587,
    threshold=LOIHI.max_threshold // 64,
    floor=0,
    largest_bias=0,
)
def test_nengoloihi_comes_to_any_integers(
    seed, keep_u_4096ths, keep_v_4096ths, threshold, floor, largest_bias
):
    rng = np.random.default_rng(seed)
    weights = rng.integers(-127, 128, (3, 3, 2, 4))
    weights.flat[0] = -127
    bias = largest_bias * np.array([1, -1, 0, 1])
    layer = Integers(weights, bias, threshold * 64, 1 - 2**floor, keep_u_4096ths, keep_v_4096ths)
    # One output neuron a position, so that it is one block.
    architecture = parse_architecture("5x5x2-4c3-10o")
    _, (block,) = emulate(architecture, {"conv1": layer}, np.zeros((1, 5, 5, 2), np.uint8))
    compartment = block.compartment
    assert set(compartment.vth) == {layer.threshold}
    assert compartment.vmin == layer.floor
    assert set(4095 - compartment.decay_u) == {keep_u_4096ths}
    assert set(4096 - compartment.decay_v) == {keep_v_4096ths}
    np.testing.assert_array_equal(compartment.bias.reshape(9, 4), np.tile(bias, (9, 1)))
    assert set(compartment.refract_delay) == {1}
    (synapse,) = block.synapses
    on_chip = np.concatenate([np.ravel(w) for w in synapse.weights])
    assert sorted(set(on_chip)) == sorted(set(np.ravel(weights) * 128))


@pytest.mark.parametrize("floor", [-1e4, -0.1])
def test_gradients_through_time_are_those_of_plain_numpy(floor):
    rng = np.random.default_rng(3)
    steps, n, beta = 40, 6, 4.0
    layer = Integers(
        rng.integers(-127, 128, (8, n)), rng.integers(-200, 400, n), 128 * 100,
        1 - 2 ** round(np.log2(1 - floor * 12800)), 2800, 3700,
    )  # fmt: skip
    frames = (rng.random((steps, 1, 1, 8)) < 0.3).astype(np.uint8)
    architecture = parse_architecture(f"1x1x8-{n}-2o")
    spikes, u, v = spiking_in_numpy.run(architecture.layers[0], layer, frames)
    assert 5 < spikes.sum() < 0.7 * spikes.size
    assert np.any(v <= layer.floor) == (floor == -0.1)
    error = rng.normal(size=(steps, n))
    expected = spiking_in_numpy.gradients(error, u, spikes, v, layer, beta)

    def tensor(value):
        return tf.Variable(np.asarray(value, float))

    q = 128 * (frames.reshape(steps, 8).astype(float) @ layer.kernel)
    inputs = [
        tensor(q[:, None]),
        tensor(layer.keep_u_4096ths),
        tensor(layer.keep_v_4096ths),
        tensor(layer.bias),
    ]
    parameters = {
        **dict(zip(("keep_u_4096ths", "keep_v_4096ths", "bias"), inputs[1:], strict=True)),
        "threshold": tf.constant(float(layer.threshold), tf.float64),
        "floor": tf.constant(float(layer.floor), tf.float64),
    }
    with tf.GradientTape() as tape:
        result = fire(inputs[0], parameters, beta)
        total = tf.reduce_sum(result[:, 0] * error)
    np.testing.assert_array_equal(result[:, 0], spikes)
    for actual, its in zip(tape.gradient(total, inputs), expected, strict=True):
        np.testing.assert_allclose(np.squeeze(actual), its, rtol=1e-9, atol=1e-12)


def test_gradients_reach_everything_that_is_trained():
    network = network_of("10x10x2-8c4s2-16-4o", biases=0.01)
    frames = tf.constant(frames_for(network))
    with tf.GradientTape() as tape:
        outputs, spikes = network(frames)
        costs = count_operations(network.architecture, frames, spikes)
        loss = tf.reduce_sum(outputs[-1, :, 0]) + 1e-3 * tf.reduce_sum(costs)
    for variable, gradient in zip(
        network.variables_in_order, tape.gradient(loss, network.variables_in_order), strict=True
    ):
        assert gradient.shape == variable.shape
        assert np.abs(gradient).max() > 0


def test_the_gradient_of_a_weight_is_that_of_the_current_it_scales():
    # A weight W in units of the threshold is w 128 / theta: dE/dW = theta sum of dE/dq s.
    network = network_of("1x1x3-1-2o", biases=0.0, neuron=Neuron((2.0,), (4.0,)))
    frames = (np.random.default_rng(1).random((30, 1, 1, 1, 3)) < 0.5).astype(np.uint8)
    with tf.GradientTape() as tape:
        _, spikes = network(tf.constant(frames), dtype=tf.float64)
        loss = tf.reduce_sum(spikes[0])
    kernel = network.variables_by_name["dense1.kernel"]
    layer = network.compute_integers()["dense1"]
    s, u, v = spiking_in_numpy.run(network.architecture.layers[0], layer, frames[:, 0])
    by_q = spiking_in_numpy.gradients(np.ones(s.shape), u, s, v, layer, 4.0)[0]
    largest = np.abs(kernel.numpy()).max()
    expected = 128 * 127 / largest * (frames.reshape(30, 3).T @ by_q)
    np.testing.assert_allclose(tape.gradient(loss, kernel), expected, rtol=1e-4)


def test_operations_are_counted_as_the_deployed_networks():
    network = network_of("10x10x2-6c3-8c3-10o")
    frames = frames_for(network)
    _, spikes = network(tf.constant(frames))
    counted = count_operations(network.architecture, tf.constant(frames), spikes)
    for layer, (sender, fan_out) in enumerate(
        zip((frames, *spikes), network.architecture.fan_out.values(), strict=True)
    ):
        per_sample = np.asarray(sender, float).sum(0).reshape(2, -1) @ fan_out.ravel()
        np.testing.assert_allclose(counted[:, layer], per_sample, rtol=1e-6)


def test_rounding_of_biases_and_floors_is_nengoloihis():
    from nengo_loihi.builder.discretize import bias_to_manexp

    values = np.concatenate(
        [np.arange(-9000, 9000, 7), np.geomspace(4000, 4095 * 128, 200).round()]
    )
    mantissa, exponent = bias_to_manexp(values)
    np.testing.assert_array_equal(
        _round_to_twelve_bits(tf.constant(values)), mantissa * 2.0**exponent
    )
    x = np.geomspace(1, 2**23, 1000)
    np.testing.assert_array_equal(_round_to_power_of_two(tf.constant(x)), 2 ** np.round(np.log2(x)))


def test_weights_there_and_back():
    network = network_of("10x10x2-8c4s2-16-10o")
    weights = network.get_weights()
    assert weights["conv1.tau_u"] == pytest.approx(2.0)
    assert weights["dense1.tau_v"] == pytest.approx(20.0)
    other = SpikingNetwork(network.architecture, seed=9)
    other.set_weights(weights)
    for name, value in other.get_weights().items():
        np.testing.assert_allclose(value, weights[name], rtol=1e-5)
    for name, layer in other.compute_integers().items():
        result = network.compute_integers()[name]
        np.testing.assert_array_equal(layer.kernel, result.kernel)
        assert (layer.threshold, layer.keep_u_4096ths) == (result.threshold, result.keep_u_4096ths)
    with pytest.raises(ValueError, match=r"conv1\.kernel"):
        other.set_weights({**weights, "conv1.kernel": np.zeros((1, 1, 2, 8))})
    with pytest.raises(ValueError, match=r"dense1\.tau_u"):
        other.set_weights({name: v for name, v in weights.items() if name != "dense1.tau_u"})
