"""The reference simulator against hand-worked steps and a solver of differential equations."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models.nir.errors import NirError
from models.nir.graph import read_nir
from models.nir.simulator import RESETS, run_node, simulate
from tests.models.nir_graphs import Graph, conv, lif, network_of, tree_of

H = 0.002


def solved(rates, start, inputs):
    """State at the end of each step; ``rates(state, s)`` with the input held in a step."""
    states, state = [], np.array(start, float)
    for s in inputs:
        result = solve_ivp(lambda t, y, s=s: rates(y, s), (0, H), state, rtol=1e-11, atol=1e-13)
        state = result.y[:, -1]
        states.append(state)
    return np.array(states)


def filtered(kind, inputs, method="exact", **values):
    network = network_of((1,), (kind, values), ("Threshold", {"threshold": 1e3}))
    return run_node(network.nodes[0], inputs.reshape(1, -1, 1), H, method)[0, :, 0]


@pytest.mark.parametrize("tau_syn", [0.004, 0.0100001, 0.01])
def test_exact_steps_solve_the_equations(tau_syn):
    s = np.random.default_rng(0).normal(0, 1, 40)
    tau, r, leak, w = 0.01, 1.7, 0.2, 0.6
    li = solved(lambda y, s: (leak - y + r * s) / tau, [leak], s)[:, 0]
    np.testing.assert_allclose(filtered("LI", s, tau=tau, r=r, v_leak=leak), li, atol=1e-8)

    def rates(y, s):
        return [(leak - y[0] + r * y[1]) / tau, (-y[1] + w * s) / tau_syn]

    cuba = solved(rates, [leak, 0], s)[:, 0]
    result = filtered("CubaLI", s, tau_syn=tau_syn, tau_mem=tau, r=r, v_leak=leak, w_in=w)
    np.testing.assert_allclose(result, cuba, atol=1e-8)


def test_steps_by_hand():
    """b = 1/2: v = 0.6, 0.9, 1.05 spikes and resets to 0.1, 0.65."""
    tau = H / math.log(2)
    network = network_of((1,), lif(tau, 1.2, v_threshold=1.0, v_reset=0.1))
    result = simulate(network, np.ones((1, 4, 1)), H, "exact", "value")
    assert result.outputs[0, :, 0].tolist() == [0, 0, 1, 0]
    assert result.spikes["n0"].dtype == bool
    # Euler with the same share: tau = 2 h
    network = network_of((1,), lif(2 * H, 1.2, v_threshold=1.0, v_reset=0.1))
    assert simulate(network, np.ones((1, 4, 1)), H, "euler").outputs[0, :, 0].tolist() == [
        0, 0, 1, 0,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("r", "value", "subtract", "late"),
    [
        # 0.95 a step; value: 0.95, 1.425; subtract: 0.95, 1.425, 0.2125 + 0.95, 0.08 + 0.95, 0.97;
        # late: 0.95, 1.425, 0.7125 - 1 + 0.95, 1.28, 0.59
        (1.9, [0, 1, 0, 1, 0], [0, 1, 1, 1, 0], [0, 1, 0, 1, 0]),
        # 0.79 a step; late: 0.79, 1.185, 0.5925 - 1 + 0.79, 0.98, 1.28
        (1.58, [0, 1, 0, 1, 0], [0, 1, 0, 1, 0], [0, 1, 0, 0, 1]),
    ],
)
def test_resets_by_hand(r, value, subtract, late):
    network = network_of((1,), lif(2 * H, r))
    for reset, expected in zip(RESETS[:3], (value, subtract, late), strict=True):
        result = simulate(network, np.ones((1, 5, 1)), H, "euler", reset).outputs[0, :, 0]
        assert result.tolist() == expected, reset


def test_several_spikes_in_a_step_by_hand():
    """sinabs: v = 2.5 - 2, 0.5 - 4 and not below -1, -0.5, 2 - 2; Rockpool's LIF has no limit."""
    inputs = np.array([2.5, -4.0, 0.5, 2.5]).reshape(1, 4, 1)
    integrator = network_of((1,), ("IF", {"r": 1.0, "v_threshold": 1.0}))
    result = simulate(integrator, inputs, reset="subtract-all")
    assert result.outputs.ravel().tolist() == result.spikes["n0"].ravel().tolist() == [2, 0, 0, 2]
    # v = 2.5 - 2, 0.25 - 4, -1.875 + 0.5, -0.69 + 2.5
    leaky = simulate(network_of((1,), lif(2.0, 0.5)), inputs, 1.0, "spyx", "subtract-all")
    assert leaky.outputs.ravel().tolist() == [2, 0, 0, 1]


