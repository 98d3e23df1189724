"""Weights that are the sum of several synapses: their parts, and NengoLoihi's integers of them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.conformance.networks import make_dense, make_readout
from deploy.errors import UserError
from deploy.network.blocks import choose_block
from deploy.network.layer import Layer
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes
from deploy.network.synapses import count_weight_levels, split_layer, split_weights
from deploy.preflight import plan


def test_the_parts_of_weights_by_hand():
    """The largest weight is 380 steps: 254 of the coarse synapse and 126 of the fine one."""
    steps = np.array([380.0, -379, 127, 126, -3, 0])
    coarse, fine = split_weights(0.5 * steps, 0.5, 2)
    assert (coarse / 0.5).tolist() == [254, -254, 2, 0, 0, 0]
    assert (fine / 0.5).tolist() == [126, -125, 125, 126, -3, 0]


def test_the_largest_of_small_weights_has_large_parts():
    """Otherwise NengoLoihi's exponents would be below 0 and -1."""
    coarse, fine = split_weights(np.array([3.0, -1.0]), 1.0, 2)
    assert coarse.tolist() == [68, 0]
    assert fine.tolist() == [-65, -1]


def split_random_steps(synapses, seed, step):
    """Random weights in steps, and the steps of each synapse; the fine one is the last."""
    levels = count_weight_levels(synapses)
    rng = np.random.default_rng(seed)
    largest = rng.integers(0, levels + 1)
    steps = rng.integers(-largest, largest + 1, (4, 5))
    return steps, np.rint(np.stack(split_weights(steps * step, step, synapses)) / step)


SPLITS = (st.integers(2, 5), st.integers(0, 2**32), st.floats(1e-6, 1e6))


@given(*SPLITS)
def test_the_weights_of_synapses_add_up(synapses, seed, step):
    steps, by_synapse = split_random_steps(synapses, seed, step)
    np.testing.assert_array_equal(sum(by_synapse), steps)


@given(*SPLITS)
def test_the_weights_of_synapses_are_in_range(synapses, seed, step):
    _, (*coarse, fine) = split_random_steps(synapses, seed, step)
    assert np.abs(fine).max() <= 126
    for part in coarse:
        assert (part % 2 == 0).all()
        assert np.abs(part).max() <= 254


def make_layer_of_steps(synapses, recurrent_size):
    """A layer of 6 neurons on images, with weights in whole steps, and these steps."""
    rng = np.random.default_rng(0)
    levels = count_weight_levels(synapses)
    steps = rng.integers(-levels, levels + 1, (6, 12))
    steps[2, 3] = levels
    own = rng.integers(-recurrent_size, recurrent_size + 1, (6, 6))
    layer = replace(make_dense("dense1", (2, 3, 2), 6, rng), synapses_per_weight=synapses)
    area = ImageSpikes().area
    real_step = 2.7e-4
    return (
        replace(
            layer,
            weights=steps * (real_step / area),
            recurrent=own * (real_step / layer.neurons.amplitude),
        ),
        np.concatenate([steps.T, own.T]),
    )


@pytest.mark.parametrize("recurrent_size", [1, 3, 100, 350])
def test_nengo_loihi_adds_the_integers_of_the_weights(recurrent_size, recwarn):
    layer, steps = make_layer_of_steps(2, recurrent_size)
    layers = (layer, make_readout((6,), np.random.default_rng(0)))
    spec = NetworkSpec(
        "2x3x2-6-10o", (2, 3, 2), ImageSpikes(), layers, Presentation(steps=20, readout_start=0)
    )
    _, blocks = plan._build_blocks(spec, plan.LOIHI)
    ((block,),) = (blocks["dense1"],)
    found = {12: 0, 6: 0}
    for synapse in block.synapses:
        found[synapse.n_axons] = found[synapse.n_axons] + np.concatenate(synapse.weights)
    np.testing.assert_array_equal(np.concatenate([found[12], found[6]]), 64 * steps)
    assert not [warning for warning in recwarn if "extra bits" in str(warning.message)]


def test_one_synapse_is_the_layer_itself():
    layer = make_dense("dense1", (2, 3, 2), 6, np.random.default_rng(0))
    assert split_layer(layer, 0.001) == (layer,)
    assert "synapses_per_weight" not in layer.to_json()


def test_weights_of_zero_can_be_split():
    layer = make_dense("dense1", (2, 3, 2), 6, np.random.default_rng(0))
    layer = replace(layer, weights=np.zeros((6, 12)), synapses_per_weight=2)
    assert all(not part.weights.any() for part in split_layer(layer, 0.001))


def test_the_number_is_read_back():
    layer, _ = make_layer_of_steps(3, 10)
    arrays = {f"dense1.{name}": getattr(layer, name) for name in layer.arrays}
    assert Layer.from_json(layer.to_json(), arrays, "").synapses_per_weight == 3


@pytest.mark.parametrize("number", [0, 9])
def test_an_impossible_number_is_refused(number):
    layer = make_dense("dense1", (2, 3, 2), 6, np.random.default_rng(0))
    with pytest.raises(UserError, match="synapses_per_weight"):
        replace(layer, synapses_per_weight=number)


def test_a_readout_on_the_host_has_no_synapses():
    readout = make_readout((6,), np.random.default_rng(0))
    with pytest.raises(UserError, match="only a layer on the chip"):
        replace(readout, synapses_per_weight=2)


def test_a_layer_is_divided_if_its_synapses_do_not_fit_on_a_core():
    rng = np.random.default_rng(0)
    layer = replace(make_dense("dense1", (500,), 160, rng), recurrent=np.eye(160))
    assert choose_block(layer) == (160,)
    assert choose_block(replace(layer, synapses_per_weight=2)) != (160,)
