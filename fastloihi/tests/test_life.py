"""An emulator that is closed, copied or changed by other code, and the random numbers it shares."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

pytest.importorskip("numba")
from deploy.network.loihi_import import nengo_loihi  # noqa: F401, I001  (the substitutions first)
from fastloihi import FastEmulator, NotAccelerated, emulator
from nengo_loihi.emulator.interface import EmulatorInterface

from comparison import Outcome, assert_same, state_of
from test_hand_over import made


def as_it_is(parts):
    pass


def floating(parts):
    parts.discretized = False


def learns(parts):
    parts.synapse.set_learning(tracing_mag=20.0)


def learns_in_floating_point(parts):
    floating(parts)
    learns(parts)


def is_noisy(parts):
    parts.finish = lambda: parts.block.compartment.enable_noise.fill(True)


CHANGES = [as_it_is, floating, learns, learns_in_floating_point, is_noisy]


@pytest.fixture(autouse=True)
def permissive(monkeypatch):
    monkeypatch.setattr(EmulatorInterface, "strict", False)
    monkeypatch.setattr(emulator, "_said", set())


def both(change=as_it_is, steps=4):
    """NengoLoihi's emulator and the fast one after some steps."""
    chips = [made(kind, change)[0] for kind in (EmulatorInterface, FastEmulator)]
    for chip in chips:
        for errors in chip.synapses.pes_errors.values():
            errors[:] = 50
        Outcome.of(lambda chip=chip: chip.run_steps(steps))
    return chips


def words_of(rng):
    return [*rng.get_state()[1], rng.get_state()[2]]


@pytest.mark.parametrize("call", [lambda chip: chip.step(), lambda chip: chip.run_steps(2)])
def test_a_closed_emulator_fails_as_nengo_loihis(call):
    plain, fast = both()
    for chip in (plain, fast):
        chip.close()
    expected = Outcome.of(lambda: call(plain))
    assert expected.error is not None
    assert expected == Outcome.of(lambda: call(fast))
    assert plain.t == fast.t


@pytest.mark.parametrize("change", CHANGES)
def test_a_closed_emulator_has_its_random_state_and_its_probed_values(change):
    plain, fast = both(change)
    for chip in (plain, fast):
        chip.close()
    assert words_of(plain.rng) == words_of(fast.rng)
    for mine, its in zip(plain.probes.probes, fast.probes.probes, strict=True):
        assert np.array_equal(plain.collect_probe_output(mine), fast.collect_probe_output(its))


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_handed_over_has_drawn_its_random_numbers(change):
    plain, fast = both(change)
    emulator.hand_over(fast, "a test")
    assert words_of(plain.rng) == words_of(fast.rng)


def test_the_arrays_of_a_model_can_be_changed_after_its_emulator_is_closed():
    fast = both()[1]
    (synapse,) = fast.synapses.slices
    assert not synapse.weights[0].flags.writeable
    fast.close()
    assert synapse.weights[0].flags.writeable


def test_arrays_that_were_read_only_before_stay_so():
    def fixed(parts):
        parts.finish = lambda: parts.synapse.weights[0].setflags(write=False)

    fast = both(fixed)[1]
    (synapse,) = fast.synapses.slices
    emulator.hand_over(fast, "a test")
    assert [w.flags.writeable for w in synapse.weights[:2]] == [False, True]


@pytest.mark.parametrize("steps", ["2", 2.0, None])
def test_a_number_of_steps_that_is_none_is_refused_as_ever(steps):
    plain, fast = both()
    assert Outcome.of(lambda: plain.run_steps(steps)) == Outcome.of(lambda: fast.run_steps(steps))


@pytest.mark.parametrize("change", CHANGES)
def test_a_copy_goes_on_and_so_does_the_original(change):
    states = []
    for chip in both(change):
        other = copy.deepcopy(chip)
        assert type(other) is type(chip)
        said = Outcome.of(lambda other=other: other.run_steps(5))
        assert said == Outcome.of(lambda chip=chip: chip.run_steps(5))
        assert_same(state_of(chip), state_of(other))
        Outcome.of(other.step)
        states.append((said, state_of(chip), state_of(other)))
    assert states[0][0] == states[1][0]
    for expected, found in zip(states[0][1:], states[1][1:], strict=True):
        assert_same(expected, found)


def test_it_can_be_pickled_as_little_as_nengo_loihis():
    plain, fast = both()
    expected = Outcome.of(lambda: pickle.dumps(plain)).error
    assert type(expected) is type(Outcome.of(lambda: pickle.dumps(fast)).error)
    assert expected is not None


