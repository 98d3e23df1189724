"""Target loihi, with the NxSDK stand-in where a board would be."""

import os
import signal
from dataclasses import dataclass, replace

import numpy as np
import pytest

from deploy import cli
from deploy.check.comparison import compare_results
from deploy.check.results import read_result
from deploy.check.run import run_check
from deploy.check.text import format_result
from deploy.conformance.networks import (
    draw_frames,
    make_event_network,
    make_image_network,
    make_readout,
)
from deploy.errors import UserError
from deploy.targets import board as hardware
from deploy.targets.options import BoardOptions, Options, option
from deploy.targets.registry import run_target
from deploy.targets.simulators import run_emulator
from tests.command import call, missing
from tests.deploy.networks import bundle_at, draw_checks, make_mixed_network, make_paper_network

PATIENT = BoardOptions(wait=0)


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr("time.sleep", lambda seconds: None)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundle_at(tmp_path_factory.mktemp("bundle") / "bundle", make_image_network(), 7)


@pytest.fixture(scope="module")
def emulated(bundle, tmp_path_factory):
    return run_check(bundle, "emulator", tmp_path_factory.mktemp("home") / "emulator.json")


def same_answers(a, b):
    return a["samples"] == b["samples"] and a["spikes"] == b["spikes"]


def split(*block_shapes):
    """Two layers, in blocks of neurons on a core each, and with spikes of populations."""
    spec = make_image_network()
    convolutions = [
        replace(layer, block_shape=block)
        for layer, block in zip(spec.layers[:2], block_shapes, strict=True)
    ]
    return replace(spec, layers=(*convolutions, spec.layers[2]))


BLOCKS = (4, 3, 4), (2, 2, 8)  # of (4, 4, 4) and (3, 3, 8)
SPECS = {
    "small": make_image_network(),
    "output-on-chip": make_image_network(on_chip_output=True),
    "stride-padding-pool-dense": make_mixed_network(),
    "events": make_event_network(),
    "split": split(*BLOCKS),
    "paper": make_paper_network(steps=12, gap=3, readout_start=4),
}


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_every_spike_is_the_emulators(nxsdk, spec):
    if spec.stimulus.is_static:
        images = draw_checks(spec, 7).inputs.reshape(7, -1)
    else:
        images = spec.stimulus.flatten(draw_frames(spec, 7, share=0.3))
    streams = [images[:3], images[3:6], images[6:]]
    for result, expected in zip(
        hardware.run_loihi(spec, streams, 0, BoardOptions()),
        run_emulator(spec, streams),
        strict=True,
    ):
        np.testing.assert_array_equal(result.spike_hashes, expected.spike_hashes)
        np.testing.assert_array_equal(result.readout, expected.readout)
        for name, counts in expected.spikes.items():
            assert counts.any()
            np.testing.assert_array_equal(result.spikes[name], counts)


