"""The estimate of energy against hand-worked numbers and keras-spiking's."""

import pytest

from deploy.check.energy import CHIP_JOULES, MAC_JOULES, estimate_energy, format_estimate
from deploy.check.run import run_check
from deploy.check.text import format_result
from deploy.conformance.networks import make_image_network
from deploy.errors import UserError
from deploy.files import read_json, write_json
from deploy.targets.registry import run_target
from pipeline.storage.run_folder import find_checks_folder
from tests.command import call
from tests.deploy.networks import bundle_at, make_paper_network
from tests.deploy.results import make_result


def counted(spec, samples=2, **operations):
    counts = {layer.name: 0 for layer in spec.layers} | operations
    return make_result([0] * samples, [0] * samples, synaptic_operations=counts)


def test_small_network_by_hand():
    # conv1 has 64 neurons and 36 inputs; a sample lasts 30 + 5 steps
    spec = make_image_network()
    value = estimate_energy(spec, counted(spec, conv1=2000))
    conv1, conv2, _ = value.layers
    assert conv1.synaptic_operations == 1000
    assert conv1.neuron_updates == 64 * 35
    assert conv1.chip_joules == pytest.approx(1000 * 27.1e-12 + 64 * 35 * 81e-12)
    assert conv2.chip_joules == pytest.approx(72 * 35 * 81e-12)
    # 4 x 4 positions of 4 filters of 3 x 3; 3 x 3 of 8 of 2 x 2 x 4; 72 x 10
    macs = [16 * 4 * 9, 9 * 8 * 16, 720]
    assert [layer.multiply_accumulates for layer in value.layers] == macs
    assert value.estimate_cnn_joules("cpu") == pytest.approx((sum(macs) + 64 + 72 + 10) * 8.6e-9)
    assert value.presentation_seconds == 0.03


@pytest.mark.parametrize("on_chip", [True, False])
def test_both_sides_have_the_output_layer_wherever_it_is(on_chip):
    spec = make_image_network(on_chip_output=on_chip)
    value = estimate_energy(spec, counted(spec, conv1=2000, output=400))
    output = value.layers[-1]
    assert output.on_chip is on_chip
    assert output.chip_joules == pytest.approx(200 * 27.1e-12 + 10 * 35 * 81e-12)
    assert value.synaptic_operations == 1200
    updates = (64 + 72 + 10) * 35 * 81e-12
    assert value.chip_joules == pytest.approx(updates + 1200 * 27.1e-12)
    assert value.share_of_updates == pytest.approx(updates / value.chip_joules)
    assert value.to_json()["shares"]["neuron update"] == value.share_of_updates


def test_one_definition_of_synaptic_operations(tmp_path):
    """A result's, the summary's and the estimate's are the spikes times their fan-out."""
    bundle = bundle_at(tmp_path / "bundle")
    result = run_check(bundle, "emulator", tmp_path / "emulator.json")
    value = estimate_energy(bundle.spec, result)
    actual = run_target(bundle.spec, bundle.checks.inputs, "emulator")
    output = 10 * actual.spikes["conv2"].sum()  # each of its spikes reaches ten outputs
    assert result["synaptic_operations"]["output"] == output > 0
    total = sum(result["synaptic_operations"].values()) / len(bundle.checks)
    assert value.synaptic_operations == pytest.approx(total)
    assert f"operations a sample: {total:.0f}," in format_result(result)
    assert format_estimate(value).startswith("ESTIMATE")


def test_result_without_counts_is_refused():
    with pytest.raises(UserError, match=r"synaptic operations.*--target emulator"):
        estimate_energy(make_image_network(), make_result(synaptic_operations={}))


def test_energy_of_a_bundle_that_never_ran_names_the_target_to_run(tmp_path, capsys):
    bundle = bundle_at(tmp_path / "bundle")
    assert call("deploy", "energy", bundle.path) == 2
    said = f"stmnist check run {bundle.path} --target fast"
    # A long path is divided among lines.
    assert "".join(said.split()) in "".join(capsys.readouterr().err.split())
    # A result of another bundle does not hide one of this.
    fast = find_checks_folder(bundle.path) / "fast.json"
    run_check(bundle, "fast", fast)
    other = {**read_json(fast, ""), "bundle": "0" * 64, "target": "emulator"}
    write_json(find_checks_folder(bundle.path) / "emulator.json", other)
    assert call("deploy", "energy", bundle.path) == 0


@pytest.mark.slow
def test_constants_and_cnn_are_those_of_keras_spiking():
    from models.keras.keras2 import tf  # before anybody asks TensorFlow for Keras

    keras_spiking = pytest.importorskip("keras_spiking")

    devices = keras_spiking.ModelEnergy.devices
    assert devices["loihi"]["energy_per_synop"] == pytest.approx(CHIP_JOULES["synaptic operation"])
    assert devices["loihi"]["energy_per_neuron"] == pytest.approx(CHIP_JOULES["neuron update"])
    layers = tf.keras.layers
    cnn = tf.keras.Sequential(
        [
            layers.Conv2D(6, 4, activation="relu", use_bias=False, input_shape=(10, 10, 1)),
            layers.Conv2D(24, 3, activation="relu", use_bias=False),
            layers.Flatten(),
            layers.Dense(10, activation="relu", use_bias=False),
        ]
    )
    spec = make_paper_network()
    value = estimate_energy(spec, counted(spec))
    energy = keras_spiking.ModelEnergy(cnn)
    for device in MAC_JOULES:
        assert energy.total_energy(device) == pytest.approx(value.estimate_cnn_joules(device))
