"""Silent, saturated and unfaithful layers, by hand and on a network whose rates are known."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.check.run import run_check
from deploy.conformance.networks import make_image_network
from deploy.files import read_json
from deploy.targets.fast import measure_firing_rates
from models.architecture import parse_architecture
from pipeline.kinds.diagnosis import (
    compare_layer,
    compare_rates,
    compute_fastest_rate,
    format_layers,
    measure_activity,
)
from pipeline.kinds.image import kind
from pipeline.training.images import rescaling
from pipeline.training.images.rescaling import select_measured
from tests.command import call
from tests.deploy.networks import bundle_at, draw_checks


def test_the_fastest_rate_is_a_spike_every_refractory_period_and_a_step():
    assert compute_fastest_rate(0.001) == pytest.approx(500)
    assert compute_fastest_rate(0.003) == pytest.approx(250)


def test_silent_and_saturated_by_hand():
    rates = np.zeros((200, 4))
    rates[7, 1] = 50  # fires once in a while: neither
    rates[:2, 2] = 450  # at the limit on 1 % of the samples
    rates[:2, 3] = [450, 449]  # on half of that
    found = measure_activity(rates, fastest=500)
    assert found == {"silent": 0.25, "saturated": 0.25}


def test_fidelity_by_hand():
    """Rates 0, 50, 100, 150 of max_rate 100 against activations 0, 1, 1, 2."""
    rates = np.array([[0.0, 50.0], [100.0, 150.0]])
    activations = np.array([[0.0, 1.0], [1.0, 2.0]])
    found = compare_layer("conv1", rates, activations, max_rate=100, tau_ref=0.001)
    assert found["worst_error"] == pytest.approx(0.5)
    assert found["mean_error"] == pytest.approx(0.25)
    # deviations (-.75, -.25, .25, .75) and (-1, 0, 0, 1): 1.5 / sqrt(1.25 * 2)
    assert found["correlation"] == pytest.approx(1.5 / np.sqrt(2.5))
    assert (found["chip"]["silent"], found["rate_network"]["saturated"]) == (0, 0)


def test_rates_of_the_readout_window_are_the_spikes_of_it():
    """A constant drive of J = 2: one spike every 15 steps, as in the tests of firing rates."""
    spec = make_image_network(steps=150, gap=6)
    layer = replace(
        spec.layers[0], weights=np.zeros_like(spec.layers[0].weights), bias=np.full(4, 2.0)
    )
    spec = replace(spec, layers=(layer, *spec.layers[1:])).with_presentation(readout_start=30)
    rates = measure_firing_rates(spec, np.zeros((3, 6, 6, 1)), start=30)["conv1"]
    assert rates.shape == (3, 64)
    assert set(np.unique(rates * 0.12)) <= {8.0, 9.0}  # 120 steps of 15, or a spike more


@pytest.mark.parametrize("stream_length", [1, 4, 20])
def test_rates_and_the_targets_counts_agree_however_samples_are_streamed(tmp_path, stream_length):
    """With no gap and the window from the first step on, the window holds every spike."""
    spec = make_image_network(gap=0).with_presentation(readout_start=0, stream_length=stream_length)
    bundle = bundle_at(tmp_path / "bundle", spec, 9)
    result = run_check(bundle, "fast", tmp_path / "fast.json")
    steps = []
    rates = measure_firing_rates(spec, bundle.checks.inputs, advance=steps.append)
    assert sum(steps) == 9
    for name, values in rates.items():
        counts = values * spec.presentation.steps * 0.001
        assert round(counts.sum()) == result["spikes"][name]


def test_a_layer_against_its_own_rates_is_perfect():
    spec = make_image_network()
    images = draw_checks(spec, 4).inputs
    rates = measure_firing_rates(spec, images, start=spec.presentation.readout_start)
    amplitudes = {layer.name: layer.neurons.amplitude for layer in spec.layers if layer.neurons}
    own = {name: values * amplitudes[name] for name, values in rates.items()}
    for layer in compare_rates(spec, rates, own):
        assert layer["correlation"] == pytest.approx(1)
        assert layer["worst_error"] == pytest.approx(0)
        assert layer["chip"] == layer["rate_network"]


def test_a_runs_metrics_hold_the_shares_of_its_neurons(tiny_run):
    neurons = read_json(tiny_run / "snn" / "metrics.json", "")["neurons"]
    assert set(neurons) == {"conv1", "conv2"}
    assert all(set(layer) == {"silent", "saturated"} for layer in neurons.values())


def test_a_runs_ladder_holds_the_diagnosis(tiny_run):
    ladder = read_json(tiny_run / "ladder.json", "")
    assert [layer["layer"] for layer in ladder["layers"]] == ["conv1", "conv2"]
    # Activations and firing rates are of the same neurons in the same order, or this is near 0.
    assert all(layer["correlation"] > 0.6 for layer in ladder["layers"])
    assert ladder["least_faithful_layer"] in {"conv1", "conv2"}
    assert ladder["bundle"] == read_result(tiny_run / "checks" / "emulator.json")["bundle"]


def test_a_large_networks_rates_are_compared_on_fewer_samples(run, monkeypatch):
    """Neurons times samples are bounded; that is said where the comparison is printed."""
    bundle = read_bundle(run / "bundle")
    neurons = sum(layer.size for layer in bundle.spec.layers if layer.neurons)
    everything = read_json(run / "ladder.json", "")["layers"]
    assert {layer["n_samples"] for layer in everything} == {len(bundle.checks)}
    (run / "ladder.json").unlink()
    monkeypatch.setattr(kind, "MAX_COMPARED_RATES", 6 * neurons)
    assert call("ladder", run) == 0
    layers = read_json(run / "ladder.json", "")["layers"]
    assert {0 < layer["n_samples"] <= 6 for layer in layers} == {True}
    assert f"on {layers[0]['n_samples']} samples" in format_layers(layers)


def test_a_large_networks_activations_are_measured_on_fewer_samples(monkeypatch):
    images = np.zeros((2000, 10, 10, 1))
    assert len(select_measured(images, parse_architecture("10x10-6c4-24c3-10o"))) == 2000
    wide = parse_architecture("10x10-64c3p-128c3p-10o")
    monkeypatch.setattr(rescaling, "MAX_MEASURED_ACTIVATIONS", 100 * sum(wide.n_values.values()))
    assert len(select_measured(images, wide)) == 100
