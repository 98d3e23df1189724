"""Each framework's way of writing is recognised, and its own step computed."""

from pathlib import Path

import numpy as np
import pytest

from models.nir.equations import METHODS
from models.nir.graph import read_nir
from models.nir.simulator import simulate
from pipeline.kinds.nir.conversion import list_conversion_notes
from pipeline.kinds.nir.importing import Stepping, make_nir_settings
from pipeline.settings import Settings
from tests.models.nir_graphs import affine, cuba_lif, lif, network_of

CASES = Path(__file__).with_name("nir_cases")


def integrator(r):
    return "IF", {"r": r, "v_threshold": 1.0}


def leak(tau, r=1.0):
    return "LI", {"tau": tau, "r": r, "v_leak": 0.0}


def rockpool_gain(tau, step):
    return tau * np.exp(-step / tau) / step


WRITTEN = {
    "snnTorch's Leaky": ([lif(1e-3, 10.0)], "snnTorch", "euler", 1e-4),
    "snnTorch's Synaptic": ([cuba_lif(5e-4, 1e-3, 10.0, w_in=5.0)], "snnTorch", "euler", 1e-4),
    "SpikingJelly's input that does not decay": ([lif(2e-4, 2.0)], "snnTorch", "euler", 1e-4),
    "snnTorch's Synaptic of 2023": ([cuba_lif(2e-4, 1e-3, 10.0)], "snnTorch", "spyx", 1e-4),
    "share and gain by hand": ([lif(10.0, 10.0)], "snnTorch", "euler", 1.0),
    "SpikingJelly's IF": ([integrator(1e4)], "SpikingJelly", "euler", 1e-4),
    "SpikingJelly's IF, another dt": ([integrator(1e3)], "SpikingJelly", "euler", 1e-3),
    "SpikingJelly's LIF": ([lif(2e-4)], "SpikingJelly", "euler", 1e-4),
    "SpikingJelly's both": ([integrator(1e3), lif(2e-3)], "SpikingJelly", "euler", 1e-3),
    "Rockpool's LIFTorch": (
        [cuba_lif(0.01, 0.02, rockpool_gain(0.02, 1e-3))], "Rockpool", "rockpool", 1e-3,
    ),
    "Rockpool's LIFNeuronTorch": (
        [lif(0.0025, rockpool_gain(0.0025, 1e-4))], "Rockpool", "rockpool", 1e-4,
    ),
    "Rockpool's trained time constants": (
        [lif(np.array([0.01, 0.03]), rockpool_gain(np.array([0.01, 0.03]), 0.00137))],
        "Rockpool", "rockpool", 0.00137,
    ),
    "Spyx's LIF": ([lif(10.0, 0.9)], "Spyx", "spyx", 1.0),
    "Spyx's CuBaLIF": ([cuba_lif(2.0, 10.0, 0.9)], "Spyx", "spyx", 1.0),
    "Norse's LIFCell": ([cuba_lif(0.005, 0.01)], "Norse", "norse", 1e-3),
    "Norse's LIFCell, times its step": ([cuba_lif(5e-6, 1e-5)], "Norse", "norse", 1e-6),
    "Norse's LIFBoxCell, times its step": ([lif(1e-5), leak(1e-5)], "Norse", "euler", 1e-6),
    "sinabs' IAF": ([integrator(1.0)], "time in steps", "exact", 1.0),
    "sinabs' LIF and IAF": ([lif(20.0), integrator(1.0)], "time in steps", "exact", 1.0),
    "seconds": ([lif(0.02, 8.0)], "NIR", "exact", None),
    "seconds, gains of 1": ([lif(0.02)], "NIR", "exact", None),
    "steps, other gains": ([lif(10.0, 8.0)], "NIR", "exact", 1.0),
    "other integrators": ([integrator(300.0)], "NIR", "exact", None),
    "other currents": ([cuba_lif(0.01, 0.02, 3.0)], "NIR", "exact", None),
}  # fmt: skip


