"""Firing rates: counted, summed up, and warned of."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.conformance.networks import make_image_network
from deploy.targets.fast import measure_firing_rates
from tests.deploy.networks import draw_checks


def test_rate_of_a_constant_drive():
    """LIF at J = 2: threshold reached after 14 steps, one more is refractory; 1000 / 15 Hz."""
    spec = make_image_network(steps=150, gap=0)
    layer = replace(
        spec.layers[0], weights=np.zeros_like(spec.layers[0].weights), bias=np.full(4, 2.0)
    )
    images = np.zeros((1, 6, 6, 1))
    rates = measure_firing_rates(replace(spec, layers=(layer, *spec.layers[1:])), images)
    expected = 1 / (0.001 + 0.02 * np.log(2))
    assert np.ptp(rates["conv1"]) == 0
    assert rates["conv1"][0, 0] == pytest.approx(expected, rel=0.1)


def test_all_layers_on_the_chip_and_all_samples():
    spec = make_image_network(on_chip_output=True)
    rates = measure_firing_rates(spec, draw_checks(spec, 3).inputs)
    assert {name: values.shape for name, values in rates.items()} == {
        "conv1": (3, 64),
        "conv2": (3, 72),
        "output": (3, 10),
    }
