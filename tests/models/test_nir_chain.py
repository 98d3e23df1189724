"""Graphs become layers of the chip: real numbers against the reference, integers against both."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.errors import UserError
from models.nir.chain import from_nir
from models.nir.equations import METHODS
from models.nir.errors import NirError
from models.nir.graph import read_nir
from models.nir.simulator import simulate
from models.rounding import (
    choose_integers,
    choose_synapses_per_weight,
    compute_currents,
    measure_moments,
    round_to_integers,
    simulate_spikes,
)
from tests.models.nir_graphs import Graph, affine, conv, cuba_lif, lif, network_of, spikes, tree_of


def move_channels_last(values):
    """Flatten values of shape (n, steps, channels, rows, columns) in the order of the chip."""
    moved = np.moveaxis(values, 2, -1) if values.ndim > 3 else values
    return moved.reshape(*values.shape[:2], -1)


def run_layers(network, inputs, step, method):
    """Compute the spikes of each layer and the output of the readout, in real numbers."""
    signal = move_channels_last(inputs)
    result = []
    for layer in from_nir(network, step, method):
        if layer.neurons is not None:
            signal = simulate_spikes(layer, signal)
        else:
            added, signal = signal @ layer.kernel, np.zeros((*signal.shape[:2], layer.size))
            state = np.zeros(layer.size)
            keep = 0.0 if layer.synapse is None else np.exp(-0.001 / layer.synapse)
            for t in range(added.shape[1]):
                state = keep * state + (1 - keep) * added[:, t]
                signal[:, t] = state
            signal = signal + layer.bias
        result.append(signal)
    return result


def compare(network, inputs, step=0.001, method="exact"):
    """Identical spikes in every layer; the readout within 1e-6."""
    reference = simulate(network, inputs, step, method, "value")
    expected = [move_channels_last(values) for values in reference.spikes.values()]
    result = run_layers(network, inputs, step, method)
    n = len(expected)
    assert sum(int(w.sum()) for w in expected) > 0
    for layer, one, other in zip(from_nir(network, step, method), result, expected, strict=False):
        assert one.shape == other.shape
        # a voltage within rounding of the threshold is what 64 bits cannot tell
        np.testing.assert_array_equal(one, other, err_msg=str(layer))
    if len(result) > n:
        out = reference.outputs.reshape(result[-1].shape)
        scale = max(float(np.abs(out).max()), 1e-9)
        assert np.abs(result[-1] - out).max() / scale <= 1e-6
    return result


NEURONS = {
    "LIF": lambda rng, n: lif(0.013, 3.0, v_threshold=rng.uniform(0.5, 1.5, n)),
    "CubaLIF": lambda rng, n: cuba_lif(0.005, 0.02, 4.0, w_in=rng.uniform(0.5, 2, n)),
    "IF": lambda rng, n: ("IF", {"r": 300.0, "v_threshold": rng.uniform(0.5, 1.5, n)}),
    "Threshold": lambda rng, n: ("Threshold", {"threshold": rng.uniform(0.5, 1.5, n)}),
}


@pytest.mark.parametrize("kind", NEURONS)
@pytest.mark.parametrize("method", METHODS)
def test_every_kind_of_neuron_is_the_references(kind, method):
    rng = np.random.default_rng(3)
    network = network_of(
        (12,), affine(rng, 9, 12), NEURONS[kind](rng, 9), affine(rng, 4, 9, bias=0.5)
    )
    inputs = spikes(rng, 3, 200, (12,))
    if (kind, method) == ("CubaLIF", "exact"):
        # the change of the current within a step is lost, not its sum
        expected = simulate(network, inputs, 0.001, method).spikes["n1"].sum(1)
        result = run_layers(network, inputs, 0.001, method)[0].sum(1)
        assert np.abs(result - expected).max() <= 3
        assert result.sum() == pytest.approx(expected.sum(), rel=0.05)
        return
    compare(network, inputs, method=method)


@pytest.mark.parametrize(
    "neuron",
    [lif(0.013, 3.0), cuba_lif(0.005, 0.02, 6.0), ("IF", {"r": 300.0, "v_threshold": 1.0})],
)
def test_a_recurrent_layer_is_the_references(neuron):
    rng = np.random.default_rng(1)
    tree = tree_of((12,), affine(rng, 9, 12), neuron, affine(rng, 4, 9, bias=0.5))
    tree["nodes"]["back"] = {"type": "Linear", "weight": rng.normal(0, 0.5, (9, 9))}
    tree["edges"] += [("n1", "back"), ("back", "n1")]
    network, inputs = read_nir(Graph(tree)), spikes(rng, 3, 200, (12,))
    result = compare(network, inputs, method="euler")
    without = simulate(network_without_loop(network), inputs, 0.001, "euler").spikes["n1"]
    assert (result[0] != without).any()


def network_without_loop(network):
    return replace(network, nodes=tuple(replace(node, loop=None) for node in network.nodes))


@pytest.mark.parametrize("method", METHODS)
def test_filters_before_neurons_and_at_the_end(method):
    rng = np.random.default_rng(1)
    li = ("LI", {"tau": 0.008, "r": 2.0, "v_leak": 0.0})
    end = ("LI", {"tau": 0.05, "r": 3.0, "v_leak": 0.0})
    network = network_of((10,), li, affine(rng, 8, 10), lif(0.02, 5.0), affine(rng, 3, 8), end)
    layers = from_nir(network, 0.001, method)
    assert [layer.name for layer in layers] == ["dense1", "output"]
    compare(network, spikes(rng, 2, 200, (10,)), method=method)


def test_leak_and_reset_voltages_and_biases_are_in_the_layers_bias():
    rng = np.random.default_rng(1)
    neuron = lif(0.02, 2.0, v_leak=-0.3, v_reset=-0.3, v_threshold=0.8)
    network = network_of((10,), affine(rng, 8, 10, bias=0.3), neuron, affine(rng, 3, 8))
    compare(network, spikes(rng, 2, 200, (10,), 0.3))


WINDOWS = {
    "valid": [conv(np.random.default_rng(0), 4, 2, 3, bias=0.2)],
    "stride": [conv(np.random.default_rng(0), 4, 2, 3, stride=2)],
    "same": [conv(np.random.default_rng(0), 4, 2, 3, padding=1)],
    "same, by name": [conv(np.random.default_rng(0), 4, 2, 4, padding="same")],
    "stride and padding": [conv(np.random.default_rng(0), 4, 2, 3, padding=1, stride=2)],
    "groups": [conv(np.random.default_rng(0), 4, 1, 3, groups=2)],
    "dilation": [conv(np.random.default_rng(0), 4, 2, 2, dilation=2)],
    "averaging after": [
        conv(np.random.default_rng(0), 4, 2, 3),
        ("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}),
    ],
    "sums before": [
        ("SumPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}),
        conv(np.random.default_rng(0), 4, 2, 2),
    ],
    "scaled": [
        ("Scale", {"scale": np.array([0.5, 2.0]).reshape(2, 1, 1)}),
        conv(np.random.default_rng(0), 4, 2, 3),
    ],
    "other padding": [conv(np.random.default_rng(0), 4, 2, 5, padding=1)],
    "other padding and stride": [conv(np.random.default_rng(0), 4, 2, 5, padding=1, stride=2)],
    "wide padding": [conv(np.random.default_rng(0), 4, 2, 3, padding=2, stride=3)],
    "averaging alone": [("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0})],
    "nothing": [],
}
AS_MATRIX = {
    "rectangular": [conv(np.random.default_rng(0), 4, 2, (2, 3))],
    "two strides": [conv(np.random.default_rng(0), 4, 2, 3, stride=(1, 2))],
    "overlapping": [
        ("AvgPool2d", {"kernel_size": 3, "stride": 2, "padding": 1}),
        conv(np.random.default_rng(0), 4, 2, 2),
    ],
    "two convolutions": [
        conv(np.random.default_rng(0), 3, 2, 3),
        conv(np.random.default_rng(1), 4, 3, 2),
    ],
    "scaled by place": [("Scale", {"scale": np.random.default_rng(0).random((2, 7, 8))})],
}


@pytest.mark.parametrize("name", [*WINDOWS, *AS_MATRIX])
def test_windows(name):
    """Convolutions and averages before neurons, then a convolution and a dense layer after them."""
    rng = np.random.default_rng(5)
    maps = {**WINDOWS, **AS_MATRIX}[name]
    some = network_of((2, 7, 8), *maps, lif(0.02, 12.0))
    channels, rows, columns = some.nodes[-1].shape
    after = [conv(rng, 3, channels, 2), lif(0.01, 8.0), ("Flatten", {"start_dim": 0})]
    size = 3 * (rows - 1) * (columns - 1)
    network = network_of((2, 7, 8), *maps, lif(0.02, 12.0), *after, affine(rng, 4, size))
    layers = from_nir(network, 0.001)
    kind = "conv" if name in WINDOWS else "dense"
    assert [layer.kind for layer in layers] == [kind, kind, "dense"]
    compare(network, spikes(rng, 2, 60, (2, 7, 8), 0.2))


def test_a_row_of_channels():
    rng = np.random.default_rng(5)
    row = ("Conv1d", {"weight": rng.normal(0, 1, (3, 2, 4)), "bias": np.zeros(3), "stride": 2,
                      "padding": 1, "dilation": 1, "groups": 1})  # fmt: skip
    network = network_of((2, 20), row, lif(0.02, 8.0), ("Flatten", {"start_dim": 0}),
                         affine(rng, 4, 30))  # fmt: skip
    assert network.nodes[0].shape == (3, 10)
    compare(network, spikes(rng, 2, 60, (2, 20), 0.2))


@st.composite
def random_networks(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (draw(st.integers(1, 3)), draw(st.integers(4, 7)), draw(st.integers(4, 7)))
    nodes, now = [], shape

    def neuron():
        r = draw(st.floats(4, 20))
        if draw(st.booleans()):
            return lif(draw(st.floats(0.002, 0.1)), r)
        return cuba_lif(draw(st.floats(0.002, 0.05)), draw(st.floats(0.002, 0.1)), r)

    for _ in range(draw(st.integers(0, 2))):
        side = draw(st.integers(1, min(3, *now[1:])))
        filters = draw(st.integers(1, 4))
        stride, padding = draw(st.integers(1, 2)), draw(st.integers(0, side // 2))
        nodes.append(conv(rng, filters, now[0], side, stride=stride, padding=padding))
        now = network_of(shape, *nodes, lif()).nodes[-1].shape
        if draw(st.booleans()) and min(now[1:]) >= 2:
            nodes.append(("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}))
            now = (now[0], now[1] // 2, now[2] // 2)
        nodes.append(neuron())
    nodes.append(("Flatten", {"start_dim": 0}))
    size = int(np.prod(now))
    for _ in range(draw(st.integers(0 if len(nodes) > 1 else 1, 1))):
        nodes += [affine(rng, 6, size), neuron()]
        size = 6
    nodes.append(affine(rng, 3, size))
    return network_of(shape, *nodes), rng


@given(random_networks())
@settings(max_examples=30, deadline=None)
def test_random_graphs_spike_as_the_reference(case):
    network, rng = case
    inputs = spikes(rng, 2, 200, network.input_shape, 0.15)
    reference = simulate(network, inputs, 0.001, "euler")
    result = run_layers(network, inputs, 0.001, "euler")
    for one, other in zip(result, reference.spikes.values(), strict=False):
        np.testing.assert_array_equal(one, move_channels_last(other))
    out = reference.outputs
    assert np.abs(result[-1] - out).max() <= 1e-6 * max(np.abs(out).max(), 1e-9)


def test_integers_by_hand():
    """Weights 1 and -0.5 thresholds: 127 and -64 (63.5); the threshold is 128 x 127 = 64 x 254."""
    network = network_of(
        (2,), ("Linear", {"weight": np.array([[1.0, -0.5]])}), ("Threshold", {"threshold": 1.0})
    )
    (layer,) = from_nir(network, 0.001)
    result = round_to_integers(layer)
    assert result.kernel.T.tolist() == [[127, -64]]
    assert (result.threshold, result.keep_u_4096ths, result.keep_v_4096ths, result.exponent) == (
        64 * 254,
        1,
        2,
        0,
    )
    assert round_to_integers(layer, 0.5).kernel.T.tolist() == [[127, -127]]
    fine = round_to_integers(replace(layer, synapses_per_weight=2))
    assert fine.kernel.T.tolist() == [[380, -190]]
    assert (fine.threshold, fine.exponent) == (64 * 380, -1)


@pytest.mark.parametrize(
    ("inputs", "bias", "synapses"), [(100, 0.0, 2), (700, 0.0, 1), (100, 200.0, 1)]
)
def test_a_recurrent_link_has_two_synapses_if_they_fit(inputs, bias, synapses):
    """Not with too many inputs for a core, or with biases that are too large with half steps."""
    rng = np.random.default_rng(0)
    tree = tree_of((inputs,), affine(rng, 90, inputs, bias=bias), lif(0.1), affine(rng, 4, 90))
    tree["nodes"]["back"] = {"type": "Linear", "weight": rng.normal(0, 0.5, (90, 90))}
    tree["edges"] += [("n1", "back"), ("back", "n1")]
    link, _ = from_nir(read_nir(Graph(tree)), 0.001)
    assert choose_synapses_per_weight(link) == synapses


def test_the_scale_is_chosen_on_samples():
    """A weight a hundred times the others that is never used must not cost them their bits."""
    rng = np.random.default_rng(0)
    weight = rng.normal(0, 0.02, (6, 20))
    weight[0, 0] = 20.0
    network = network_of((20,), ("Linear", {"weight": weight}), lif(0.05, 40.0))
    (layer,) = from_nir(network, 0.001)
    inputs = spikes(rng, 8, 200, (20,), 0.3)
    inputs[:, :, 0] = 0
    assert np.abs(round_to_integers(layer).kernel[1:]).max() < 5
    expected = simulate_spikes(layer, inputs).sum(1).astype(int)

    def error(integers):
        return np.abs(simulate_spikes(layer, inputs, integers).sum(1) - expected).sum()

    assert error(choose_integers(layer, inputs)) < error(round_to_integers(layer))


def test_rounding_is_made_up_for_where_inputs_are_active_together():
    """Of 127, 0.4 and 0.4 the latter two always come together: 1 and 0, not 0 and 0."""
    network = network_of(
        (3,),
        ("Linear", {"weight": np.array([[0.4 / 127, 1.0, 0.4 / 127]])}),
        ("Threshold", {"threshold": 1.0}),
    )
    (layer,) = from_nir(network, 0.001)
    inputs = np.zeros((1, 80, 3))
    inputs[0, ::8] = [1, 0, 1]
    inputs[0, 4::8] = [0, 1, 0]
    result = round_to_integers(layer, 1.0, measure_moments(layer, inputs)).kernel.ravel()
    assert round_to_integers(layer).kernel.ravel().tolist() == [0, 127, 0]
    assert sorted(result[[0, 2]]) == [0, 1]
    assert result[1] == 127


@pytest.mark.parametrize("seed", range(3))
def test_compensated_weights_add_up_better_and_keep_the_largest(seed):
    rng = np.random.default_rng(seed)
    network = network_of(
        (2, 8, 8),
        ("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}),
        conv(rng, 4, 2, 3),
        lif(0.02, 8.0),
        ("Flatten", {"start_dim": 0}),
        affine(rng, 5, 16),
        lif(0.02, 8.0),
    )
    signal = move_channels_last(spikes(rng, 4, 100, (2, 8, 8), 0.2))
    for layer in from_nir(network, 0.001):
        near, made_up = (
            round_to_integers(layer),
            round_to_integers(layer, 1.0, measure_moments(layer, signal)),
        )
        unit = layer.pool**2 * 128 * 2.0**near.exponent / near.threshold
        real = compute_currents(layer, layer.kernel / layer.pool**2, signal)

        def error(integers, layer=layer, signal=signal, unit=unit, real=real):
            added = compute_currents(layer, integers.kernel * unit / layer.pool**2, signal)
            return np.square(np.cumsum(added - real, 1)).mean()

        assert np.abs(made_up.kernel).max() == 127
        assert error(made_up) < error(near)
        signal = simulate_spikes(layer, signal)


def test_what_cannot_be_on_the_chip_is_named():
    rng = np.random.default_rng(0)
    two = lif(np.array([0.01, 0.02]), 1.0)
    with pytest.raises(NirError, match=r"'n1' \(LIF\).* membrane .* 3706 to 3896 "):
        from_nir(network_of((3,), affine(rng, 2, 3), two), 0.001)
    li = ("LI", {"tau": 0.01, "r": 1.0, "v_leak": 0.0})
    with pytest.raises(NirError, match=r"'n0' \(LI\).*filter"):
        from_nir(network_of((3,), li, affine(rng, 2, 3), cuba_lif()), 0.001)
    with pytest.raises(NirError, match=r"'n1' \(LIF\).* 0.0005 s .* 0.001 s"):
        from_nir(network_of((3,), affine(rng, 2, 3), lif(0.0005)), 0.001, "euler")
    nothing = ("Linear", {"weight": np.zeros((2, 3))})
    with pytest.raises(UserError, match=r"n0, n1.* 0[;,.]"):
        round_to_integers(from_nir(network_of((3,), nothing, lif()), 0.001)[0])
    huge = ("Linear", {"weight": np.full((2, 3), 1e6)})
    with pytest.raises(UserError, match=r"n0, n1.* 4\.88e\+04 "):
        round_to_integers(from_nir(network_of((3,), huge, lif()), 0.001)[0])
