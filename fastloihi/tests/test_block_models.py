"""Random models straight as blocks: the fast emulator and NengoLoihi's own, after every step."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import nengo
import numpy as np
import pytest
from block_models import feed, random_calls, random_model
from comparison import NUMPY_1, Outcome, assert_same, state_of
from fastloihi.arrays import LOG_LINES
from fastloihi.emulator import hand_over, take_over
from hypothesis import HealthCheck, Phase, event, example, given, reject, settings
from hypothesis import strategies as st
from nengo_loihi.emulator.interface import EmulatorInterface

import fastloihi
from fastloihi import FastEmulator

SEEDS = st.integers(0, 2**32 - 1)
PROFILE = {
    "phases": [Phase.explicit, Phase.reuse, Phase.generate],  # a seed's model has no simpler one
    "suppress_health_check": [HealthCheck.too_slow],
    "deadline": None,
    "derandomize": True,
}


def two_emulators(seed):
    """NengoLoihi's and the fast one, each of a model of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            models = random_model(seed), random_model(seed)
        except nengo.exceptions.BuildError:  # NengoLoihi cannot discretise it
            return None
        plain, fast = (
            kind(model, seed=seed % 2**31)
            for kind, model in zip((EmulatorInterface, FastEmulator), models)
        )
    if NUMPY_1 and plain.compartment.dtype == np.float32 and plain.synapses.traces:
        return None
    assert type(fast) is FastEmulator
    return plain, fast


def run_both(plain, fast, seed, each_step, n_calls=3):
    """All calls of a seed; whether one ended with an error, and what was warned of."""
    messages = set()
    for spikes, errors, steps in random_calls(plain, seed, n_calls):
        for emulator in (plain, fast):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                feed(emulator, spikes, errors, emulator.t + 1)
        for n in [1] * steps if each_step else [steps]:
            expected = Outcome.of(lambda n=n: plain.run_steps(n))
            actual = Outcome.of(lambda n=n: fast.run_steps(n))
            assert expected == actual, f"step {plain.t}: {expected}, {actual}"
            assert_same(state_of(plain), state_of(fast), f"after step {plain.t}")
            messages |= {message for message, *_ in expected.warnings}
            if expected.error is not None:
                return True, messages
    probes = zip(plain.probes.probes, fast.probes.probes)
    for probe, fast_probe in probes:
        expected, actual = plain.collect_probe_output(probe), fast.collect_probe_output(fast_probe)
        assert expected.dtype == actual.dtype
        assert np.array_equal(expected, actual, equal_nan=True)
    return False, messages


@settings(max_examples=20, **PROFILE)
@given(seed=SEEDS)
def test_every_step_is_that_of_the_emulator(seed):
    emulators = two_emulators(seed) or reject()
    _, messages = run_both(*emulators, seed, each_step=True)
    event(f"dtype: {emulators[0].compartment.dtype}")
    for message in messages:
        event(message)


@settings(max_examples=35, **PROFILE)
@given(seed=SEEDS)
def test_many_steps_in_one_call_are_those_of_the_emulator(seed):
    emulators = two_emulators(seed) or reject()
    run_both(*emulators, seed, each_step=False)


@settings(max_examples=25, **PROFILE)
@given(seed=SEEDS)
@example(seed=56)  # floating point, and a spike of a trace is lost in the third step of 22
def test_a_strict_emulator_stops_in_the_same_place_with_the_same_error(seed):
    plain, fast = two_emulators(seed) or reject()
    for emulator in (plain, fast):
        emulator.compartment.strict, emulator.synapses.strict = seed % 3 != 0, seed % 3 != 1
    failed, _ = run_both(plain, fast, seed, each_step=False)
    event(f"failed: {failed}")
    if failed:  # and goes on from there with the same state
        for emulator in (plain, fast):
            emulator.compartment.strict = emulator.synapses.strict = False
        for _ in range(2):
            assert Outcome.of(plain.step) == Outcome.of(fast.step)
        assert_same(state_of(plain), state_of(fast))