def test_a_wrong_weight_shows(nxsdk, bundle, emulated, tmp_path, monkeypatch):
    """The comparison above can fail: one bit of one weight changes spikes."""
    from nxsdk.core import N2Core

    original = N2Core.compile

    def spoilt(core):
        if core.synapses.registers and not core.axons:
            synapse = core.synapses[len(core.synapses.registers) // 2]
            synapse.Wgt = synapse.Wgt ^ 64
        original(core)

    monkeypatch.setattr(N2Core, "compile", spoilt)
    result = run_check(bundle, "loihi", tmp_path / "r.json", options=PATIENT)
    assert compare_results(result, emulated).other_spikes >= 1


BOARD_AND_PARTITION = BoardOptions(board="ncl-ext-ghrd-01", partition="nahuku32", wait=0)


def test_a_board_has_the_answers_and_spikes_of_the_emulator(nxsdk, bundle, emulated, tmp_path):
    result = run_check(bundle, "loihi", tmp_path / "loihi.json", options=BOARD_AND_PARTITION)
    assert same_answers(result, emulated)
    assert set(emulated.to_dict()) <= set(result.to_dict())
    comparison = compare_results(read_result(tmp_path / "loihi.json"), emulated)
    assert (comparison.disagreements, comparison.other_spikes) == ([], 0)


def test_a_result_describes_the_hardware(nxsdk, bundle, tmp_path):
    result = run_check(bundle, "loihi", tmp_path / "loihi.json", options=BOARD_AND_PARTITION)
    assert result["hardware"] == {
        "board": "ncl-ext-ghrd-01",
        "partition": "nahuku32",
        "chips": 1,
        "connections": 3,
        "attempts": 3,
    }
    assert result["versions"]["nxsdk"] == "1.0.0"
    assert all(value > 0 for value in result["timing"].values())
    assert "power" not in result.target_notes


def test_nxsdk_is_told_board_and_partition_and_only_then(nxsdk, monkeypatch):
    import os

    seen = {}
    monkeypatch.delenv("SLURM", raising=False)
    from nxsdk.arch.n2a.n2board import N2Board

    start = N2Board.start

    def spying(board):
        seen.update({name: os.environ.get(name) for name in ("BOARD", "PARTITION", "SLURM")})
        start(board)

    monkeypatch.setattr(N2Board, "start", spying)
    spec = make_image_network()
    images = draw_checks(spec, 1).inputs.reshape(1, -1)
    list(hardware.run_loihi(spec, [images], 0, BoardOptions(board="b", partition="p")))
    assert seen == {"BOARD": "b", "PARTITION": "p", "SLURM": "1"}
    assert "SLURM" not in os.environ


def test_board_that_stays_away_is_one_line(nxsdk, bundle, tmp_path):
    nxsdk.faults.FAULTS.refuse = 100
    with pytest.raises(UserError, match=r"stream 1 .*3 attempts.*connection refused"):
        run_check(bundle, "loihi", tmp_path / "r.json", options=PATIENT)
    assert not (tmp_path / "r.json").exists()


def test_run_goes_on_where_the_board_was_lost(nxsdk, bundle, emulated, tmp_path):
    once = BoardOptions(attempts=1, wait=0)
    nxsdk.faults.FAULTS.lose_at_step = 150
    with pytest.raises(UserError, match=r"stream 2 .*connection to the board lost"):
        run_check(bundle, "loihi", tmp_path / "r.json", options=once)
    before = nxsdk.faults.FAULTS.steps
    result = run_check(bundle, "loihi", tmp_path / "r.json", options=once)
    assert same_answers(result, emulated)
    period = 35
    assert nxsdk.faults.FAULTS.steps - before == 4 * period  # streams 2 (3 samples) and 3 (1)
    assert result["hardware"]["connections"] == 3


def test_missing_steps_are_noticed(nxsdk, bundle, tmp_path):
    nxsdk.faults.FAULTS.short_probes = 1
    with pytest.raises(UserError, match=r"34 of 35 .*conv1"):
        run_check(bundle, "loihi", tmp_path / "r.json", options=PATIENT)


@pytest.fixture(scope="module")
def shortest(tmp_path_factory):
    """As little as can go wrong anywhere: a layer on the chip, three streams of two samples.

    Every attempt at a stream builds the network again, and there are hundreds.
    """
    spec = make_image_network(steps=20, gap=3, readout_start=4, stream_length=2)
    conv1 = spec.layers[0]
    layers = (conv1, make_readout(conv1.shape, np.random.default_rng(0)))
    return bundle_at(
        tmp_path_factory.mktemp("shortest") / "bundle", replace(spec, layers=layers), 6
    )


@pytest.fixture(scope="module")
def shortest_emulated(shortest, tmp_path_factory):
    spikes = run_target(shortest.spec, shortest.checks.inputs, "emulator").spikes
    assert all(counts.all() for counts in spikes.values())  # each sample has what can be lost
    return run_check(shortest, "emulator", tmp_path_factory.mktemp("home") / "emulator.json")


PERIOD = 23  # a fault after 30 steps is in the second sample of its stream
FAULTS = {
    "connection refused, then not": ({"refuse": 4}, True),
    "connection refused for good": ({"refuse": 10**6}, False),
    "connection lost in the middle": ({"lose_at_step": 30}, True),
    "lost, and the board is taken away while we wait": (
        {"lose_at_step": 30, "refuse": 10**6}, False),
    "a short read": ({"short_probes": 1, "times": 1}, True),
    "nothing read": ({"short_probes": PERIOD, "times": 1}, True),
    "too much read": ({"short_probes": -1, "times": 1}, True),
    "always a short read": ({"short_probes": 1}, False),
    "two spikes for one": ({"spikes_twice": True, "times": 1}, True),
    "always two spikes for one": ({"spikes_twice": True}, False),
    "a job that hangs": ({"hang_at_step": 30}, True),
}  # fmt: skip


@pytest.mark.parametrize("stream", [0, 1])  # of three: nothing has been kept yet, or something
@pytest.mark.parametrize(("faults", "survived"), FAULTS.values(), ids=FAULTS)
def test_a_fault_at_a_stream(
    nxsdk, shortest, shortest_emulated, tmp_path, stream, faults, survived
):
    """Either the result is that of a run without faults, or it is one line; then it goes on."""
    injected = nxsdk.faults.FAULTS
    refused = faults.get("refuse") if "lose_at_step" in faults else None
    for name, value in {**faults, "from_connection": stream}.items():
        setattr(injected, name, value)
    if refused:  # first it is lost, then taken away
        injected.refuse, lost = 0, injected.step

        def step():
            try:
                lost()
            except Exception:
                injected.refuse = refused
                raise

        injected.step = step
    # On a busy machine a stream can take longer than a second, which is a lost connection too.
    timeout, attempts = (1.0, 20) if "hang_at_step" in faults else (BoardOptions.timeout, 2)
    options = BoardOptions(attempts=attempts, wait=0, timeout=timeout)
    out = tmp_path / "r.json"
    if not survived:
        with pytest.raises(UserError, match=f"stream {stream + 1} ") as error:
            run_check(shortest, "loihi", out, options=options)
        assert "\n" not in str(error.value)
        assert not out.exists()
        for name in ("refuse", "short_probes", "spikes_twice"):
            setattr(injected, name, 0)
    result = run_check(shortest, "loihi", out, options=options)
    assert same_answers(result, shortest_emulated)


@pytest.mark.parametrize("version", ["0.8.7", "1.1.0"])
def test_wrong_version_of_nxsdk(nxsdk, bundle, tmp_path, monkeypatch, version):
    monkeypatch.setattr(nxsdk, "__version__", version)
    with pytest.raises(UserError, match=f"NxSDK {version} .* 0.9.0 to 1.0.0"):
        run_check(bundle, "loihi", tmp_path / "r.json", options=PATIENT)


def test_without_nxsdk(bundle, tmp_path):
    with pytest.raises(UserError, match=r"target loihi .*NxSDK.*target emulator"):
        run_check(bundle, "loihi", tmp_path / "r.json")


@pytest.mark.parametrize("error", [AssertionError(), ValueError("a core\nis missing")])
def test_a_network_that_only_the_board_refuses_is_one_line(
    nxsdk, bundle, tmp_path, monkeypatch, error
):
    def refuse(board):
        raise error

    monkeypatch.setattr("nengo_loihi.hardware.interface.validate_board", refuse)
    with pytest.raises(UserError, match=f"for a board: .*{str(error)[-7:]}") as raised:
        run_check(bundle, "loihi", tmp_path / "r.json", options=PATIENT)
    assert "\n" not in str(raised.value)


def test_power_is_taken_down_apart_from_idle(nxsdk, bundle, tmp_path):
    nxsdk.faults.FAULTS.power = {"total": 30.0, "static": 25.0, "dynamic": 5.0, "core": {}}
    settings = BoardOptions(energy=True, wait=0)
    result = run_check(bundle, "loihi", tmp_path / "r.json", options=settings)
    assert result["power"] == {
        "measured_samples": 7,
        "total_mw": 30.0,
        "static_mw": 25.0,
        "dynamic_mw": 5.0,
        "step_microseconds": 10.0,
    }
    text = format_result(result)
    assert missing(text, "NxSDK 1.0.0", "3 connections", "5 mW", "25 mW") == []


@pytest.mark.parametrize("command", ["stmnist", "deploy.pyz"])
def test_a_command_s_options_reach_the_board(nxsdk, bundle, tmp_path, monkeypatch, command):
    waits, limits, set_timer = [], [], signal.setitimer

    def timer(which, seconds):
        limits.append(seconds)
        return set_timer(which, seconds)

    monkeypatch.setattr("time.sleep", waits.append)
    monkeypatch.setattr(signal, "setitimer", timer)
    nxsdk.faults.FAULTS.power = {"total": 30.0, "static": 25.0, "dynamic": 5.0, "core": {}}
    nxsdk.faults.FAULTS.refuse = 10  # NengoLoihi gives up after three, the fourth attempt gets it
    out = tmp_path / "r.json"
    place = ("--board", "b", "--partition", "p", "--chips", 2)
    patience = ("--attempts", 4, "--wait", 200, "--timeout", 432)
    arguments = (bundle.path, "--target", "loihi", "--out", out, *place, *patience, "--energy")
    if command == "stmnist":
        assert call("check", "run", *arguments) == 0
    else:
        assert cli.main(["check", *map(str, arguments)]) == 0
    result = read_result(out)
    assert result["hardware"] == {
        "board": "b", "partition": "p", "chips": 2, "connections": 3, "attempts": 6,
    }  # fmt: skip
    assert [wait for wait in waits if wait >= 200] == [200, 400, 600]
    assert set(limits) == {432, 0}
    assert result["power"]["dynamic_mw"] == 5


@pytest.mark.parametrize("wrong", [{"chips": 0}, {"attempts": 0}, {"wait": -1}, {"wait": 86_401}])
def test_senseless_settings(wrong):
    with pytest.raises(UserError, match="--" + next(iter(wrong))):
        BoardOptions(**wrong)


@dataclass(frozen=True)
class OneBound(Options):
    low: int = option(0, "At least 0.", minimum=0)
    high: float = option(0.0, "At most 1.", maximum=1)


def test_an_option_can_have_one_bound():
    assert OneBound(10**9, -1e9) == OneBound(low=10**9, high=-1e9)
    with pytest.raises(UserError, match="--low must be at least 0"):
        OneBound(low=-1)
    for high in (1.5, float("nan")):
        with pytest.raises(UserError, match="--high must be at most 1"):
            OneBound(high=high)


def test_ctrl_c_disconnects_from_the_board(nxsdk, bundle, monkeypatch):
    closed = []

    def interrupted(*_):
        os.kill(os.getpid(), signal.SIGINT)
        raise AssertionError("Ctrl-C was not heard")

    monkeypatch.setattr(hardware, "record_stream", interrupted)
    monkeypatch.setattr(hardware, "_close", lambda sim: closed.append(sim))
    streams = [bundle.spec.flatten_samples(bundle.checks.inputs[:3])]
    with pytest.raises(KeyboardInterrupt):
        list(hardware.run_loihi(bundle.spec, streams, 0, BoardOptions()))
    assert len(closed) == 1
