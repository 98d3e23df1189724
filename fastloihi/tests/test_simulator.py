"""`FastSimulator` and `accelerate` compared with NengoLoihi's `Simulator`, on whole networks."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import nengo
import nengo_loihi
import numpy as np
import pytest
from comparison import NUMPY_1, Both, Outcome, assert_same, state_of
from nengo.exceptions import SimulatorClosed, ValidationError
from nengo_loihi.emulator.interface import EmulatorInterface
from networks import NETWORKS, channel, convolution, feedback, learning, passthrough

import fastloihi
from fastloihi import FastEmulator, FastSimulator, NotAccelerated, accelerate


def run(kind, make, calls=(30, 1, 50), target="sim", after_first=None, **options):
    """Outputs of the probes and the emulator's state after some calls of ``run_steps``."""
    network, probes = make()
    with kind(network, target=target, seed=7, **options) as simulator:
        for steps in calls:
            simulator.run_steps(steps)
            if after_first is not None:
                after_first(simulator)
        return [simulator.data[probe] for probe in probes], state_of(simulator.sims["emulator"])


def assert_same_run(expected, actual):
    for expected_array, other in zip(expected[0], actual[0]):
        assert expected_array.dtype == other.dtype
        assert np.array_equal(expected_array, other)
    assert_same(expected[1], actual[1])


@pytest.mark.parametrize("target", ["sim", "simreal"])
@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_gives_the_same_in_every_bit(name, target):
    if NUMPY_1 and target == "simreal" and name in ("learning", "two rules"):
        pytest.skip("learning in floating point is not compiled on NumPy 1")
    expected = run(nengo_loihi.Simulator, NETWORKS[name], target=target)
    actual = run(FastSimulator, NETWORKS[name], target=target)
    assert any(np.any(values) for values in expected[0])
    assert_same_run(expected, actual)


def clear(simulator):
    simulator.clear_probes()
    with pytest.raises(NotImplementedError):
        simulator.reset()


def change(simulator):
    state = simulator.sims["emulator"].compartment
    state.voltage[::3] = 0
    state.bias[::2] += 5
    state.current = np.arange(len(state.current), dtype=np.int32)
    state.ref_count = np.full(len(state.current), 2, np.int32)


def draw(simulator):
    simulator.sims["emulator"].rng.randint(5, size=3)


CHIPS = {"n_chips": 2, "snip_max_spikes_per_step": 4}
OPTIONS = {
    "precomputed": (channel, {"precompute": True}),
    "not precomputed": (channel, {"precompute": False}),
    "steps of 2 ms": (channel, {"dt": 0.002}),
    "options of the hardware": (channel, {"hardware_options": CHIPS}),
    "probes are cleared and a reset is refused": (channel, {"after_first": clear}),
    "state is changed in place or by a new array": (channel, {"after_first": change}),
    "random numbers are drawn between steps": (learning, {"after_first": draw}),
}


@pytest.mark.parametrize(("make", "options"), OPTIONS.values(), ids=OPTIONS)
def test_options_and_changes_are_those_of_nengo_loihi(make, options):
    expected = run(nengo_loihi.Simulator, make, **options)
    assert_same_run(expected, run(FastSimulator, make, **options))


@pytest.mark.parametrize("remove_passthrough", [True, False])
def test_nodes_are_removed_or_not(remove_passthrough, monkeypatch):
    """Both emulators have one model, because NengoLoihi may build another one the next time."""
    monkeypatch.setattr(nengo_loihi.simulator, "EmulatorInterface", Both)
    options = {"target": "sim", "seed": 7, "remove_passthrough": remove_passthrough}
    with nengo_loihi.Simulator(passthrough()[0], **options) as simulator:
        chip = simulator.sims["emulator"]
        for steps in (30, 1, 50):
            simulator.run_steps(steps)
        assert type(chip.fast) is FastEmulator
        assert chip.compartment.spike_count.any()


@pytest.mark.parametrize("loop", [True, False])
def test_a_simulator_goes_on_after_an_error_on_the_host(loop):
    runs = []
    for kind in (nengo_loihi.Simulator, FastSimulator):
        with nengo.Network(seed=1) as network:
            fails = nengo.Node(lambda t, *x: 1 / (round(t / 0.001) - 20), size_in=int(loop))
            a = nengo.Ensemble(40, 1)
            nengo.Connection(fails, a)
            if loop:
                nengo.Connection(a, fails)
            probe = nengo.Probe(a, synapse=0.01)
        with kind(network, target="sim", seed=7) as simulator:
            simulator.run_steps(10)
            with pytest.raises(ZeroDivisionError):
                simulator.run_steps(20)
            simulator.run_steps(15)
            runs.append(([simulator.data[probe]], state_of(simulator.sims["emulator"])))
    assert_same_run(*runs)


