"""NengoLoihi's steps do what the compiled ones cannot, errors included, after one warning."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Callable, NamedTuple

import numpy as np
import pytest
import scipy.sparse
from comparison import NUMPY_1, Outcome, assert_same, state_of
from nengo_loihi.emulator.interface import EmulatorInterface
from parts import (
    Doubled,
    N,
    Shifted,
    Twice,
    after_discretising,
    change_nothing,
    combine,
    make_both,
    make_emulator,
    odd_block_that_learns,
    one_weight,
    start_learning,
    stay_floating,
    weights_of_other_shapes,
    with_attributes,
    with_axons,
    with_each,
    with_learning,
    with_noise,
    with_probe,
)

from fastloihi import FastEmulator, NotAccelerated, emulator

ONE_TO_ONE = np.arange(N)
AT_ONCE = {
    "axon beyond its synapse": with_axons(np.array([0, 1, 2, 3, 4, 9])),
    "weights beyond the list": with_attributes(
        "synapse", axon_to_weight_map={i: i for i in range(N - 1)}
    ),
    "atom that is not there": with_axons(ONE_TO_ONE, np.array([0, 1, 0, 0, 0, 0])),
    "compartment that is not there": after_discretising(lambda p: p.synapse.indices[5].__iadd__(1)),
    "sparse weights that learn": combine(
        lambda p: p.synapse.set_weights(scipy.sparse.csr_matrix(np.eye(N))), start_learning
    ),
    "odd block that learns": odd_block_that_learns,
    "shifts beyond 32 bits": combine(
        start_learning, after_discretising(lambda p: p.synapse.format(weight_exp=-20))
    ),
    "weights of 64 bits": with_each("weights", np.int64),
    "lowest voltage of 32 bits": after_discretising(
        combine(
            with_attributes("compartment", vmin=-(2**31)),
            lambda p: p.compartment.bias.fill(-(2**23)),
        )
    ),
    "decay beyond 12 bits": after_discretising(lambda p: p.compartment.decay_v.__iadd__(4096)),
    "learning rate beyond 32 bits": with_learning(_lr_int=2**31),
    # It has no weights, and so only the trace would notice.
    "trace of an axon that is not there": combine(
        with_attributes("synapse", axon_compartment_bases=[0] * N + [-1]),
        start_learning,
        with_axons(np.array([0, 1, 2, 3, 4, N])),
    ),
    "one weight for several compartments": after_discretising(one_weight),
    "axon of another class": with_attributes("axon", __class__=Twice),
    "synapse of another class": with_attributes("synapse", __class__=Shifted),
    "noise beyond 32 bits": with_noise(noise_exp=23, noise_offset=3000),
    "probe of something else": with_probe(key="spike_count"),
    "probe of one number": with_probe(key="voltage", slice=[2]),
    "input of another class": with_attributes("input", __class__=Doubled),
    "map that is a list": with_axons(list(range(N))),
    "indices of 8 bits": with_each("indices", np.uint8),  # to which a base is added in 8 bits
    "weights of other shapes than their indices": after_discretising(weights_of_other_shapes),
    "trace of no time": with_learning(tracing_tau=0),
    "learning rate of 64 bits": with_learning(_lr_int=np.int64(2**28)),
    "learning in floating point with a rate for each weight": combine(
        stay_floating, with_learning(learning_rate=np.ones(N, np.float32))
    ),
    "probe of a compartment that is not there": with_probe(key="voltage", slice=[[2, N]]),
}
ODD_SPIKES = {
    "as booleans": np.array([True, False, True, False, False, False]),
    "as a number": 2,
    "as nothing": None,
    "as a tuple": (1, 2),
    "as a range": range(3),
    "in floating point": np.array([]),
}


def spikes_at_7(spikes):
    return after_discretising(lambda parts: parts.input.add_spikes(7, spikes))


IN_A_STEP = {
    "spike of a neuron that is not there": lambda p: p.spikes[3].extend([2, N]),
    "negative number of a neuron": combine(
        with_axons(ONE_TO_ONE), lambda p: p.spikes[3].append(-1)
    ),
    "spikes in two dimensions": spikes_at_7(np.array([[0, 1], [2, 3]])),
    **{
        f"spikes {how}": combine(with_axons(ONE_TO_ONE), spikes_at_7(spikes))
        for how, spikes in ODD_SPIKES.items()
    },
}


CALLS = [[1] * 10, [10], [4, 6]]


@pytest.mark.parametrize(
    ("name", "calls"), [*((name, [4, 6]) for name in AT_ONCE), *itertools.product(IN_A_STEP, CALLS)]
)
def test_the_answer_is_nengo_loihis(name, calls):
    change = {**AT_ONCE, **IN_A_STEP}[name]
    plain, _ = make_emulator(EmulatorInterface, change)
    fast, n_warnings = make_emulator(FastEmulator, change)
    assert n_warnings == (name in AT_ONCE)
    for steps in calls:
        expected = Outcome.of(lambda n=steps: plain.run_steps(n))
        actual = Outcome.of(lambda n=steps: fast.run_steps(n))
        n_warnings += sum(
            issubclass(category, NotAccelerated) for _, category, _ in actual.warnings
        )
        others = [w for w in actual.warnings if not issubclass(w[1], NotAccelerated)]
        assert expected == actual._replace(warnings=others)
        assert_same(state_of(plain), state_of(fast))
        if expected.error is not None:
            break
    assert type(fast) is EmulatorInterface
    assert n_warnings == 1


def sends(*spikes):
    """Other input spikes, each list in a step of its own."""
    return lambda parts: setattr(parts, "spikes", spikes)


def sum_beyond_16_bits(sign):
    """32 times 1024, in a block whose weights have no power of two in common."""

    def finish(parts):
        for weights in parts.synapse.weights:
            weights[:] = 1
        parts.synapse.weights[0][:] = sign * 1024

    return combine(after_discretising(finish), sends([0] * 32, [0] * 33, [1]))


class Case(NamedTuple):
    """Changes of a model before and after its emulator is made, the calls, and their outcome."""

    calls: list
    change: Callable = change_nothing
    begin: Callable = change_nothing
    leads_to: Callable = lambda chip: True


TAKEN = {
    "lists with spikes and without": Case(
        [12],
        combine(
            with_axons(ONE_TO_ONE),
            after_discretising(
                lambda p: [p.input.add_spikes(t, [1, 2] * (t % 2)) for t in (7, 8, 9)]
            ),
        ),
    ),
    "more spikes than a sum of 16 bits holds": Case(
        [1] * 6,
        combine(
            # Small, or what 16 bits lose would be no bits of the accumulator; each as large as any.
            lambda p: p.synapse.set_weights(np.ones((N, N))),
            with_each("weights", lambda weights: weights >> 7),
            sends([0] * 5000 + [3] * 900, [1, 2] * 3000, [5] * 259, [4] * 20000),
        ),
    ),
    "a sum of one more than 16 bits hold": Case([1] * 4, sum_beyond_16_bits(1)),
    "a sum of one more than 16 bits hold, below 0": Case([1] * 4, sum_beyond_16_bits(-1)),
    "a compartment without a refractory period that is held all the same": Case(
        [5],
        lambda p: p.compartment.configure_relu(tau_ref=0),
        lambda chip: chip.compartment.ref_count.put([0, 2, 4], 3),
    ),
    "a voltage that is no number": Case(
        [3],
        stay_floating,
        lambda chip: chip.compartment.voltage.put(1, np.nan),
        lambda chip: np.isnan(chip.compartment.voltage[1]),
    ),
    "a trace of 127": Case(
        [1] * 6,
        combine(
            lambda p: p.synapse.set_learning(),
            after_discretising(with_attributes("synapse", tracing_mag=127)),
            sends([0, 1], [], [], [2, 3]),
        ),
        leads_to=lambda chip: 127 in np.concatenate([*chip.synapses.traces.values()]),
    ),
    "spikes for the step before the first, which never arrive": Case(
        [3], begin=lambda chip: chip.inputs[0].spikes.update({0: np.array([1, 2])})
    ),
    "weights that learn and are mapped": Case(
        [12],
        combine(
            start_learning,
            with_attributes("synapse", axon_to_weight_map={i: (i + 1) % N for i in range(N)}),
        ),
        lambda chip: [errors.fill(50) for errors in chip.synapses.pes_errors.values()],
    ),
}


@pytest.mark.parametrize("name", TAKEN)
def test_the_compiled_code_gives_nengo_loihis_answer(name):
    case = TAKEN[name]
    plain, fast = make_both(case.change)
    for chip in (plain, fast):
        case.begin(chip)
    for steps in case.calls:
        expected, actual = (
            Outcome.of(chip.step if steps == 1 else partial(chip.run_steps, steps))
            for chip in (plain, fast)
        )
        assert expected == actual
        assert expected.error is None
        assert_same(state_of(plain), state_of(fast))
    assert case.leads_to(fast)
    assert type(fast) is FastEmulator


def test_weights_that_reached_their_limit_before_are_not_clipped_again():
    """Those of one axon go on to grow; one warning is given, although all are at the limit."""

    strong = combine(
        lambda p: p.synapse.set_learning(),
        after_discretising(with_attributes("synapse", tracing_mag=50, _lr_int=7, _lr_exp=4)),
        sends(*[range(N)] * 12, *[[0]] * 28),
    )
    plain, fast = make_both(strong)
    for chip in (plain, fast):
        for errors in chip.synapses.pes_errors.values():
            errors[:] = 100
    for _ in range(40):
        expected = Outcome.of(plain.step)
        assert expected == Outcome.of(fast.step)
        assert_same(state_of(plain), state_of(fast))
    assert [message for message, *_ in expected.warnings].count("Clipping learning weights") == 1
    (synapse,) = fast.synapses.traces
    assert len(np.unique(np.abs(synapse.weights))) == 1


@pytest.mark.parametrize("tau_ref", [0, 0.001])
def test_a_voltage_at_the_threshold_does_not_fire(tau_ref):
    def high(parts):
        parts.block.compartment.configure_lif(tau_ref=tau_ref)
        parts.finish = lambda: parts.block.compartment.vth.fill(2**23 - 1)

    (scout, _), (plain, fast) = make_both(high), make_both(high)
    scout.run_steps(5)
    reached = scout.compartment.voltage.copy()
    assert reached.all()
    for chip in (plain, fast):
        chip.run_steps(4)
        chip.compartment.vth[:] = reached
        chip.step()
    assert_same(state_of(plain), state_of(fast))
    assert np.array_equal(fast.compartment.voltage, reached)
    assert type(fast) is FastEmulator


@pytest.mark.parametrize("name", ["compartment", "synapses", "probes"])
def test_a_state_of_a_class_of_somebody_elses_is_left_as_it_is(name):
    plain, _ = make_emulator(EmulatorInterface, change_nothing)
    part = getattr(plain, name)
    part.__class__ = type("Own", (type(part),), {})
    with pytest.warns(NotAccelerated):
        emulator.take_over(plain)
    assert type(plain) is EmulatorInterface


def test_floating_point_that_learns_is_left_to_nengo_loihi_on_numpy_1(monkeypatch):
    change = combine(stay_floating, start_learning)
    assert NUMPY_1 or type(make_emulator(FastEmulator, change)[0]) is FastEmulator
    monkeypatch.setattr(np, "__version__", "1.26.4")
    chip, n_warnings = make_emulator(FastEmulator, change)
    assert (type(chip), n_warnings) == (EmulatorInterface, 1)


@pytest.mark.parametrize("name", ["voltage", "current"])
def test_a_value_without_a_positive_counterpart_is_left_to_nengo_loihi(name):
    plain, fast = make_both()
    for chip in (plain, fast):
        getattr(chip.compartment, name)[1] = -(2**31)
    plain.run_steps(5)
    with pytest.warns(NotAccelerated):
        fast.run_steps(5)
    assert_same(state_of(plain), state_of(fast))
