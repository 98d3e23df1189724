"""The stand-in for NxSDK: its arithmetic against hand-worked numbers, its limits, its faults."""

import nengo
import nengo_loihi
import numpy as np
import pytest
from nengo.exceptions import SimulationError


def one_core(nxsdk, n_cores=1, n_synapses=64):
    from nxsdk.arch.n2a.n2board import N2Board

    board = N2Board(1, 1, [n_cores], [[n_synapses] * n_cores])
    return board, board.n2Chips[0].n2Cores


def set_compartment(core, index, bias=0, vth=10, decay_u=4095, decay_v=0, refractory=1):
    """One integrating compartment: threshold ``64 * vth``, no memory of its input."""
    core.cxProfileCfg[0].configure(decayU=decay_u, decayV=decay_v, refractDelay=refractory)
    core.vthProfileCfg[0].staticCfg.configure(vth=vth)
    core.cxCfg[index].configure(bias=bias, biasExp=0, vthProfile=0, cxProfile=0)
    core.cxMetaState[index // 4].configure(**{f"phase{index % 4}": 2})
    core.numUpdates.configure(numUpdates=index // 4 + 1)
    core.dendriteSharedCfg.configure(posVmLimit=7, negVmLimit=0)


def set_synapse(core, axon=0, start=0, weights=((100,),), kind="discreteMapEntry", base=0, **form):
    """Input axon with one list of weights for each atom; 8 bits with the sign in them."""
    form = {"wgtBits": 7, "numSynapses": 63, "fanoutType": 1, "compression": 3, **form}
    core.synapseFmt[1].configure(**form)
    pointer = start
    for atom in weights:
        for target, weight in enumerate(atom):
            core.synapses[pointer].configure(CIdx=target, Wgt=weight, synFmtId=1)
            pointer += 1
    core.synapseMap[axon].configure(
        synapsePtr=start, synapseLen=len(weights[0]), popSize=len(weights)
    )
    getattr(core.synapseMap[axon], kind).configure(cxBase=base)


def probed(board, core, compartment, steps, key="spike"):
    (probe,) = board.monitor.probe(core.cxState, [compartment], key)
    board.start()
    board.run(steps)
    return probe.timeSeries.data


def test_bias_integrates_to_threshold_by_hand(nxsdk):
    # threshold 640, 200 a step: 200, 400, 600, 800 > 640; then a refractory period of
    # 2 steps counted from the spike's own, that is one silent step, and 4 more to the next.
    board, (core,) = one_core(nxsdk)
    set_compartment(core, 0, bias=200, refractory=2)
    assert probed(board, core, 0, 10) == [0, 0, 0, 1, 0, 0, 0, 0, 1, 0]


def test_voltage_decays_by_hand(nxsdk):
    # half of it stays, rounded towards zero: 5, 2 + 5, 3 + 5, 4 + 5, 4 + 5
    board, (core,) = one_core(nxsdk)
    set_compartment(core, 0, bias=5, decay_v=2048)
    assert probed(board, core, 0, 5, "v") == [5, 7, 8, 9, 9]


def test_input_spike_arrives_one_step_later_by_hand(nxsdk):
    from nxsdk.graph.nxinputgen.nxinputgen import BasicSpikeGenerator

    board, (core,) = one_core(nxsdk)
    set_compartment(core, 0, vth=2000)
    set_synapse(core, weights=((101,),))  # the sign takes the lowest bit: 100, times 64
    BasicSpikeGenerator(board).addSpike(time=2, chipId=1, coreId=4, axonId=0)
    assert probed(board, core, 0, 5, "u") == [0, 0, 6400, 0, 0]


def test_current_decays_by_hand(nxsdk):
    # the chip adds 1 to the decay: 6400 * 2048 / 4096, then half of it again
    from nxsdk.graph.nxinputgen.nxinputgen import BasicSpikeGenerator

    board, (core,) = one_core(nxsdk)
    set_compartment(core, 0, vth=2000, decay_u=2047)
    set_synapse(core, weights=((100,),))
    BasicSpikeGenerator(board).addSpike(time=1, chipId=1, coreId=4, axonId=0)
    assert probed(board, core, 0, 4, "u") == [0, 6400, 3200, 1600]


def test_negative_weight_exponent_shifts_the_mantissa(nxsdk):
    from nxsdk.graph.nxinputgen.nxinputgen import BasicSpikeGenerator

    board, (core,) = one_core(nxsdk)
    set_compartment(core, 0, vth=2000)
    set_synapse(core, weights=((-100,),), wgtExp=-2)
    BasicSpikeGenerator(board).addSpike(time=1, chipId=1, coreId=4, axonId=0)
    assert probed(board, core, 0, 2, "u") == [0, -1600]


def test_population_spike_chooses_the_weights_of_its_atom(nxsdk):
    from nxsdk.graph.nxinputgen.nxinputgen import BasicSpikeGenerator

    board, (core,) = one_core(nxsdk)
    for i in range(6):
        set_compartment(core, i, vth=2000)
    set_synapse(core, weights=((10, 20), (30, 40)), kind="population16MapEntry", base=1)
    generator = BasicSpikeGenerator(board)
    generator.addPop16Spike(time=1, chipId=1, coreId=4, axonId=0, srcAtom=1, atomBits=0)
    (p4, p5) = board.monitor.probe(core.cxState, [4, 5], "u")  # the base counts in fours
    board.start()
    board.run(2)
    assert (p4.timeSeries.data[1], p5.timeSeries.data[1]) == (30 * 64, 40 * 64)


def test_spike_crosses_from_core_to_core(nxsdk):
    board, (first, second) = one_core(nxsdk, n_cores=2)
    set_compartment(first, 0, bias=1000)
    set_compartment(second, 0, vth=2000)
    set_synapse(second, weights=((100,),))
    first.createDiscreteAxon(srcCxId=0, dstChipId=1, dstCoreId=second.id, dstSynMapId=0)
    assert probed(board, second, 0, 4, "u") == [0, 6400, 6400, 6400]


def test_current_wraps_around_as_on_the_chip(nxsdk):
    from nxsdk.core import wrap

    assert wrap(np.array([2**23 - 1, 2**23, -(2**23) - 1]), 23).tolist() == [
        2**23 - 1,
        -(2**23),
        2**23 - 1,
    ]


def test_compartment_that_is_not_updated_is_refused(nxsdk):
    board, (core,) = one_core(nxsdk)
    set_compartment(core, 5)
    core.numUpdates.configure(numUpdates=1)
    with pytest.raises(Exception, match="compartment 5 is beyond the 4 that are updated"):
        board.start()


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda core: core.cxCfg[0].configure(biass=1), "no field biass"),
        (lambda core: core.cxCfg[0].configure(bias=5000), "outside -4096 to 4095"),
        (lambda core: core.cxCfg[1024], "1024 of these"),
        (lambda core: core.synapseMap[4096], "4096 of these"),
        (lambda core: core.cxCfg[0].configure(bias=1.5), "whole number"),
        (lambda core: core.createPop16Axon(0, 0, 32, 1, 4, 0), "atoms below 32"),
        (lambda core: core.createPop32Axon(0, 0, 0, 1, 4, 4096), "a core has 4096"),
    ],
)
def test_wrong_write_is_refused(nxsdk, write, message):
    _, (core,) = one_core(nxsdk)
    with pytest.raises(Exception, match=message):
        write(core)


