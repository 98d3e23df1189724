import nengo
import numpy as np
import pytest

from deploy.network.loihi_import import nengo_loihi
from models.cnn import RateLIF, find_gain, round_time_constants
from models.keras.keras2 import tf

RATE = 150.0


def activations():
    return np.concatenate([np.linspace(-2, 3, 1001), [1e-6, 0.0, 1.0]])


def currents(z, gain):
    """J as the neuron gets it: threshold 1 at z = 0."""
    return (gain * z)[:, None], np.ones(1), np.ones(1)


@pytest.mark.parametrize(("tau_rc", "tau_ref"), [(0.02, 0.001), (0.02, 0.002), (0.05, 0.004)])
def test_the_rate_is_that_of_nengos_lif(tau_rc, tau_ref):
    z = activations()
    layer = RateLIF(RATE, tau_rc, tau_ref)
    expected = nengo.LIFRate(tau_rc, tau_ref).rates(*currents(z, layer.gain)).ravel() / RATE
    np.testing.assert_allclose(layer(z.astype(np.float32)), expected, atol=2e-4)


@pytest.mark.parametrize(("tau_rc", "tau_ref"), [(0.02, 0.001), (0.02, 0.002), (0.05, 0.004)])
def test_on_the_chip_the_rate_is_nengo_loihis_averaged_over_a_ripple(tau_rc, tau_ref):
    layer = RateLIF(RATE, tau_rc, tau_ref, on_chip=True)
    neurons = nengo_loihi.neurons.LoihiLIF(tau_rc=tau_rc, tau_ref=tau_ref)
    for z in (0.3, 0.6, 1.0, 1.3):
        # A ripple that moves the end of the interval by one step, evenly within it.
        interval = 1 / (float(layer(np.float32([z]))[0]) * RATE)
        ends = interval + 0.001 * (np.arange(400) / 400 - 1)  # half a step around the unrounded one
        real_tau_rc, real_tau_ref = round_time_constants(tau_rc, tau_ref)
        j = 1 + 1 / np.expm1((ends - real_tau_ref) / real_tau_rc)
        rates = nengo_loihi.neurons.loihi_lif_rates(
            neurons, (j - 1)[:, None], np.ones(1), np.ones(1), dt=0.001
        )
        assert np.mean(1 / rates) == pytest.approx(interval, rel=2e-3)


def test_the_price_of_spikes_by_hand():
    costs = np.float32([1, 10])
    layer = RateLIF(RATE, spike_costs=costs)
    rates = layer(np.float32([[1.0, 0.0], [0.0, 1.0]]), training=True).numpy()
    np.testing.assert_allclose(rates, np.eye(2), atol=1e-5)
    assert float(layer.losses[0]) == pytest.approx((1 + 10) / 2, rel=1e-4)


def test_one_gives_the_maximum_rate_and_zero_none():
    layer = RateLIF(RATE)
    np.testing.assert_allclose(layer(np.float32([1.0, 0.0, -1.0])), [1, 0, 0], atol=1e-5)


def test_gain_by_hand():
    # 1 / r - tau_ref = tau_rc log(1 + 1 / (J - 1)), r = 100 Hz, tau_ref = 2 ms: log(...) = 0.4
    assert find_gain(100, 0.02, 0.002) == pytest.approx(1 / (np.exp(0.4) - 1))


def test_time_constants_on_the_chip():
    tau_rc, tau_ref = round_time_constants(0.02, 0.0014)
    assert tau_ref == pytest.approx(0.001)
    assert -np.expm1(-0.001 / tau_rc) * 4095 == pytest.approx(200)  # 199.7 rounded to an integer
    assert tau_rc == pytest.approx(0.02, rel=2e-3)


@pytest.mark.parametrize("on_chip", [False, True])
def test_the_gradient_is_finite_and_never_negative(on_chip):
    z = tf.constant(activations(), tf.float32)
    layer = RateLIF(RATE, on_chip=on_chip)
    with tf.GradientTape() as tape:
        tape.watch(z)
        rate = layer(z)
    gradient = tape.gradient(rate, z).numpy()
    assert np.isfinite(gradient).all()
    assert (gradient >= 0).all()
    assert gradient[np.argmin(np.abs(z - 0.01))] > 0.1  # alive at the threshold


@pytest.mark.parametrize("on_chip", [False, True])
def test_the_gradient_is_that_of_the_smoothed_rate(on_chip):
    """Against TensorFlow's own differentiation of the equation in double precision."""
    layer = RateLIF(RATE, on_chip=on_chip)
    z = np.concatenate([np.linspace(-0.5, 2, 101), [0.0, 1e-6]])

    def smoothed(z):
        excess = layer.smoothing * tf.math.softplus(layer.gain * z / layer.smoothing)
        interval = layer.shortest_interval + layer.tau_rc * tf.math.log1p(1 / excess)
        return 1 / (interval * layer.max_rate)

    gradients = []
    for function, dtype in ((layer.compute_rates, tf.float32), (smoothed, tf.float64)):
        points = tf.constant(z, dtype)
        with tf.GradientTape() as tape:
            tape.watch(points)
            values = function(points)
        gradients.append(tape.gradient(values, points).numpy())
    np.testing.assert_allclose(*gradients, rtol=2e-4, atol=1e-6)
