"""The equations of the reference against NengoLoihi, in real numbers and in the chip's integers."""

from dataclasses import replace

import nengo_loihi
import numpy as np
import pytest

from deploy.conformance.networks import draw_frames, make_event_network, make_image_network
from deploy.network.build import build_nengo_network
from deploy.network.reference import (
    delay_one_step,
    make_input_spikes,
    read_equations,
    run_reference,
)
from deploy.network.responses import make_responses
from deploy.network.simulation import present_samples
from deploy.targets.registry import run_target
from tests.deploy.networks import draw_checks, make_mixed_network


def respond(spec, samples):
    """Responses of the reference to one stream."""
    flat = spec.flatten_samples(samples)
    (output,) = run_reference(spec, [flat])
    return make_responses(spec, output, len(flat), "reference")


@pytest.mark.parametrize("make_spec", [make_image_network, make_mixed_network, make_event_network])
def test_the_reference_is_nengoloihi_before_rounding(make_spec):
    """Both compute in real numbers, NengoLoihi in single precision."""
    spec = make_spec()
    samples = draw_checks(spec, 3).inputs if spec.stimulus.is_static else draw_frames(spec, 3)
    result = respond(spec, samples)
    expected = run_target(spec, samples, "simreal")
    for name in spec.spiking_layers:
        assert expected.spikes[name].sum() > 0, name
        np.testing.assert_allclose(result.spikes[name], expected.spikes[name], rtol=0.02, atol=1)
    np.testing.assert_allclose(
        result.scores, expected.scores, atol=0.02 * np.abs(expected.scores).max()
    )


@pytest.mark.parametrize("tau_ref", [0.0, 0.001, 0.003])
@pytest.mark.parametrize("min_voltage", [0.0, -3.0])
def test_the_equations_are_the_emulator_s_integers_spike_by_spike(tau_ref, min_voltage):
    spec = make_image_network()
    neurons = replace(spec.layers[0].neurons, tau_ref=tau_ref, min_voltage=min_voltage)
    layers = [replace(layer, neurons=neurons) for layer in spec.layers[:2]]
    spec = replace(spec, layers=(*layers, spec.layers[2]))
    samples = spec.flatten_samples(draw_checks(spec, 3).inputs)
    built = build_nengo_network(spec)
    with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:
        blocks = list(sim.model.blocks)
        shown = list(present_samples(built, sim, samples))
    expected = {
        name: np.concatenate([of_sample.spikes[name] for of_sample in shown])
        for name in spec.spiking_layers
    }
    np.testing.assert_array_equal(make_input_spikes(spec, samples), expected["input"])
    sent = expected["input"]
    for layer, block in zip(spec.layers[:2], blocks, strict=True):
        largest = np.abs(layer.weights).max()
        unit = 2 * 64 * 2.0 ** block.compartment.discretize_info["w_exp"]
        integers = replace(layer, weights=np.rint(layer.weights / largest * 127.5) * unit)
        integers = replace(integers, weights=np.clip(integers.weights, -127 * unit, 127 * unit))
        sums = integers.compute_sums(delay_one_step(sent))
        result = read_equations(block.compartment).compute_spikes(sums)
        assert result.sum() > 20
        np.testing.assert_array_equal(result, expected[layer.name])
        sent = expected[layer.name]