@pytest.mark.parametrize("make", [channel, learning, convolution])
def test_a_simulator_that_has_run_goes_on(make):
    """With its learned weights, its probes' filters and the spikes that are under way."""
    expected = run(nengo_loihi.Simulator, make)
    actual = run(nengo_loihi.Simulator, make, after_first=accelerate)
    assert_same_run(expected, actual)


def test_accelerate_gives_the_simulator_and_may_be_called_again():
    with nengo_loihi.Simulator(channel()[0], target="sim") as simulator:
        assert accelerate(accelerate(simulator)) is simulator
        assert type(simulator.sims["emulator"]) is FastEmulator


def test_a_node_on_the_host_sees_the_state_of_every_step():

    def look(kind):
        states, simulators = [], []

        def look_at(t, x):
            if simulators:
                state = simulators[0].sims["emulator"].compartment
                states.append((state.voltage.copy(), state.current.copy(), state.spiked.copy()))

        network, _ = feedback()
        with network:
            watcher = nengo.Node(look_at, size_in=1)
            nengo.Connection(next(e for e in network.all_ensembles), watcher)
        with kind(network, target="sim", seed=3) as simulator:
            simulators.append(simulator)
            simulator.run_steps(20)
        assert len(states) == 20
        assert states[-1][0].any()
        return states

    states = zip(look(nengo_loihi.Simulator), look(FastSimulator))
    for expected_state, actual_state in states:
        for expected, actual in zip(expected_state, actual_state):
            assert np.array_equal(expected, actual)


def test_a_closed_one_refuses_as_ever():
    with FastSimulator(channel()[0]) as simulator:
        simulator.run(0.01)
    assert simulator.time == pytest.approx(0.01)
    with pytest.raises(SimulatorClosed):
        simulator.run(0.01)
    assert accelerate(simulator) is simulator


@pytest.mark.parametrize("arguments", [{"network": None}, {"target": "nowhere"}])
def test_what_nengo_loihi_refuses_is_refused_with_its_error(arguments):
    all_arguments = {"network": channel()[0], **arguments}
    expected = Outcome.of(lambda: nengo_loihi.Simulator(**all_arguments)).error
    actual = Outcome.of(lambda: FastSimulator(**all_arguments)).error
    assert type(actual) is type(expected) is ValidationError
    assert str(actual) == str(expected)


def test_a_simulator_on_a_board_has_no_emulator_to_accelerate():
    simulator = nengo_loihi.Simulator(channel()[0], target="sim")
    with simulator:
        chip = simulator.sims.pop("emulator")
        with pytest.raises(ValidationError):
            accelerate(simulator)
        simulator.sims["emulator"] = chip


def test_a_class_of_somebody_elses_is_left_as_it_is():
    class Own(EmulatorInterface):
        pass

    with nengo_loihi.Simulator(channel()[0], target="sim") as simulator:
        simulator.sims["emulator"].__class__ = Own
        with pytest.warns(NotAccelerated):
            accelerate(simulator)
        assert type(simulator.sims["emulator"]) is Own


def test_it_runs_without_the_other_packages_of_this_repository():
    code = """
import sys
sys.modules.update(dict.fromkeys(("tensorflow", "nengo_dl", "keras")))
import nengo
from fastloihi import FastSimulator
with nengo.Network(seed=1) as network:
    nengo.Ensemble(10, 1)
with FastSimulator(network) as simulator:
    simulator.run(0.01)
kind = type(simulator.sims["emulator"]).__name__
ours = {"deploy", "models", "pipeline", "stmnist"}.intersection(sys.modules)
print(kind, len(ours))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": str(Path(fastloihi.__file__).parent.parent)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.split() == ["FastEmulator", "0"], done.stderr


def test_in_a_zip_archive_the_compiled_code_is_cached_if_there_is_a_folder(tmp_path):
    archive = shutil.make_archive(
        str(tmp_path / "fast"), "zip", str(Path(fastloihi.__file__).parent.parent), "fastloihi"
    )
    archive = shutil.move(archive, str(tmp_path / "deploy.pyz"))
    code = """
import sys
import numpy as np
from fastloihi import compiled
assert ".pyz" in compiled.__file__
sums = np.zeros((1, 2))
compiled.sum_rows(np.array([[256]], np.uint64), np.arange(16.0).reshape(8, 2), sums)
assert sums.tolist() == [[2, 3]]
print(sum(compiled.sum_rows.stats.cache_hits.values()), compiled._has_cache(compiled.sum_rows))
"""
    written = tmp_path / "cache"
    not_written = tmp_path / "file" / "cache"
    not_written.parent.touch()
    for cache, expected in ((written, "0 True"), (written, "1 True"), (not_written, "0 False")):
        env = {**os.environ, "PYTHONPATH": archive, "NUMBA_CACHE_DIR": str(cache)}
        done = subprocess.run(
            [sys.executable, "-c", code], env=env, capture_output=True, text=True, cwd=str(tmp_path)
        )
        assert done.stdout.strip() == expected, done.stderr
    assert len(list(written.glob("fastloihi/*/compiled.py"))) == 1