def test_integrate_and_fire_and_thresholds_by_hand():
    network = network_of((1,), ("IF", {"r": 0.4 / H, "v_threshold": 1.0}))
    assert simulate(network, np.ones((1, 6, 1)), H).outputs[0, :, 0].tolist() == [0, 0, 1, 0, 0, 1]
    network = network_of((2,), ("Threshold", {"threshold": np.array([0.5, 1.5])}))
    assert simulate(network, np.ones((1, 2, 2)), H).outputs[0].tolist() == [[1, 0], [1, 0]]


def test_windows_by_hand():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, 5, 6))
    kind, values = conv(rng, 4, 1, 2, bias=1.0, stride=(1, 2), padding=(1, 0), dilation=(2, 1),
                        groups=2)  # fmt: skip
    node = network_of((2, 5, 6), (kind, values), lif()).nodes[0]
    result = run_node(node, x[None, None], H)[0, 0]
    padded = np.pad(x, ((0, 0), (1, 1), (0, 0)))
    assert result.shape == node.shape == (4, 5, 3)
    for f, row, column in np.ndindex(result.shape):
        channel = f // 2
        seen = padded[channel, row : row + 3 : 2, 2 * column : 2 * column + 2]
        expected = (values["weight"][f, 0] * seen).sum() + values["bias"][f]
        assert result[f, row, column] == pytest.approx(expected)


def test_rows_by_hand():
    rng = np.random.default_rng(0)
    x, weight = rng.normal(size=(2, 9)), rng.normal(size=(3, 2, 4))
    row = {"weight": weight, "bias": np.arange(3.0), "stride": 2, "padding": 1, "dilation": 1,
           "groups": 1}  # fmt: skip
    node = network_of((2, 9), ("Conv1d", row), lif()).nodes[0]
    result = run_node(node, x[None, None], H)[0, 0]
    padded = np.pad(x, ((0, 0), (1, 1)))
    for f in range(3):
        added = sum(np.correlate(padded[c], weight[f, c], "valid") for c in range(2))
        np.testing.assert_allclose(result[f], added[::2] + f)


@pytest.mark.parametrize("kind", ["AvgPool2d", "SumPool2d"])
def test_pools_by_hand(kind):
    x = np.random.default_rng(0).normal(size=(2, 5, 5))
    values = {"kernel_size": 3, "stride": 2, "padding": 1}
    node = network_of((2, 5, 5), (kind, values), lif()).nodes[0]
    result = run_node(node, x[None, None], H)[0, 0]
    corner = x[:, :2, :2].sum((1, 2))  # of nine places, five outside count as 0
    np.testing.assert_allclose(result[:, 0, 0], corner / (9 if kind == "AvgPool2d" else 1))
    assert result.shape == (2, 3, 3)


def test_an_euler_step_longer_than_a_time_constant_is_refused():
    network = network_of((1,), lif(0.001))
    with pytest.raises(NirError, match=r"'n0' \(LIF\): .*tau .* 0.001 s .* 0.002 s"):
        simulate(network, np.ones((1, 2, 1)), H, "euler")


@pytest.mark.parametrize("kind", ["Linear", "Affine"])
def test_a_loop_by_hand(kind):
    """Each step adds 0.4; a spike of the step before adds -0.3 (and the Affine's bias 0.1)."""
    tree = tree_of((1,), ("IF", {"r": 1 / H, "v_threshold": 1.0}))
    tree["nodes"]["back"] = {"type": kind, "weight": [[-0.3]], "bias": [0.1]}
    tree["edges"] += [("n0", "back"), ("back", "n0")]
    if kind == "Linear":
        del tree["nodes"]["back"]["bias"]
    result = simulate(read_nir(Graph(tree)), np.full((1, 8, 1), 0.4), H).outputs[0, :, 0]
    # Linear: 0.4, 0.8, 1.2; 0.1, 0.5, 0.9, 1.3; 0.1.  Affine: 0.5, 1, 1.5; 0.2, 0.7, 1.2; 0.2, 0.7
    expected = {"Linear": [0, 0, 1, 0, 0, 0, 1, 0], "Affine": [0, 0, 1, 0, 0, 1, 0, 0]}[kind]
    assert result.tolist() == expected


@pytest.mark.parametrize(("value", "step"), [(1, 0), (1, -H), (1, np.nan), (np.nan, H)])
def test_a_step_or_an_input_that_is_no_number(value, step):
    with pytest.raises(ValueError, match="step"):
        simulate(network_of((1,), lif(0.1)), np.full((1, 2, 1), value), step)
