"""What the kernel does not do is left to NengoLoihi's own steps, errors included, and said once."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pytest
import scipy.sparse

pytest.importorskip("numba")
from deploy.network.loihi_import import nengo_loihi  # noqa: F401, I001  (the substitutions first)
from deploy.fastloihi import FastEmulator, NotAccelerated, emulator
from nengo_loihi.block import Axon, LoihiBlock, Synapse
from nengo_loihi.builder import Model
from nengo_loihi.builder.discretize import discretize_model
from nengo_loihi.emulator.interface import EmulatorInterface
from nengo_loihi.inputs import SpikeInput
from nengo_loihi.probe import LoihiProbe

from tests.deploy.fastloihi.comparison import Outcome, assert_same, state_of

N = 6


class Parts:
    """An input of as many neurons as a block, a synapse between them, and a probe."""

    def __init__(self):
        rng = np.random.RandomState(0)
        self.model, self.block, self.input = Model(), LoihiBlock(N), SpikeInput(N)
        self.block.compartment.configure_lif(tau_ref=0.001)
        self.synapse, self.axon = Synapse(N), Axon(N)
        self.synapse.set_weights(rng.uniform(0.5, 2, size=(N, N)))
        self.axon.target = self.synapse
        self.block.add_synapse(self.synapse)
        self.input.add_axon(self.axon)
        self.probe = LoihiProbe(target=[self.block], key="voltage")
        self.discretized, self.spikes = True, [[0, 1], [2, 5], [5], [], [1, 3, 4], [0]]

    def emulator(self, kind):
        self.model.add_block(self.block)
        self.model.add_input(self.input)
        self.model.add_probe(self.probe)
        if self.discretized:
            discretize_model(self.model)
        self.finish()
        for t, spikes in enumerate(self.spikes):
            self.input.add_spikes(t + 1, np.array(spikes, int))
        return kind(self.model, seed=1)

    def finish(self):
        """What is changed after discretising."""


def axon_beyond_its_synapse(parts):
    parts.axon.set_compartment_axon_map(np.array([0, 1, 2, 3, 4, 9]))


def weights_beyond_the_list(parts):
    parts.synapse.axon_to_weight_map = {i: i for i in range(N - 1)}


def negative_number_of_weights(parts):
    parts.synapse.axon_to_weight_map = {i: i - 1 for i in range(N)}


def atom_that_is_not_there(parts):
    parts.axon.set_compartment_axon_map(np.arange(N), atoms=np.array([0, 1, 0, 0, 0, 0]))


def map_that_is_too_short(parts):
    parts.axon.set_compartment_axon_map(np.arange(3))


def compartment_that_is_not_there(parts):
    parts.finish = lambda: parts.synapse.indices[5].__iadd__(1)


def base_beyond_the_block(parts):
    parts.synapse.axon_compartment_bases = [0, 0, 1, 0, 0, 0]


def sparse_weights_that_learn(parts):
    parts.synapse.set_weights(scipy.sparse.csr_matrix(np.eye(N)))
    parts.synapse.set_learning(tracing_mag=20.0)


def odd_block_that_learns(parts):
    parts.block = LoihiBlock(N + 1)
    parts.block.compartment.configure_lif()
    parts.synapse.set_weights(np.ones((N, N + 1)))
    parts.block.add_synapse(parts.synapse)
    parts.probe = LoihiProbe(target=[parts.block], key="voltage")
    parts.synapse.set_learning(tracing_mag=20.0)


def shifts_beyond_32_bits(parts):
    parts.synapse.set_learning(tracing_mag=20.0)
    parts.finish = lambda: parts.synapse.format(weight_exp=-20)


def weights_of_64_bits(parts):
    def finish():
        parts.synapse.weights[:] = [w.astype(np.int64) for w in parts.synapse.weights]

    parts.finish = finish


def weights_of_double_precision(parts):
    def finish():
        parts.synapse.weights[:] = [w.astype(np.float64) for w in parts.synapse.weights]

    parts.finish, parts.discretized = finish, False


def lowest_voltage_of_32_bits(parts):
    def finish():
        parts.block.compartment.vmin = -(2**31)
        parts.block.compartment.bias[:] = -(2**23)

    parts.finish = finish


def decay_beyond_12_bits(parts):
    parts.finish = lambda: parts.block.compartment.decay_v.__iadd__(4096)


def negative_decay(parts):
    parts.finish = lambda: parts.block.compartment.decay_v.__imul__(-1)


def learning_rate_beyond_32_bits(parts):
    parts.synapse.set_learning(tracing_mag=20.0)
    parts.finish = lambda: setattr(parts.synapse, "_lr_int", 2**31)


def trace_beyond_32_bits(parts):
    parts.synapse.set_learning(tracing_mag=20.0)
    parts.finish = lambda: setattr(parts.synapse, "tracing_mag", 2**30)


def trace_of_an_axon_that_is_not_there(parts):
    """It has no weights, and so only the trace would notice."""
    parts.synapse.axon_compartment_bases = [0] * N + [-1]
    parts.synapse.set_learning(tracing_mag=20.0)
    parts.axon.set_compartment_axon_map(np.array([0, 1, 2, 3, 4, N]))


def row_of_weights_that_is_missing(parts):
    parts.synapse.set_learning(tracing_mag=20.0)
    parts.finish = lambda: setattr(parts.synapse, "n_axons", N + 1)


def bases_that_are_too_few(parts):
    parts.synapse.axon_compartment_bases = [0] * (N - 1)


def one_weight_for_several_compartments(parts):
    def finish():
        parts.synapse.weights[5] = parts.synapse.weights[5][:, :1]

    parts.finish = finish


def axon_of_another_class(parts):
    class Twice(Axon):
        def map_spikes(self, spikes):
            return 2 * super().map_spikes(spikes)

    parts.axon.__class__ = Twice


def synapse_of_another_class(parts):
    class Shifted(Synapse):
        def axon_weights_indices(self, axon, atom=0):
            weights, indices = super().axon_weights_indices(axon, atom)
            return weights, indices[::-1]

    parts.synapse.__class__ = Shifted


def negative_compartment(parts):
    parts.finish = lambda: parts.synapse.indices[5].__isub__(1)


def negative_atom(parts):
    parts.axon.set_compartment_axon_map(np.arange(N), atoms=np.array([0, 0, 0, 0, 0, -1]))


def noise_beyond_32_bits(parts):
    def finish():
        parts.block.compartment.enable_noise[:] = True
        parts.block.compartment.noise_exp, parts.block.compartment.noise_offset = 23, 3000

    parts.finish = finish


def probe_of_something_else(parts):
    parts.probe = LoihiProbe(target=[parts.block], key="spike_count")


def probe_of_nothing(parts):
    parts.probe = LoihiProbe(target=[parts.block], key="refractory_time")


def probe_of_one_number(parts):
    parts.probe = LoihiProbe(target=[parts.block], key="voltage", slice=[2])


def input_of_another_class(parts):
    class Doubled(SpikeInput):
        def spike_idxs(self, ti):
            return np.repeat(super().spike_idxs(ti), 2)

    parts.input.__class__ = Doubled


def map_that_is_a_list(parts):
    parts.axon.set_compartment_axon_map(list(range(N)))


def axon_without_a_target(parts):
    parts.axon.target = None


def bases_in_floating_point(parts):
    parts.synapse.axon_compartment_bases = [0.0] * N


def rows_in_floating_point(parts):
    parts.synapse.axon_to_weight_map = {i: float(i) for i in range(N)}


def indices_in_floating_point(parts):
    def finish():
        parts.synapse.indices[:] = [i.astype(float) for i in parts.synapse.indices]

    parts.finish = finish


def indices_of_8_bits(parts):
    """To which a base is added in 8 bits."""

    def finish():
        parts.synapse.indices[:] = [i.astype(np.uint8) for i in parts.synapse.indices]

    parts.finish = finish


def indices_that_are_missing(parts):
    parts.finish = lambda: parts.synapse.indices.pop()


def weights_of_other_shapes_than_their_indices(parts):
    """As many in all."""

    def finish():
        first, second = parts.synapse.weights[:2]
        parts.synapse.weights[:2] = [first[:, :-1], np.hstack([second, second[:, :1]])]

    parts.finish = finish


def rows_with_numbers_of_atoms_of_their_own(parts):
    """As many in all as if each had those of the first."""

    def finish():
        for arrays in (parts.synapse.weights, parts.synapse.indices):
            counts = (2, 1, 3, 2, 2, 2)
            arrays[:] = [np.vstack([a] * n) for a, n in zip(arrays, counts, strict=True)]

    parts.finish = finish


def learning_without_a_rate(parts):
    parts.synapse.set_learning(tracing_mag=20.0)
    parts.finish = lambda: delattr(parts.synapse, "_lr_int")


def weights_of_one_dimension(parts):
    def finish():
        parts.synapse.weights[:] = [w[0] for w in parts.synapse.weights]
        parts.synapse.indices[:] = [i[0] for i in parts.synapse.indices]

    parts.finish = finish


def noise_whose_sum_is_beyond_32_bits(parts):
    def finish():
        parts.block.compartment.enable_noise[:] = True
        parts.block.compartment.noise_exp, parts.block.compartment.noise_offset = -10, 2**25 - 1

    parts.finish = finish


def learning_with(**values):
    def change(parts):
        parts.synapse.set_learning(tracing_mag=20.0)
        parts.finish = lambda: vars(parts.synapse).update(values)

    change.__name__ = "learning_with_" + "_".join(f"{k}_{v!r}" for k, v in values.items())
    return change


def learning_in_floating_point_with_a_rate_for_each_weight(parts):
    parts.discretized = False
    learning_with(learning_rate=np.ones(N, np.float32))(parts)


def probe_of_a_compartment_that_is_not_there(parts):
    parts.probe = LoihiProbe(target=[parts.block], key="voltage", slice=[[2, N]])


def spike_of_a_neuron_that_is_not_there(parts):
    parts.spikes[3] = [2, N]


def negative_number_of_a_neuron(parts):
    parts.axon.set_compartment_axon_map(np.arange(N))
    parts.spikes[3] = [-1]


def spikes_in_two_dimensions(parts):
    parts.finish = lambda: parts.input.add_spikes(7, np.array([[0, 1], [2, 3]]))


def spikes_as_booleans(parts):
    def finish():
        parts.axon.set_compartment_axon_map(np.arange(N))
        parts.input.add_spikes(7, np.array([True, False, True, False, False, False]))

    parts.finish = finish


def spikes_that_are(spikes):
    def change(parts):
        parts.axon.set_compartment_axon_map(np.arange(N))
        parts.finish = lambda: parts.input.add_spikes(7, spikes)

    change.__name__ = f"spikes_that_are_{spikes!r}"
    return change


AT_ONCE = [
    axon_beyond_its_synapse,
    weights_beyond_the_list,
    negative_number_of_weights,
    atom_that_is_not_there,
    map_that_is_too_short,
    compartment_that_is_not_there,
    base_beyond_the_block,
    sparse_weights_that_learn,
    odd_block_that_learns,
    shifts_beyond_32_bits,
    weights_of_64_bits,
    weights_of_double_precision,
    lowest_voltage_of_32_bits,
    decay_beyond_12_bits,
    negative_decay,
    learning_rate_beyond_32_bits,
    trace_beyond_32_bits,
    trace_of_an_axon_that_is_not_there,
    row_of_weights_that_is_missing,
    bases_that_are_too_few,
    one_weight_for_several_compartments,
    axon_of_another_class,
    synapse_of_another_class,
    negative_compartment,
    negative_atom,
    noise_beyond_32_bits,
    probe_of_something_else,
    probe_of_nothing,
    probe_of_one_number,
    input_of_another_class,
    map_that_is_a_list,
    axon_without_a_target,
    bases_in_floating_point,
    rows_in_floating_point,
    indices_in_floating_point,
    indices_of_8_bits,
    indices_that_are_missing,
    weights_of_other_shapes_than_their_indices,
    rows_with_numbers_of_atoms_of_their_own,
    learning_without_a_rate,
    weights_of_one_dimension,
    noise_whose_sum_is_beyond_32_bits,
    learning_with(train_epoch=0),
    learning_with(learn_epoch=0),
    learning_with(learn_epoch=-4),
    learning_with(learn_epoch=2.5),
    learning_with(learn_epoch=2**70),
    learning_with(tracing_tau=0),
    learning_with(tracing_tau=-1),
    learning_with(_lr_int=1.5),
    learning_with(_lr_int=np.int64(2**28)),
    learning_with(_lr_exp=np.int64(3)),
    learning_in_floating_point_with_a_rate_for_each_weight,
    probe_of_a_compartment_that_is_not_there,
]
IN_A_STEP = [
    spike_of_a_neuron_that_is_not_there,
    negative_number_of_a_neuron,
    spikes_in_two_dimensions,
    spikes_as_booleans,
    spikes_that_are(2),
    spikes_that_are(None),
    spikes_that_are((1, 2)),
    spikes_that_are(range(3)),
    spikes_that_are(np.array([])),
]


def made(kind, change):
    parts = Parts()
    change(parts)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        made = parts.emulator(kind)
    return made, sum(issubclass(w.category, NotAccelerated) for w in said)


CALLS = [[1] * 10, [10], [4, 6]]


@pytest.mark.parametrize(
    ("change", "calls"),
    [*((change, [4, 6]) for change in AT_ONCE), *itertools.product(IN_A_STEP, CALLS)],
)
def test_the_answer_is_nengo_loihis(change, calls, monkeypatch):
    monkeypatch.setattr(EmulatorInterface, "strict", False)
    monkeypatch.setattr(emulator, "_said", set())
    plain, _ = made(EmulatorInterface, change)
    fast, said = made(FastEmulator, change)
    assert said == (change in AT_ONCE)
    for steps in calls:
        expected = Outcome.of(lambda n=steps: plain.run_steps(n))
        found = Outcome.of(lambda n=steps: fast.run_steps(n))
        said += sum(issubclass(category, NotAccelerated) for _, category, _ in found.warnings)
        rest = [w for w in found.warnings if not issubclass(w[1], NotAccelerated)]
        assert expected == found._replace(warnings=rest)
        assert_same(state_of(plain), state_of(fast))
        if expected.error is not None:
            break
    assert type(fast) is EmulatorInterface
    assert said == 1


def test_without_a_change_the_kernel_runs():
    fast, said = made(FastEmulator, lambda parts: None)
    fast.run_steps(10)
    assert type(fast) is FastEmulator
    assert said == 0


def test_a_list_may_have_spikes_or_none():
    def lists(parts):
        parts.axon.set_compartment_axon_map(np.arange(N))
        parts.finish = lambda: [parts.input.add_spikes(t, [1, 2] * (t % 2)) for t in (7, 8, 9)]

    plain, fast = (made(kind, lists)[0] for kind in (EmulatorInterface, FastEmulator))
    for chip in (plain, fast):
        chip.run_steps(12)
    assert_same(state_of(plain), state_of(fast))
    assert type(fast) is FastEmulator


def test_more_spikes_than_a_sum_of_16_bits_holds(monkeypatch):
    monkeypatch.setattr(EmulatorInterface, "strict", False)

    def many(parts):
        # Small, or what 16 bits lose would be no bits of the accumulator; each as large as any.
        parts.synapse.set_weights(np.ones((N, N)))
        parts.finish = lambda: [weights.__irshift__(7) for weights in parts.synapse.weights]
        parts.spikes = [[0] * 5000 + [3] * 900, [1, 2] * 3000, [5] * 259, [4] * 20000]

    plain, _ = made(EmulatorInterface, many)
    fast, _ = made(FastEmulator, many)
    for _ in range(6):
        assert Outcome.of(plain.step) == Outcome.of(fast.step)
        assert_same(state_of(plain), state_of(fast))
    assert type(fast) is FastEmulator


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sum_of_one_more_than_16_bits_hold(sign):
    """32 times 1024, in a block whose weights have no power of two in common."""

    def many(parts):
        def finish():
            for weights in parts.synapse.weights:
                weights[:] = 1
            parts.synapse.weights[0][:] = sign * 1024

        parts.finish, parts.spikes = finish, [[0] * 32, [0] * 33, [1]]

    plain, _ = made(EmulatorInterface, many)
    fast, _ = made(FastEmulator, many)
    for _ in range(4):
        for chip in (plain, fast):
            chip.step()
        assert_same(state_of(plain), state_of(fast))
    assert type(fast) is FastEmulator


def test_a_compartment_without_a_refractory_period_can_be_held_all_the_same():
    def relu(parts):
        parts.block.compartment.configure_relu(tau_ref=0)

    plain, fast = (made(kind, relu)[0] for kind in (EmulatorInterface, FastEmulator))
    for chip in (plain, fast):
        chip.compartment.ref_count[::2] = 3
        chip.run_steps(5)
    assert_same(state_of(plain), state_of(fast))


def test_what_is_no_number_stays_none():
    def floating(parts):
        parts.discretized = False

    plain, fast = (made(kind, floating)[0] for kind in (EmulatorInterface, FastEmulator))
    for chip in (plain, fast):
        chip.compartment.voltage[1] = np.nan
        chip.run_steps(3)
    assert np.isnan(fast.compartment.voltage[1])
    assert_same(state_of(plain), state_of(fast))


def test_a_trace_may_be_127():
    def learns(parts):
        parts.synapse.set_learning()
        parts.finish = lambda: setattr(parts.synapse, "tracing_mag", 127)
        parts.spikes = [[0, 1], [], [], [2, 3]]

    plain, fast = (made(kind, learns)[0] for kind in (EmulatorInterface, FastEmulator))
    for _ in range(6):
        assert Outcome.of(plain.step) == Outcome.of(fast.step)
        assert_same(state_of(plain), state_of(fast))
    assert 127 in np.concatenate([*fast.synapses.traces.values()])


def test_weights_that_reached_their_limit_before_are_not_clipped_again():
    """Those of one axon go on to grow; one warning is given, although all are at the limit."""

    def learns(parts):
        def finish():
            parts.synapse.tracing_mag, parts.synapse._lr_int, parts.synapse._lr_exp = 50, 7, 4

        parts.synapse.set_learning()
        parts.finish, parts.spikes = finish, [range(N)] * 12 + [[0]] * 28

    plain, fast = (made(kind, learns)[0] for kind in (EmulatorInterface, FastEmulator))
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


def test_spikes_for_the_step_before_the_first_never_arrive():
    plain, fast = (made(kind, lambda parts: None)[0] for kind in (EmulatorInterface, FastEmulator))
    for chip in (plain, fast):
        chip.inputs[0].spikes[0] = np.array([1, 2])
        chip.run_steps(3)
    assert_same(state_of(plain), state_of(fast))


@pytest.mark.parametrize("tau_ref", [0, 0.001])
def test_a_voltage_at_the_threshold_does_not_fire(tau_ref):
    def high(parts):
        parts.block.compartment.configure_lif(tau_ref=tau_ref)
        parts.finish = lambda: parts.block.compartment.vth.fill(2**23 - 1)

    scout, plain, fast = (
        made(kind, high)[0] for kind in (EmulatorInterface, EmulatorInterface, FastEmulator)
    )
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


def test_random_numbers_of_another_kind_are_left_to_nengo_loihi(monkeypatch):
    monkeypatch.setattr(emulator, "_said", set())
    plain, _ = made(EmulatorInterface, lambda parts: None)
    fast, _ = made(FastEmulator, lambda parts: None)
    plain.step()
    fast.step()
    plain.rng = np.random.RandomState(np.random.PCG64(1))
    with pytest.warns(NotAccelerated):
        fast.rng = np.random.RandomState(np.random.PCG64(1))
    assert type(fast) is EmulatorInterface
    for chip in (plain, fast):
        chip.run_steps(5)
    assert plain.rng.randint(1000) == fast.rng.randint(1000)


@pytest.mark.parametrize("name", ["compartment", "synapses", "probes"])
def test_a_state_of_a_class_of_somebody_elses_is_left_as_it_is(name, monkeypatch):
    monkeypatch.setattr(emulator, "_said", set())
    plain, _ = made(EmulatorInterface, lambda parts: None)
    part = getattr(plain, name)
    part.__class__ = type("Own", (type(part),), {})
    with pytest.warns(NotAccelerated):
        emulator.take_over(plain)
    assert type(plain) is EmulatorInterface


def test_weights_that_learn_may_be_mapped():
    def mapped(parts):
        parts.synapse.set_learning(tracing_mag=20.0)
        parts.synapse.axon_to_weight_map = {i: (i + 1) % N for i in range(N)}

    plain, _ = made(EmulatorInterface, mapped)
    fast, _ = made(FastEmulator, mapped)
    for chip in (plain, fast):
        for errors in chip.synapses.pes_errors.values():
            errors[:] = 50
        Outcome.of(lambda chip=chip: chip.run_steps(12))
    assert_same(state_of(plain), state_of(fast))
    assert type(fast) is FastEmulator


def test_what_is_handed_over_can_be_written_to():
    fast, _ = made(FastEmulator, lambda parts: None)
    arrays = [fast.compartment.vmin, next(iter(fast.synapses.slices)).weights[0]]
    assert not any(array.flags.writeable for array in arrays)
    emulator.hand_over(fast, "a test")
    assert all(array.flags.writeable for array in arrays)


def test_floating_point_that_learns_is_left_to_nengo_loihi_on_numpy_1(monkeypatch):
    def learns(parts):
        parts.discretized = False
        parts.synapse.set_learning(tracing_mag=20.0)

    assert type(made(FastEmulator, learns)[0]) is FastEmulator
    monkeypatch.setattr(emulator, "_said", set())
    monkeypatch.setattr(np, "__version__", "1.26.4")
    chip, said = made(FastEmulator, learns)
    assert (type(chip), said) == (EmulatorInterface, 1)


@pytest.mark.parametrize("name", ["voltage", "current"])
def test_a_value_without_a_positive_counterpart_is_left_to_nengo_loihi(name, monkeypatch):
    monkeypatch.setattr(emulator, "_said", set())
    plain, _ = made(EmulatorInterface, lambda parts: None)
    fast, _ = made(FastEmulator, lambda parts: None)
    for chip in (plain, fast):
        getattr(chip.compartment, name)[1] = -(2**31)
    plain.run_steps(5)
    with pytest.warns(NotAccelerated):
        fast.run_steps(5)
    assert_same(state_of(plain), state_of(fast))