def test_spyx_neurons_without_a_reset():
    """PSU_LIF is written as LI and Threshold: v <- beta v + S, a spike where v > threshold."""
    rng = np.random.default_rng(0)
    beta = 0.8
    linear = affine(rng, 4, 3)
    nodes = [linear, leak(1 / (1 - beta)), ("Threshold", {"threshold": 1.3})]
    network = network_of((3,), *nodes)
    assert network.convention.framework == "Spyx"
    inputs = (rng.random((2, 50, 3)) < 0.4).astype(float)
    result = simulate(network, inputs).outputs
    voltage = np.zeros((2, 4))
    for step in range(50):
        sums = inputs[:, step] @ network.nodes[0]["weight"].T + network.nodes[0]["bias"]
        voltage = beta * voltage + sums
        np.testing.assert_array_equal(result[:, step], voltage > 1.3)
    assert 0 < result.mean() < 1


@pytest.mark.parametrize("name", WRITTEN)
def test_frameworks_are_recognised(name):
    neurons, framework, method, step = WRITTEN[name]
    maps = [affine(np.random.default_rng(0), 2, n) for n in (4, *[2] * (len(neurons) - 1))]
    nodes = [node for pair in zip(maps, neurons, strict=True) for node in pair]
    result = network_of((4,), *nodes).convention
    assert result.framework.startswith(framework)
    assert result.method == method
    assert result.step_s == pytest.approx(step, rel=1e-3) if step else result.step_s is None


@pytest.mark.parametrize("neuron", [integrator(300.0), lif(10.0, 8.0), lif(0.02, 8.0)])
def test_what_fits_no_framework_is_said(neuron):
    result = network_of((4,), affine(np.random.default_rng(0), 2, 4), neuron).convention
    assert "nir.step" in result.doubt


def test_what_a_graph_says_of_its_step_comes_first():
    tree_with_step = network_of((4,), affine(np.random.default_rng(0), 2, 4), cuba_lif())
    assert tree_with_step.convention.framework == "Norse"
    result = type(tree_with_step)((4,), tree_with_step.nodes, {"dt": 0.001}).convention
    assert (result.method, result.step_s) == ("exact", 0.001)


@pytest.mark.parametrize("name", ["spikingjelly-if", "rockpool-lif", "sinabs-time-in-input",
                                  "tau-in-steps"])  # fmt: skip
def test_spikes_are_the_frameworks(name):
    network = read_nir(CASES / f"{name}.nir")
    result = simulate(network, np.load(CASES / "frames.npy"))
    np.testing.assert_array_equal(result.outputs.sum(1), np.load(CASES / f"{name}.npy"))


def spikes_of_spyx(inputs, alpha, beta, threshold):
    """Spyx's LIF, or CuBaLIF with an alpha; it outputs a spike in the step after."""
    voltage = current = spike = 0.0
    for signal in inputs:
        if alpha is None:
            voltage = beta * voltage + signal - spike * threshold
        else:
            current = alpha * current + signal
            voltage = beta * (voltage - spike * threshold) + current
        spike = float(voltage > threshold)
        yield spike


@pytest.mark.parametrize("alpha", [None, 0.5])
def test_spyx_subtracts_the_threshold_as_its_layers_do(alpha):
    neuron = lif(4.0, 0.75) if alpha is None else cuba_lif(2.0, 4.0, 0.75)
    inputs = np.random.default_rng(0).uniform(0, 0.8, 300)
    result = simulate(network_of((1,), neuron), inputs.reshape(1, 300, 1))
    assert result.outputs.ravel().tolist() == list(spikes_of_spyx(inputs, alpha, 0.75, 1.0))


