"""The estimate of energy against hand-worked numbers and keras-spiking's."""

import pytest

from deploy.check.energy import CHIP, MAC, estimate_energy, estimate_text
from deploy.check.run import run_check
from deploy.errors import UserError
from tests.deploy.networks import bundle_at, paper_spec, small_spec


def counted(spec, samples=2, **operations):
    return {
        "n_samples": samples,
        "synaptic_operations": {layer.name: 0 for layer in spec.layers} | operations,
        "decided_at_median": 12.0,
    }


def test_small_network_by_hand():
    # conv1 has 64 neurons and 36 inputs; a sample lasts 30 + 5 steps
    spec = small_spec()
    value = estimate_energy(spec, counted(spec, conv1=2000))
    conv1, conv2, output = value.layers
    assert conv1.synaptic_operations == 1000
    assert conv1.neuron_updates == 64 * 35
    assert conv1.chip_joules == pytest.approx(1000 * 27.1e-12 + 64 * 35 * 81e-12)
    assert conv2.chip_joules == pytest.approx(72 * 35 * 81e-12)
    assert (output.on_chip, output.chip_joules) == (False, 0)
    assert value.chip_joules == pytest.approx(conv1.chip_joules + conv2.chip_joules)
    # 4 x 4 positions of 4 filters of 3 x 3; 3 x 3 of 8 of 2 x 2 x 4; 72 x 10
    macs = [16 * 4 * 9, 9 * 8 * 16, 720]
    assert [layer.multiply_accumulates for layer in value.layers] == macs
    assert value.cnn_joules("cpu") == pytest.approx((sum(macs) + 64 + 72 + 10) * 8.6e-9)
    assert (value.latency_seconds, value.decided_seconds) == (0.03, 0.012)


def test_output_neurons_on_the_chip_count():
    spec = small_spec(on_chip_output=True)
    value = estimate_energy(spec, counted(spec, output=400))
    assert value.layers[-1].chip_joules == pytest.approx(200 * 27.1e-12 + 10 * 35 * 81e-12)


def test_from_a_real_check(tmp_path):
    bundle = bundle_at(tmp_path / "bundle")
    result = run_check(bundle, "emulator", tmp_path / "emulator.json")
    value = estimate_energy(bundle.spec, result)
    assert value.layers[0].synaptic_operations > 0
    text = estimate_text(value)
    assert text.startswith("ESTIMATE")
    assert value.to_json()["estimate"] is True


def test_result_without_counts_is_refused():
    with pytest.raises(UserError, match="synaptic operations"):
        estimate_energy(small_spec(), {"n_samples": 1})


def test_result_without_the_time_of_its_decisions_is_refused():
    spec = small_spec()
    incomplete = counted(spec)
    del incomplete["decided_at_median"]
    with pytest.raises(UserError, match="decision"):
        estimate_energy(spec, incomplete)


@pytest.mark.slow
def test_constants_and_cnn_are_those_of_keras_spiking():
    from models.keras2 import tf  # before anybody asks TensorFlow for Keras

    keras_spiking = pytest.importorskip("keras_spiking")

    devices = keras_spiking.ModelEnergy.devices
    assert devices["loihi"]["energy_per_synop"] == pytest.approx(CHIP["synaptic operation"])
    assert devices["loihi"]["energy_per_neuron"] == pytest.approx(CHIP["neuron update"])
    layers = tf.keras.layers
    cnn = tf.keras.Sequential(
        [
            layers.Conv2D(6, 4, activation="relu", use_bias=False, input_shape=(10, 10, 1)),
            layers.Conv2D(24, 3, activation="relu", use_bias=False),
            layers.Flatten(),
            layers.Dense(10, activation="relu", use_bias=False),
        ]
    )
    spec = paper_spec()
    value = estimate_energy(spec, counted(spec))
    energy = keras_spiking.ModelEnergy(cnn)
    for device in MAC:
        assert energy.total_energy(device) == pytest.approx(value.cnn_joules(device))
