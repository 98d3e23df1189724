"""Pre-flight: counts against hand-worked ones and the stand-in's, limits, remedies."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.check.energy import estimate_energy
from deploy.check.run import run_check
from deploy.conformance.networks import (
    make_convolution,
    make_dense,
    make_image_network,
    make_readout,
)
from deploy.errors import UserError
from deploy.network.build import build_nengo_network
from deploy.network.chip import LOIHI
from deploy.network.loihi_import import nengo_loihi
from deploy.network.nir import write_nir
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes
from deploy.preflight.plan import make_plan, require_fit_on_chips
from deploy.preflight.resources import count_words_of_synapses
from tests.command import missing
from tests.deploy.networks import bundle_at, make_paper_network


def spec_of(*filters_kernels, shape=(10, 10, 1), block_shape=None):
    rng = np.random.default_rng(0)
    layers, before = [], shape
    for i, (filters, kernel) in enumerate(filters_kernels):
        layer = make_convolution(f"conv{i + 1}", before, filters, kernel, rng)
        layers.append(replace(layer, block_shape=block_shape))
        before = layers[-1].shape
    layers.append(make_readout(before, rng))
    return NetworkSpec("test", shape, ImageSpikes(), layers, Presentation())


def used(plan, layer):
    return [core.used for core in plan.cores if core.layer == layer]


def test_small_network_by_hand():
    # conv1: 4 x 4 pixels of 4 channels; 36 input pixels; its 16 pixels go out as pop32, 2 each.
    # Every input pixel reaches 3 x 3 pixels of 4 neurons, fewer at the edges: of the 36, 16 are
    # away from the edges by more than one, with 36 synapses of 8 bits and 7 bits of index.
    plan = make_plan(make_image_network())
    (conv1,) = used(plan, "conv1")
    assert (conv1["compartments"], conv1["input axons"], conv1["output axons"]) == (64, 36, 32)
    assert conv1["AxonCfg registers"] == 32
    (conv2,) = used(plan, "conv2")
    # 16 pixels; none go out to the chip, since the readout is on the host
    assert (conv2["compartments"], conv2["input axons"], conv2["output axons"]) == (72, 16, 0)
    assert plan.chips == 1
    assert plan.problems == plan.warnings == []


def test_synapse_words_by_hand():
    # one list of 70 weights: 64 of 8 bits and 10 of header are 9 words, 6 more are 1 word
    from nengo_loihi.block import Synapse

    synapse = Synapse(1)
    synapse.set_weights(np.ones((1, 70)))
    assert count_words_of_synapses(synapse, LOIHI) == 9 + 1


@pytest.mark.parametrize(
    "spec",
    [
        make_image_network(),
        make_image_network(on_chip_output=True),
        make_paper_network(),
        spec_of((4, 3), (24, 3), block_shape=(3, 3, 4)),
    ],
    ids=["small", "output-on-chip", "paper", "split"],
)
def test_counts_are_those_of_the_registers_written(nxsdk, spec):
    """Build the board for real and count what NengoLoihi wrote to it."""
    if spec.layers[1].block_shape:
        layers = [replace(spec.layers[1], block_shape=(2, 3, 24))]
        spec = replace(spec, layers=(spec.layers[0], *layers, spec.layers[2]))
    with nengo_loihi.Simulator(
        build_nengo_network(spec).network, target="loihi", precompute=True
    ) as sim:
        board = sim.sims["loihi"].nxsdk_board
    plan = make_plan(spec)
    assert len(plan.cores) == sum(len(chip.n2Cores) for chip in board.n2Chips)
    for core in plan.cores:
        written = board.n2Chips[core.chip].n2Cores[core.core]
        assert core.used["compartments"] == len(written.cxCfg.registers)
        assert core.used["AxonCfg registers"] == written.axon_cfgs()
        assert core.used["synapse words"] == written.synapse_words()
        assert core.used["input axons"] >= len(written.synapseMap.registers)  # but for dummies
        nxsdk.faults.FAULTS.share_axon_cfgs = False
        assert core.unshared_axon_cfgs == written.axon_cfgs()
        nxsdk.faults.FAULTS.share_axon_cfgs = True


def test_current_never_exceeds_its_bound(nxsdk):
    """The worst case is not passed by what the stand-in really computes."""
    spec = make_paper_network()
    bounds = {(core.chip, core.core): core for core in make_plan(spec).cores}
    built = build_nengo_network(spec)
    built.feed.samples = np.ones((1, 100))
    with nengo_loihi.Simulator(built.network, target="loihi", precompute=True) as sim:
        board = sim.sims["loihi"].nxsdk_board
        peaks = {}
        for _ in range(100):
            sim.run_steps(1)
            for i, core in enumerate(board.n2Chips[0].n2Cores):
                peaks[0, i] = max(peaks.get((0, i), 0), int(np.abs(core.u).max()))
    for place, peak in peaks.items():
        assert 0 < peak <= bounds[place].worst_current


def test_too_many_compartments_names_layer_limit_and_remedy():
    spec = spec_of((24, 3), block_shape=(8, 8, 24))  # 8 x 8 x 24 = 1536
    plan = make_plan(spec)
    (problem,) = plan.problems
    assert missing(problem, "layer conv1", "1 of 1 core,", "1536 compartments", 1024) == []
    assert "block_shape" in problem
    with pytest.raises(UserError, match=r"conv1.* 1536 compartments"):
        require_fit_on_chips(spec)


def test_too_many_chips():
    spec = spec_of((2, 3), (2, 3), shape=(20, 20, 1), block_shape=(2, 2, 2))
    plan = make_plan(spec)
    assert len(plan.cores) == 81 + 64
    assert plan.chips == 2
    assert missing(plan.problems[-1], "145 cores", "2 chips") == []
    assert make_plan(spec, chips=2).problems == []


def dense_receiver():
    rng = np.random.default_rng(0)
    conv1 = replace(make_convolution("conv1", (10, 10, 1), 16, 3, rng), block_shape=(8, 8, 16))
    dense1 = replace(make_dense("dense1", conv1.shape, 20, rng), block_shape=(4,))
    layers = (conv1, dense1, make_readout(dense1.shape, rng))
    return NetworkSpec("10x10-16c3-20-10o", (10, 10, 1), ImageSpikes(), layers, Presentation())


def test_a_layer_that_many_parts_of_a_dense_layer_receive():
    (problem,) = (p for p in make_plan(dense_receiver()).problems if "output axons" in p)
    assert missing(problem, "layer conv1", 5 * 1024, 4096) == []


def test_weights_that_can_overflow_are_a_warning():
    spec = spec_of((4, 30), shape=(32, 32, 1))
    layer = spec.layers[0]
    alike = replace(layer, weights=np.ones_like(layer.weights))  # 900 inputs of the same sign
    plan = make_plan(replace(spec, layers=(alike, *spec.layers[1:])))
    assert plan.problems == []
    one_step, current = plan.warnings
    assert missing(one_step, "layer conv1", "input") == []
    assert missing(current, "layer conv1", "current") == []
    assert plan.cores[0].worst_input == 900 * 254 * 64  # of 8 bits one is the sign


def test_a_bundle_is_planned_and_a_path_is_refused_by_name(tmp_path):
    bundle = bundle_at(tmp_path / "bundle")
    assert make_plan(bundle) == make_plan(bundle.spec)
    for function in (make_plan, lambda b: estimate_energy(b, {}), lambda b: write_nir("n.nir", b)):
        with pytest.raises(TypeError, match="not str; read_bundle"):
            function(str(bundle.path))
    with pytest.raises(TypeError, match="not str; read_bundle"):
        run_check(str(bundle.path), "fast", tmp_path / "fast.json")
