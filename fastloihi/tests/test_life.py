"""An emulator that is closed, copied or changed by other code, and the random numbers it shares."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from comparison import NUMPY_1, Outcome, assert_same, state_of
from nengo_loihi.emulator.interface import EmulatorInterface
from parts import (
    change_nothing,
    combine,
    enable_noise,
    make_emulator,
    start_learning,
    stay_floating,
    with_axons,
)

from fastloihi import FastEmulator, NotAccelerated, compiled, emulator

LEARNS_IN_FLOATING_POINT = combine(stay_floating, start_learning)
CHANGES = {
    "as it is": change_nothing,
    "floating": stay_floating,
    "learns": start_learning,
    "learns in floating point": LEARNS_IN_FLOATING_POINT,
    "noisy": lambda parts: setattr(parts, "finish", lambda: enable_noise(parts)),
}
if NUMPY_1:
    del CHANGES["learns in floating point"]
each_change = pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)


def run_both(change=change_nothing, steps=4):
    """NengoLoihi's emulator and the fast one after some steps."""
    chips = [make_emulator(kind, change)[0] for kind in (EmulatorInterface, FastEmulator)]
    for chip in chips:
        for errors in chip.synapses.pes_errors.values():
            errors[:] = 50
        Outcome.of(lambda chip=chip: chip.run_steps(steps))
    return chips


def words_of(rng):
    return [*rng.get_state()[1], rng.get_state()[2]]


@each_change
def test_a_closed_emulator_fails_as_nengo_loihis_and_keeps_what_can_be_read(change):
    plain, fast = run_both(change)
    for chip in (plain, fast):
        chip.close()
    expected = Outcome.of(plain.step)
    assert expected.error is not None
    assert expected == Outcome.of(fast.step)
    assert words_of(plain.rng) == words_of(fast.rng)
    for probe, fast_probe in zip(plain.probes.probes, fast.probes.probes):
        assert np.array_equal(
            plain.collect_probe_output(probe), fast.collect_probe_output(fast_probe)
        )


@each_change
def test_an_emulator_that_is_handed_over_has_drawn_its_random_numbers(change):
    plain, fast = run_both(change)
    _hand_over(fast)
    assert words_of(plain.rng) == words_of(fast.rng)


def _hand_over(fast):
    with pytest.warns(NotAccelerated):
        emulator.hand_over(fast, "a test")


def test_arrays_can_be_written_to_again_after_the_emulator_is_closed_or_handed_over():
    def fixed(parts):
        parts.finish = lambda: parts.synapse.weights[0].setflags(write=False)

    for end in (FastEmulator.close, _hand_over):
        fast = run_both(fixed)[1]
        (synapse,) = fast.synapses.slices
        assert [w.flags.writeable for w in synapse.weights[:2]] == [False, False]
        end(fast)
        assert [w.flags.writeable for w in synapse.weights[:2]] == [False, True]


@each_change
def test_a_copy_goes_on_and_so_does_the_original(change):
    states = []
    for chip in run_both(change):
        other = copy.deepcopy(chip)
        assert type(other) is type(chip)
        outcome = Outcome.of(lambda other=other: other.run_steps(5))
        assert outcome == Outcome.of(lambda chip=chip: chip.run_steps(5))
        assert_same(state_of(chip), state_of(other))
        Outcome.of(other.step)
        states.append((outcome, state_of(chip), state_of(other)))
    assert states[0][0] == states[1][0]
    for expected, actual in zip(states[0][1:], states[1][1:]):
        assert_same(expected, actual)


@each_change
def test_a_generator_is_up_to_date_after_each_call_and_can_be_replaced(change):
    drawn = []
    for chip in run_both(change):
        rng, numbers = chip.rng, []
        for _ in range(3):
            Outcome.of(lambda chip=chip: chip.run_steps(2))
            numbers.append(rng.randint(1000))
        other = chip.rng = np.random.RandomState(5)
        Outcome.of(lambda chip=chip: chip.run_steps(3))
        numbers += other.randint(1000, size=3).tolist()
        Outcome.of(chip.step)
        drawn.append((numbers, words_of(other)))
    assert drawn[0] == drawn[1]


def test_a_generator_of_another_kind_is_left_to_nengo_loihi():
    plain, fast = run_both()
    plain.rng = np.random.RandomState(np.random.PCG64(1))
    with pytest.warns(NotAccelerated):
        fast.rng = np.random.RandomState(np.random.PCG64(1))
    assert type(fast) is EmulatorInterface
    for chip in (plain, fast):
        chip.run_steps(5)
    assert plain.rng.randint(1000) == fast.rng.randint(1000)


def new_rate(chip):
    for synapse in chip.synapses.traces:
        synapse._lr_int = synapse.learning_rate = 0


def new_weights(chip):
    for synapse in chip.synapses.traces:
        synapse.weights[:] = [np.zeros_like(w) for w in synapse.weights]


def new_traces(chip):
    for synapse, trace in chip.synapses.traces.items():
        chip.synapses.traces[synapse] = trace * 0 + 7


def new_errors(chip):
    for synapse, errors in chip.synapses.pes_errors.items():
        chip.synapses.pes_errors[synapse] = errors * 0 + 7


@pytest.mark.parametrize("change", [start_learning, *[LEARNS_IN_FLOATING_POINT] * (not NUMPY_1)])
@pytest.mark.parametrize("act", [new_rate, new_weights, new_traces, new_errors])
def test_a_learning_rule_that_was_replaced_is_left_to_nengo_loihi(act, change):
    plain, fast = run_both(change)
    states = []
    for chip in (plain, fast):
        act(chip)
        caught = Outcome.of(lambda chip=chip: chip.run_steps(6)).warnings
        states.append(state_of(chip))
    assert [w[1] for w in caught].count(NotAccelerated) == 1
    assert_same(*states)
    assert type(fast) is EmulatorInterface
    emulator.take_over(fast)
    assert type(fast) is FastEmulator


@pytest.mark.parametrize("name", [*emulator.FIXED, "noise"])
def test_arrays_that_are_compiled_in_cannot_be_replaced_or_written_to(name):
    state = run_both()[1].compartment
    with pytest.raises(ValueError, match=name):
        setattr(state, name, copy.copy(getattr(state, name)))
    if name != "noise":
        with pytest.raises(ValueError, match="read-only"):
            getattr(state, name)[0] = 0


def test_indices_and_maps_are_read_only():
    fast = run_both(with_axons(np.arange(6)))[1]
    (synapse,), (axon,) = fast.synapses.slices, fast.inputs[0].axons
    assert not any(a.flags.writeable for a in (synapse.indices[0], axon.compartment_map))


def test_functions_of_an_archive_are_compiled_although_nothing_is_cached():
    """As in a bundle's ``deploy.pyz``."""
    archived, names = "bundle/deploy.pyz/fastloihi/compiled.py", {}
    exec(compile("def twice(value):\n    return 2 * value\n", archived, "exec"), names)
    twice = compiled._jit(from_python=True)(names["twice"])
    assert twice(3) == 6
    assert len(twice.signatures) == 1
