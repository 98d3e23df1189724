"""The reference simulator against Norse and snnTorch, node by node, at each of 200 steps."""

import os
import subprocess

import numpy as np
import pytest

from models.nir.conventions import EXPORTED_STEP_S
from models.nir.graph import read_nir
from models.nir.nodes import SPIKING
from models.nir.simulator import simulate
from tests.command import ROOT

PYTHON = ROOT / ".venv-nir" / "bin" / "python"
# Of Norse, as in ``nodes.py``.
STEP = 2.0**-9

CASES = {
    "snntorch-leaky": ("Affine LIF Linear LIF", EXPORTED_STEP_S),
    "snntorch-synaptic": ("Linear CubaLIF Affine LIF", EXPORTED_STEP_S),
    "snntorch-images": ("Conv2d LIF AvgPool2d Conv2d LIF Flatten Affine LIF", EXPORTED_STEP_S),
    "snntorch-recurrent": ("Affine LIF Linear CubaLIF", EXPORTED_STEP_S),
    "norse-writes": ("Affine LIF Affine LI", STEP),
    "norse-reads": ("Affine CubaLIF Affine LIF", STEP),
    # Norse adds the whole input to IF at each step, as a step of 1 s does
    "norse-integrates": ("SumPool2d Conv2d IF Flatten Linear IF", 1.0),
}

# Networks whose framework, step and reset are told from the graph.
RECOGNISED = {
    "norse-cells": "Norse",
    "norse-cells-scaled": "Norse",
    "spikingjelly-if": "SpikingJelly",
    "spikingjelly-lif": "SpikingJelly",
    "spikingjelly-added": "snnTorch",  # the same equation
    "spikingjelly-both": "SpikingJelly",
    "spikingjelly-images": "SpikingJelly",
    "rockpool-currents": "Rockpool",
    "rockpool-voltages": "Rockpool",
    "rockpool-several": "Rockpool",
    "sinabs-several": "time in steps",
    "sinabs-iaf": "time in steps",
    "sinabs-lif": "time in steps",
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not PYTHON.exists() or not os.environ.get("TEST_NIR"),
        reason="needs .venv-nir; 'make test-nir'",
    ),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nodes")
    script = ROOT / "tests" / "nir_networks" / "nodes.py"
    subprocess.run([str(PYTHON), str(script), str(folder)], check=True, timeout=600)
    return folder


@pytest.mark.parametrize("name", CASES)
def test_every_step_is_the_packages(name, folder):
    kinds, step = CASES[name]
    network = read_nir(folder / f"{name}.nir")
    assert [node.kind for node in network.nodes] == kinds.split()
    assert (network.convention.framework == "snnTorch") == name.startswith("snntorch")
    with np.load(folder / f"{name}.npz") as file:
        inputs, expected = file["inputs"], file["outputs"]
    reset = "subtract-late" if name == "snntorch-recurrent" else "value"
    result = simulate(network, inputs, step, "euler", reset)
    assert all(spikes.mean() > 0.001 for spikes in result.spikes.values())
    error = np.abs(result.outputs - expected.reshape(result.outputs.shape)).max()
    spiking = network.nodes[-1].kind in SPIKING
    assert error <= (0 if spiking else 1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", RECOGNISED)
def test_what_is_recognised_has_the_packages_spikes(name, folder):
    network = read_nir(folder / f"{name}.nir")
    assert network.convention.framework.startswith(RECOGNISED[name])
    with np.load(folder / f"{name}.npz") as file:
        inputs, expected = file["inputs"], file["outputs"]
    result = simulate(network, inputs, reset="subtract-all" if "several" in name else "auto")
    assert all(spikes.mean() > 0.001 for spikes in result.spikes.values())
    assert (expected.max() > 1) == ("several" in name)
    same = result.outputs.reshape(expected.shape) == expected
    # A voltage within rounding of the threshold in 32 bits may spike a step later.
    assert same.mean() > 0.999
