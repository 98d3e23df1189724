"""Export to NIR: read back, and run in Norse, which knows nothing of this project."""

import math
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deploy.conformance.networks import (
    make_convolution,
    make_dense,
    make_image_network,
    make_readout,
)
from deploy.errors import UserError
from deploy.files import read_arrays
from deploy.network.chip import DT
from deploy.network.nir import make_graph_input, make_nir_graph, write_nir
from deploy.targets.registry import run_target
from tests.deploy.network.test_build import matrix_by_hand
from tests.deploy.networks import draw_checks, make_paper_network
from tests.nir_reader.result import responses_of

nir = pytest.importorskip("nir")

ROOT = Path(__file__).parent.parent.parent.parent
READER = ROOT / ".venv-nir" / "bin" / "python"


def test_file_is_read_back_whole(tmp_path):
    spec = make_image_network()
    write_nir(tmp_path / "network.nir", spec)
    graph = nir.read(str(tmp_path / "network.nir"))
    edges = dict(graph.edges)
    path, place = [], "input"
    while place != "output":
        place = edges[place]
        path.append(type(graph.nodes[place]).__name__)
    assert path == ["Conv2d", "CubaLIF", "Conv2d", "CubaLIF", "Flatten", "Affine", "Output"]
    conv1 = graph.nodes["conv1_weights"]
    # filter 2, channel 0, row 1, column 2
    assert conv1.weight[2, 0, 1, 2] == spec.layers[0].weights[1, 2, 0, 2]
    np.testing.assert_array_equal(conv1.bias, spec.layers[0].bias)
    assert graph.nodes["conv1_neurons"].tau_syn.shape == (4, 4, 4)
    assert graph.metadata["dt"] == DT


def test_readout_is_permuted_to_channels_first():
    """Flattened as (channels, rows, columns), the same map must give the same output."""
    spec = make_image_network()
    layer = spec.layers[-1]
    values = np.random.default_rng(1).normal(size=layer.input_shape)
    weight = make_nir_graph(spec).nodes["output_weights"].weight
    result = layer.weights @ values.ravel() * 0.01 / 0.001  # of the spike's amplitude over dt
    np.testing.assert_allclose(weight @ np.moveaxis(values, -1, 0).ravel(), result)


def test_output_neurons_are_exported():
    spec = make_image_network(on_chip_output=True)
    assert type(make_nir_graph(spec).nodes["output_neurons"]) is nir.CubaLIF


def test_neurons_without_a_filter_are_exported_as_lif():
    spec = make_image_network()
    layers = (replace(spec.layers[0], synapse=None), *spec.layers[1:])
    assert type(make_nir_graph(replace(spec, layers=layers)).nodes["conv1_neurons"]) is nir.LIF


def test_input_spikes_are_the_encoders():
    spec = make_image_network()
    images = draw_checks(spec, 7).inputs
    spikes = make_graph_input(spec, images)
    assert set(np.unique(spikes)) == {0, 2}  # 1 ms of an area of 1 / 500
    counted = run_target(spec, images, "nengo").spikes["input"]
    np.testing.assert_array_equal(spikes.sum((1, 2, 3, 4)) / 2, counted)


def test_without_the_package(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "nir", None)
    with pytest.raises(UserError, match="needs the package nir"):
        write_nir(tmp_path / "x.nir", make_image_network())


def euler(tau):
    """The time constant whose exact decay over one step is the Euler step's of ``tau``."""
    return -DT / math.log(1 - DT / tau)


def without_what_nir_leaves_out(spec):
    """No refractory period, no lower bound of the voltage, decays as Euler steps make them."""
    layers = []
    for layer in spec.layers:
        if layer.neurons is not None:
            neurons = replace(
                layer.neurons, tau_ref=0.0, min_voltage=-1e6, tau_rc=euler(layer.neurons.tau_rc)
            )
            layer = replace(layer, neurons=neurons, synapse=euler(layer.synapse))
        layers.append(layer)
    return replace(spec, layers=tuple(layers))


@pytest.mark.slow
@pytest.mark.skipif(not READER.exists(), reason="no environment with Norse; 'make setup-nir'")
def test_norse_gives_what_the_reference_gives_without_what_nir_leaves_out(tmp_path):
    spec = make_paper_network(steps=60, gap=10)
    images = draw_checks(spec, 20).inputs
    write_nir(tmp_path / "network.nir", spec)
    np.savez(tmp_path / "in.npz", spikes=make_graph_input(spec, images))
    subprocess.run(
        [
            str(READER), str(ROOT / "tests" / "nir_reader" / "run_norse.py"),
            str(tmp_path / "network.nir"), str(tmp_path / "in.npz"), str(tmp_path / "out.npz"),
        ],
        check=True, timeout=300,
    )  # fmt: skip
    norse = responses_of(
        spec,
        read_arrays(tmp_path / "in.npz", "run the test again"),
        read_arrays(tmp_path / "out.npz", "run the test again"),
    )
    as_deployed = run_target(spec, images, "nengo")
    as_nir_says = run_target(without_what_nir_leaves_out(spec), images, "nengo")

    def likeness(answers):
        return np.corrcoef(norse.scores.ravel(), answers.scores.ravel())[0, 1]

    for layer in ("conv1", "conv2"):
        # what is left is one step of delay a layer and the bias that comes through the filter
        spikes = norse.spikes[layer].sum()
        assert spikes == pytest.approx(as_nir_says.spikes[layer].sum(), rel=0.03)
        assert spikes > 1.05 * as_deployed.spikes[layer].sum()
    np.testing.assert_array_equal(norse.spikes["input"], as_deployed.spikes["input"])
    assert likeness(as_nir_says) > 0.99
    assert likeness(as_nir_says) > likeness(as_deployed)


def test_strides_padding_and_averaging_are_the_networks():
    """The graph's nodes, worked out in NumPy, against the network's own fan-in of every neuron."""
    rng = np.random.default_rng(0)
    layer = make_convolution("conv1", (9, 8, 2), 3, 3, rng, stride=2, padding="same", pool=2)
    hidden = make_dense("dense1", layer.shape, 4, rng)
    spec = replace(
        make_image_network(),
        input_shape=(9, 8, 2),
        layers=(layer, hidden, make_readout((4,), rng, 3)),
    )
    nodes = make_nir_graph(spec).nodes
    names = ["conv1_pool", "conv1_weights", "conv1_neurons", "dense1_flatten", "dense1_weights"]
    assert list(nodes)[1:6] == names
    pool, graph = nodes["conv1_pool"], nodes["conv1_weights"]
    image = rng.normal(size=(9, 8, 2))
    size = int(pool.kernel_size[0])
    assert size == int(pool.stride[0]) == 2
    mean = image[:8, :8].reshape(4, size, 4, size, 2).mean((1, 3)).transpose(2, 0, 1)
    padded = np.pad(mean, ((0, 0), *((int(n), int(n)) for n in graph.padding)))
    rows, columns = graph.weight.shape[2:]
    step = graph.stride[0]
    result = np.array(
        [
            [
                np.tensordot(graph.weight, padded[:, i : i + rows, j : j + columns], 3)
                for j in range(0, padded.shape[2] - columns + 1, step)
            ]
            for i in range(0, padded.shape[1] - rows + 1, step)
        ]
    )
    expected = matrix_by_hand(layer) @ image.ravel()
    np.testing.assert_allclose(result.reshape(-1), expected)
    assert graph.output_type["output"].tolist() == [3, 2, 2]
