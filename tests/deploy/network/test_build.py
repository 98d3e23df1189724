"""The network in Nengo computes what its description says: strides, padding, averaging, blocks."""

from dataclasses import replace

import nengo
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.conformance.networks import (
    make_convolution,
    make_dense,
    make_image_network,
    make_readout,
)
from deploy.network.blocks import BlockNeeds, choose_block, choose_blocks, find_rescaled_layers
from deploy.network.build import build_nengo_network
from deploy.network.chip import LOIHI
from deploy.network.geometry import list_windows
from deploy.network.loihi_import import nengo_loihi
from deploy.network.ops.base import count_blocks, list_ranges
from deploy.network.ops.conv import DeployedConvolution
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes
from deploy.preflight.plan import make_plan
from deploy.targets.registry import run_target


def matrix_of(layer):
    """What the layer is in Nengo, as a matrix (n_outputs, n_inputs)."""
    transform, inputs = layer.operation.make_transform(layer, LOIHI)
    with nengo.Network(seed=0) as network:
        source = nengo.Node(size_in=int(np.prod(layer.input_shape)))
        target = nengo.Node(size_in=layer.size)
        nengo.Connection(
            source if inputs is None else source[inputs], target, transform=transform, synapse=None
        )
        feed = nengo.Node(lambda t: np.eye(source.size_in)[round(t / 0.001) - 1])
        nengo.Connection(feed, source, synapse=None)
        probe = nengo.Probe(target)
    with nengo.Simulator(network, progress_bar=False) as sim:
        sim.run_steps(source.size_in)
    return sim.data[probe].T