def test_members_of_a_population_share_axon_cfgs(nxsdk):
    _, (core,) = one_core(nxsdk)
    for source, atom in [(0, 0), (1, 1), (2, 2)]:  # one pixel with three channels
        core.createPop32Axon(0, source, atom, dstChipId=1, dstCoreId=5, dstSynMapId=7)
    assert core.axon_cfgs() == 2
    nxsdk.faults.FAULTS.share_axon_cfgs = False
    assert core.axon_cfgs() == 6


def test_too_many_axon_cfgs_are_refused_at_the_connection(nxsdk):
    board, (core,) = one_core(nxsdk)
    for source in range(1024):
        for axon in range(2):
            core.createPop32Axon(source, source, 0, 1, 4, 2 * source + axon)
    assert core.axon_cfgs() == 4096
    board.start()
    board.disconnect()
    core.createPop32Axon(0, 0, 0, 1, 4, 4000)
    board.compiled = False
    with pytest.raises(Exception, match=r"Number of AxonCfg registers exceeded.* 4098"):
        board.start()


def test_too_much_synapse_memory_is_refused(nxsdk):
    board, (core,) = one_core(nxsdk, n_synapses=3 * 1024 * 128)
    row = [[1] * 1024]
    for axon in range(120):  # 1024 weights of 8 bits: 17 words for each 64 of 16 lists
        set_synapse(core, axon, 1024 * axon, row)
    with pytest.raises(Exception, match="Synapse memory exceeded"):
        board.start()


def test_axon_cfgs_not_shared_fail_only_at_the_board(nxsdk, monkeypatch):
    """What NengoLoihi lets pass and a board may not (NengoLoihi's issue 326)."""
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    with nengo.Network(seed=0) as net:
        nengo_loihi.add_params(net)
        shape = (16, 16, 4)
        lif = nengo_loihi.neurons.LoihiLIF()
        ones = np.ones(1024)
        pre = nengo.Ensemble(1024, 1, neuron_type=lif, gain=ones, bias=2 * ones)
        conv = nengo.Convolution(4, shape, kernel_size=(1, 1))
        post = nengo.Ensemble(1024, 1, neuron_type=lif, gain=ones, bias=0 * ones)
        for _ in range(3):
            nengo.Connection(pre.neurons, post.neurons, transform=conv)
    with nengo_loihi.Simulator(net, target="loihi", precompute=True) as sim:
        sim.run_steps(2)
    nxsdk.faults.FAULTS.share_axon_cfgs = False
    with (
        pytest.raises(SimulationError, match="Number of AxonCfg registers exceeded"),
        nengo_loihi.Simulator(net, target="loihi", precompute=True),
    ):
        pass