def test_declared_shapes_of_subgraphs_are_ignored():
    """The nested Input declares 12 values instead of 24."""
    network = read_nir(CASES / "nested-input-shape.nir")
    assert [node.shape for node in network.nodes] == [(24,), (24,), (7,), (7,)]
    assert network.nodes[1].loop is not None
    outputs = simulate(network, np.load(CASES / "frames.npy"), 0.005).outputs
    assert outputs.mean() == pytest.approx(0.8117, abs=1e-4)


def test_the_step_of_recordings_is_not_the_graphs():
    """An image has no steps; snnTorch's 0.1 ms remain, on events too."""
    path = CASES / "image-step.nir"
    changes = make_nir_settings(path, step_ms=20.0)
    assert changes["input"] == {"kind": "image"}
    network = read_nir(path)
    stepping = Stepping.from_settings(Settings().with_values(changes), network)
    assert stepping == Stepping(1e-4, "euler", "value")
    held = np.load(CASES / "image-step-image.npy").reshape(1, 1, 64).repeat(100, 1)
    assert simulate(network, held).outputs.sum(1).tolist() == [[100, 58]]
    events = Settings().with_values(make_nir_settings(path, 20.0, "events"))
    assert (events.input.step, events.nir.step) == (20.0, 0.0)
    assert Stepping.from_settings(events, network) == stepping


BY_HAND = {  # inputs 1, 0, 1
    # I: 1, 0.5, 1.25; v: 0.25 I of each step, three quarters of the rest
    "norse": (cuba_lif(0.002, 0.004), 1e-3, [0.25, 0.3125, 0.546875]),
    # a = 1/2, b = 1/4: I: 0.5, 0.25, 0.625; v: 0.5, 0.375, 0.71875
    "rockpool": (cuba_lif(1e-3 / np.log(2), 1e-3 / np.log(4), 7.0), 1e-3, [0.5, 0.375, 0.71875]),
    # I: 1, 0.5, 1.25; v: 1, 0.75 + 0.5, 0.9375 + 1.25
    "spyx": (cuba_lif(2.0, 4.0, 0.75), 1.0, [1.0, 1.25, 2.1875]),
    # v: 1, 0.75, 1.5625
    "euler": (lif(4e-4, 4.0), 1e-4, [1.0, 0.75, 1.5625]),
}


@pytest.mark.parametrize("method", BY_HAND)
def test_steps_by_hand(method):
    neuron, step, expected = BY_HAND[method]
    equation = METHODS[method](network_of((1,), neuron).nodes[0], step)
    voltage = current = 0.0
    for signal, right in zip((1.0, 0.0, 1.0), expected, strict=True):
        voltage = equation.keep_v * voltage + equation.v_from_i * current
        voltage = voltage + equation.v_from_s * signal
        current = equation.keep_i * current + equation.i_from_s * signal
        assert voltage == pytest.approx(right)


@pytest.mark.parametrize(
    ("node", "step", "problem"),
    [
        (lif(0.9, 3.0), 0.001, "longer than a whole sample"),
        (lif(0.003, 9.0), 0.02, "shorter than a step"),
    ],
)
def test_doubtful_times_are_named_with_the_setting(node, step, problem):
    network = network_of((4,), affine(np.random.default_rng(0), 2, 4), node)
    settings = Settings().with_values({"input": {"kind": "events", "step": 20.0}})
    stepping = Stepping(step, "exact")
    lines = [
        line for line in list_conversion_notes(network, (), stepping, settings) if problem in line
    ]
    assert len(lines) == 1
    assert "'n1'" in lines[0]
    assert "nir.step" in lines[0]


def test_dimensions_of_time_and_nodes_that_change_nothing():
    rng = np.random.default_rng(0)
    shape = {"start_dim": 1, "end_dim": -1}
    network = network_of((60, 12), ("Flatten", shape), affine(rng, 24, 12), ("Identity", {}), lif())
    assert network.input_shape == (12,)
    reshaped = ("Reshape", {"shape": np.array([2, 12])})
    assert network_of((24,), reshaped, lif()).nodes[0].shape == (2, 12)