def matrix_by_hand(layer):
    """The same from the description alone, window by window."""
    rows, columns, channels = layer.input_shape
    matrix = np.zeros((*layer.shape, rows, columns, channels))
    p = layer.pool
    read = layer.pooled_shape
    if layer.kind == "dense":
        weights = layer.weights.reshape(layer.size, *read)
        for r in range(read[0] * p):
            for c in range(read[1] * p):
                matrix[:, r, c] = weights[:, r // p, c // p] / p**2
    else:
        operation = layer.operation
        before = [
            list_windows(n, operation.kernel_size, operation.stride, operation.padding)[1]
            for n in read[:2]
        ]
        for i in range(layer.shape[0]):
            for j in range(layer.shape[1]):
                for k in range(operation.kernel_size):
                    for m in range(operation.kernel_size):
                        r = i * operation.stride + k - before[0]
                        c = j * operation.stride + m - before[1]
                        if 0 <= r < read[0] and 0 <= c < read[1]:
                            part = slice(r * p, r * p + p), slice(c * p, c * p + p)
                            tap = layer.weights[k, m].T[:, None, None] / p**2
                            matrix[(i, j, slice(None), *part)] += tap
    return matrix.reshape(layer.size, -1)


@st.composite
def layers(draw):
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    pool = draw(st.integers(1, 3))
    shape = (*(draw(st.integers(pool, 9)) for _ in range(2)), draw(st.integers(1, 2)))
    if draw(st.integers(0, 4)) == 0:
        return make_dense("dense1", shape, draw(st.integers(1, 5)), rng, pool=pool)
    padding, stride = draw(st.sampled_from(["valid", "same"])), draw(st.integers(1, 3))
    most = min(shape[:2]) // pool if padding == "valid" else 4
    kernel = draw(st.integers(1, max(1, min(4, most))))
    geometry = dict(stride=stride, padding=padding, pool=pool)
    return make_convolution("conv1", shape, draw(st.integers(1, 3)), kernel, rng, **geometry)


@settings(max_examples=60, deadline=None)
@given(layers())
def test_a_layer_in_nengo_is_the_one_described(layer):
    expected = matrix_by_hand(layer)
    np.testing.assert_allclose(matrix_of(layer), expected, atol=1e-12)
    # Random weights are never zero: what is not zero is a synapse.
    np.testing.assert_array_equal(layer.fan_out, np.count_nonzero(expected, axis=0))


def spec_of(shape, *layers, classes=3):
    rng = np.random.default_rng(1)
    return NetworkSpec(
        "test", shape, ImageSpikes(), (*layers, make_readout(layers[-1].shape, rng, classes)),
        Presentation(steps=20, gap=3, readout_start=5, stream_length=2),
    )  # fmt: skip


def test_multiply_accumulates_of_an_averaging_by_hand():
    rng = np.random.default_rng(0)
    layer = make_convolution("conv1", (7, 6, 2), 3, 2, rng, pool=2)  # 3x3x2 averaged, 2x2x3 out
    spec = spec_of((7, 6, 2), layer)
    macs = spec.multiply_accumulates
    assert macs["conv1"] == 2 * 2 * 3 * (2 * 2 * 2) + 6 * 6 * 2
    assert layer.fan_out.reshape(7, 6, 2)[6].tolist() == [[0, 0]] * 6


def test_the_cut_with_the_fewest_axons():
    rng = np.random.default_rng(0)
    # 26 x 26 x 4 = 2704 neurons, three cores at the least; squares overlap least: four of 15 x 15
    # inputs are 900, three strips of 9 rows (11, 11 and 10 inputs of 28) 896
    layer = make_convolution("conv1", (28, 28, 1), 4, 3, rng)
    assert choose_block(layer) == (9, 26, 4)
    # channels are the last to be cut: each part would see every input
    # 1600 neurons: two parts of 4 x 6 inputs
    wide = make_convolution("conv1", (6, 6, 1), 100, 3, rng)
    assert choose_block(wide) == (2, 4, 100)
    # with nothing else to cut, channels it is
    assert choose_block(make_convolution("conv1", (3, 3, 1), 1600, 3, rng)) == (1, 1, 800)


def test_synapse_memory_and_output_axons_cut_too():
    rng = np.random.default_rng(0)
    # 600 inputs of 256 synapses of 8 bits: 36 words each, 21,600 of 16,384
    layer = make_dense("dense1", (5, 5, 24), 256, rng)
    assert choose_block(layer) == (128,)
    # 1,000 neurons and six blocks after them are 6,000 axons of 4,096: two blocks of 500
    before = make_convolution("conv1", (10, 10, 1), 10, 1, rng)
    after = make_dense("dense1", (10, 10, 10), 600, rng)
    shapes = choose_blocks((before, after))
    assert -(-600 // shapes["dense1"][0]) * np.prod(shapes["conv1"]) <= 4096
    assert make_plan(spec_of((10, 10, 1), before, after)).problems == []


def test_a_layer_of_several_cores():
    rng = np.random.default_rng(0)
    conv1 = make_convolution("conv1", (24, 24, 1), 8, 3, rng)  # 3,872 neurons
    plan = make_plan(spec_of((24, 24, 1), conv1))
    assert plan.problems == []
    assert len(plan.cores) == 4
    assert all(core.used["compartments"] <= 1024 for core in plan.cores)


def away_from_zero(layer):
    """The layer with every weight at least 1 from zero.

    A core whose weights are all drawn small has no exponent for them; NengoLoihi refuses it. Of a
    count of axons and synapses the weights are no part.
    """
    return replace(layer, weights=layer.weights + np.copysign(1, layer.weights))


@settings(max_examples=25, deadline=None)
@given(layers(), st.integers(1, 40), st.data())
def test_the_counts_are_those_that_nengo_loihi_makes(layer, more, data):
    """With a smaller core than there is: layers of a size that a test can build."""
    rng = np.random.default_rng(0)
    after = away_from_zero(make_dense("after", layer.shape, more, rng))
    block = tuple(data.draw(st.integers(1, n)) for n in layer.shape)
    layer = replace(away_from_zero(layer), block_shape=block)
    plan = make_plan(spec_of(layer.input_shape, layer, after))
    needs = BlockNeeds(layer)
    receiver = BlockNeeds(after).resources.make_output_axon_counter(
        choose_blocks((after,))["after"]
    )
    cores = [core.used for core in plan.cores if core.layer == layer.name]
    assert count_blocks(layer.shape, block) == len(cores)
    import itertools

    places = itertools.product(
        *(list_ranges(n, b) for n, b in zip(layer.shape, block, strict=True))
    )
    total = 0
    for parts, used in zip(places, cores, strict=True):
        axons, words = needs.count(parts)
        total += axons
        padded = layer.kind == "conv" and layer.operation.padding == "same" and layer.pool > 1
        if layer.kind == "conv" and not padded:
            if len(cores) > 1:  # whole, NengoLoihi counts axons that reach nothing too
                assert axons == used["input axons"]
            assert words >= used["synapse words"]
            # a word more at most for each input, of which some reach nothing
            assert words <= 1.6 * used["synapse words"] + max(40, np.prod(layer.input_shape))
        assert receiver(parts) == used["output axons"]
    assert total == needs.count_input_axons(block)


def test_a_dense_layer_reads_more_neurons_than_a_core_has_axons():
    """It is the convolution with one window, whose blocks share the weights of averaged pixels."""
    rng = np.random.default_rng(0)
    shape = (27, 26, 8)  # 5,616 neurons; averaging leaves out the last row
    wide = away_from_zero(replace(make_dense("dense1", shape, 7, rng, pool=2), block_shape=(3,)))
    plan = make_plan(spec_of(shape, wide))
    assert plan.problems == []
    assert [core.used["input axons"] for core in plan.cores] == [26 * 26] * 3
    assert max(core.used["synapse words"] for core in plan.cores) == 13 * 13 * 8
    window = wide.weights.reshape(7, 13, 13, 8).transpose(1, 2, 3, 0)
    cut = (26, 26, 8)
    one_window = replace(
        wide, operation=DeployedConvolution(7, 13), input_shape=cut, weights=window,
        block_shape=(1, 1, 3),
    )  # fmt: skip
    samples = rng.uniform(0, 0.3, (1, *shape))
    cut_samples = samples[:, :26]
    expected = run_target(spec_of(cut, one_window), cut_samples, "emulator").spikes["dense1"]
    assert expected.sum() > 5
    for target in ("emulator", "fast"):
        result = run_target(spec_of(shape, wide), samples, target).spikes["dense1"]
        np.testing.assert_array_equal(result, expected)
    # As it divides itself, and counted before NengoLoihi makes the blocks
    own = replace(wide, block_shape=None)
    block = choose_block(own)
    (used, *_) = (core.used for core in make_plan(spec_of(shape, own)).cores)
    assert used["synapse words"] <= BlockNeeds(own).count([(0, block[0])])[1] <= 16384


def test_blocks_fit_by_the_count_of_nengo_loihi_too():
    """It counts the synapses of the 128 channels of a pixel as one sequence of lists."""
    rng = np.random.default_rng(0)
    shape = (10, 10, 128)
    wide = away_from_zero(make_dense("dense1", shape, 44, rng, pool=2))
    assert make_plan(spec_of(shape, wide)).problems == []


def test_a_window_along_one_dimension_by_hand():
    assert list_windows(10, 3, 2, "valid") == (4, 0, 0)
    assert list_windows(10, 3, 2, "same") == (5, 0, 1)
    assert list_windows(2, 3, 1, "valid")[0] < 1


def test_layers_whose_blocks_are_scaled_separately():
    """They are those in which NengoLoihi has several thresholds."""
    rng = np.random.default_rng(0)
    by_filters = replace(make_convolution("conv1", (6, 6, 1), 4, 3, rng), block_shape=(4, 4, 2))
    by_rows = replace(make_convolution("conv2", by_filters.shape, 8, 2, rng), block_shape=(2, 3, 8))
    by_units = replace(make_dense("dense1", by_rows.shape, 6, rng), block_shape=(3,))
    layers = (by_filters, by_rows, by_units, make_readout(by_units.shape, rng))
    spec, thresholds = replace(make_image_network(), layers=layers), {}
    with nengo_loihi.Simulator(
        build_nengo_network(spec).network, target="sim", precompute=True
    ) as sim:
        for block in sim.model.blocks:
            (name,) = [layer.name for layer in layers if f"'{layer.name}'" in block.label]
            thresholds.setdefault(name, set()).update(block.compartment.vth.tolist())
    assert find_rescaled_layers(layers) == ["conv1", "dense1"]
    assert [name for name, result in thresholds.items() if len(result) > 1] == ["conv1", "dense1"]