@settings(max_examples=15, **PROFILE)
@given(seed=SEEDS)
@example(seed=56)  # floating point, and a spike of a trace is lost in the third step of 22
def test_a_warning_that_is_an_error_ends_the_step_where_the_emulator_ends_it(seed):
    plain, fast = two_emulators(seed) or reject()
    for spikes, errors, steps in random_calls(plain, seed):
        caught = []
        for emulator in (plain, fast):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                feed(emulator, spikes, errors, emulator.t + 1)
                warnings.filterwarnings("error", category=UserWarning)
                try:
                    emulator.run_steps(steps)
                except UserWarning as warning:
                    caught.append(str(warning))
        assert len(caught) != 1
        assert caught[:1] == caught[1:]
        assert_same(state_of(plain), state_of(fast), f"after step {plain.t}")
        if caught:
            event(caught[0])
            return


@settings(max_examples=15, **PROFILE)
@given(seed=SEEDS)
def test_after_a_step_of_nengo_loihis_own_the_compiled_code_goes_on(seed):
    """A warning might be an error, so that NengoLoihi does the step; it is none."""
    plain, fast = two_emulators(seed) or reject()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "what nobody says", UserWarning)
        run_both(plain, fast, seed, each_step=False)
    assert type(fast) is FastEmulator


@pytest.mark.parametrize("seed", [3, 5])
def test_a_compartment_that_waits_may_spike_where_its_threshold_is_negative(seed):
    plain, fast = two_emulators(seed)
    assert plain.compartment.ref.max() > 1
    for emulator in (plain, fast):
        emulator.compartment.vth[::2] = -1
    run_both(plain, fast, seed, each_step=True)
    again = (plain.compartment.ref > 1) & (plain.compartment.vth < 0)
    assert np.all(plain.compartment.spike_count[again] == plain.t)
    assert again.any()


def test_more_warnings_than_the_log_holds_are_all_given():
    """A model that overflows at every step."""
    for seed in range(1000):
        emulators = two_emulators(seed)
        if emulators is None:
            continue
        plain, fast = emulators
        expected = Outcome.of(lambda plain=plain: plain.run_steps(2 * LOG_LINES))
        if len(expected.warnings) > 2 * LOG_LINES:
            assert Outcome.of(lambda fast=fast: fast.run_steps(2 * LOG_LINES)) == expected
            assert_same(state_of(plain), state_of(fast))
            return
    pytest.fail("no model that overflows often")


def test_a_call_is_cut_where_it_would_take_too_much_memory(monkeypatch):
    plain, fast = two_emulators(5)
    fast._arrays.at_once = 7
    run, steps_at_once = fast._arrays.run, []
    monkeypatch.setattr(
        fast._arrays, "run", lambda *values: steps_at_once.append(values[1]) or run(*values)
    )
    run_both(plain, fast, 5, each_step=False)
    assert max(steps_at_once) == 7


@pytest.mark.parametrize("seed", [2, 3, 5, 8, 11, 19, 20, 24, 27, 40, 48, 55])
def test_an_emulator_can_be_taken_over_and_handed_back_between_steps(seed):
    plain, fast = two_emulators(seed) or pytest.skip("learning in floating point on NumPy 1")
    calls = list(random_calls(plain, seed, n_calls=6, longest=9))
    for number, (spikes, errors, steps) in enumerate(calls):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for emulator in (plain, fast):
                feed(emulator, spikes, errors, emulator.t + 1)
            if number % 2:
                hand_over(fast, "a test")
                assert type(fast) is EmulatorInterface
                assert_same(state_of(plain), state_of(fast), f"before call {number}")
        assert Outcome.of(lambda n=steps: plain.run_steps(n)) == Outcome.of(
            lambda n=steps: fast.run_steps(n)
        )
        if number % 2:
            take_over(fast)
            assert type(fast) is FastEmulator
        assert_same(state_of(plain), state_of(fast), f"after call {number}")


@pytest.mark.skipif(NUMPY_1, reason="NumPy 1 makes floats of uint64 and int")
def test_no_place_outside_of_an_array_is_used():
    """The functions as plain Python, where NumPy refuses what compiled code would not notice."""
    code = """
import sys
sys.modules.update(dict.fromkeys(("tensorflow", "nengo_dl", "keras")))
import numpy as np
from test_block_models import run_both, two_emulators
from fastloihi import arrays
arrays.LOG_LINES = 4
np.seterr(all="ignore")  # Python tells of integers that wrap
for seed in (3, 5, 19, 27, 48, 55):
    run_both(*two_emulators(seed), seed, each_step=False, n_calls=1)
"""
    paths = Path(__file__).parent, Path(fastloihi.__file__).parent.parent
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