@pytest.mark.parametrize("change", CHANGES)
def test_a_generator_that_was_read_before_is_up_to_date_after_each_call(change):
    drawn = []
    for chip in both(change):
        rng, numbers = chip.rng, []
        for _ in range(3):
            Outcome.of(lambda chip=chip: chip.run_steps(2))
            numbers.append(rng.randint(1000))
        drawn.append((numbers, words_of(chip.rng)))
    assert drawn[0] == drawn[1]


@pytest.mark.parametrize("change", CHANGES)
def test_a_new_generator_is_used_from_then_on(change):
    drawn = []
    for chip in both(change):
        rng = chip.rng = np.random.RandomState(5)
        Outcome.of(lambda chip=chip: chip.run_steps(3))
        numbers = rng.randint(1000, size=3).tolist()
        Outcome.of(chip.step)
        drawn.append((numbers, words_of(rng)))
    assert drawn[0] == drawn[1]


def test_a_generator_that_has_its_state_elsewhere_is_left_to_nengo_loihi():
    class Elsewhere(np.random.RandomState):
        def get_state(self, *args, **kwargs):
            name, words, *rest = super().get_state(*args, **kwargs)
            return (name, words + np.uint32(1), *rest)

    fast = both()[1]
    with pytest.warns(NotAccelerated):
        fast.rng = Elsewhere(1)
    assert type(fast) is EmulatorInterface


def new_rate(chip):
    for synapse in chip.synapses.traces:
        synapse._lr_int = synapse.learning_rate = 0


def new_epoch(chip):
    for synapse in chip.synapses.traces:
        synapse.learn_epoch = 1


def new_weights(chip):
    for synapse in chip.synapses.traces:
        synapse.weights[:] = [np.zeros_like(w) for w in synapse.weights]


def new_traces(chip):
    for synapse, trace in chip.synapses.traces.items():
        chip.synapses.traces[synapse] = trace * 0 + 7


def new_errors(chip):
    for synapse, errors in chip.synapses.pes_errors.items():
        chip.synapses.pes_errors[synapse] = errors * 0 + 7


@pytest.mark.parametrize("change", [learns, learns_in_floating_point])
@pytest.mark.parametrize("act", [new_rate, new_epoch, new_weights, new_traces, new_errors])
def test_a_learning_rule_that_was_replaced_is_left_to_nengo_loihi(act, change):
    plain, fast = both(change)
    states = []
    for chip in (plain, fast):
        act(chip)
        said = Outcome.of(lambda chip=chip: chip.run_steps(6)).warnings
        states.append(state_of(chip))
    assert [w[1] for w in said].count(NotAccelerated) == 1
    assert_same(*states)
    assert type(fast) is EmulatorInterface
    emulator.take_over(fast)
    assert type(fast) is FastEmulator


def test_two_emulators_of_one_model_share_what_it_learns():
    states = []
    for kind in (EmulatorInterface, FastEmulator):
        models = []

        def keeps(parts, models=models):
            learns(parts)
            models.append(parts.model)

        first, _ = made(kind, keeps)
        second = kind(models[0], seed=2)
        for chip in (first, second, first):
            for errors in chip.synapses.pes_errors.values():
                errors[:] = 50
            Outcome.of(lambda chip=chip: chip.run_steps(5))
        states.append((state_of(first), state_of(second)))
    for expected, found in zip(*states, strict=True):
        assert_same(expected, found)


@pytest.mark.parametrize("name", [*emulator.FIXED, "noise"])
def test_what_is_compiled_in_cannot_be_replaced(name):
    state = both()[1].compartment
    with pytest.raises(ValueError, match=name):
        setattr(state, name, copy.copy(getattr(state, name)))


@pytest.mark.parametrize("name", emulator.FIXED)
def test_what_is_compiled_in_cannot_be_written_to(name):
    values = getattr(both()[1].compartment, name)
    with pytest.raises(ValueError, match="read-only"):
        values[0] = 0


@pytest.mark.parametrize("name", emulator.FIXED_NOISE)
def test_noise_that_is_compiled_in_cannot_be_changed(name):
    noise = both()[1].compartment.noise
    with pytest.raises(ValueError, match=name):
        setattr(noise, name, getattr(noise, name).copy())
    with pytest.raises(ValueError, match="read-only"):
        getattr(noise, name)[0] = 0


def test_noise_of_another_class_is_left_to_nengo_loihi():
    plain = both()[0]
    noise = plain.compartment.noise
    noise.__class__ = type("Own", (type(noise),), {})
    with pytest.warns(NotAccelerated):
        emulator.take_over(plain)
    assert type(plain) is EmulatorInterface


def test_indices_and_maps_are_read_only():
    def mapped(parts):
        parts.axon.set_compartment_axon_map(np.arange(parts.axon.n_axons))

    fast = both(mapped)[1]
    (synapse,), (axon,) = fast.synapses.slices, fast.inputs[0].axons
    assert not any(a.flags.writeable for a in (synapse.indices[0], axon.compartment_map))
