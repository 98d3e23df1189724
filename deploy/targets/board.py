"""The board: Loihi 1, reached through NengoLoihi and Intel's NxSDK.

Everything that knows of NxSDK is here.  NengoLoihi builds and places the network; this module
connects with patience, shows one stream of samples a connection (a board cannot be reset, so a
fresh network is a new connection), and takes down what only the hardware can say: the board, the
time that building, connecting and running took, and the power where the board measures it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass, replace
from typing import Iterator, Optional

import nengo
import numpy as np

from ..errors import UserError
from ..network.build import build
from ..network.loihi_import import nengo_loihi
from ..network.responses import Responses, respond
from ..network.spec import NetworkSpec
from ..preflight.plan import require_fit

POWER_BINS = 1024
"""Bins of the board's energy probe, spread over the steps of a stream."""


@dataclass(frozen=True)
class BoardOptions:
    """Which board, and how hard to try.

    Attributes
    ----------
    board : str or None
        Name of a board; None leaves the choice to the cluster.
    partition : str or None
        SLURM partition; None where the board hangs on this host.
    chips : int
        How many chips the network may take.
    attempts : int
        How often a stream is begun before the run gives up.  NengoLoihi tries to connect three
        times in each.
    wait : float
        Seconds before the second attempt; twice as long before each further one.
    energy : bool
        Whether to measure power.
    timeout : float
        Seconds after which a stream's connection and run are given up, each: a job that hangs.
    """

    board: Optional[str] = None
    partition: Optional[str] = None
    chips: int = 1
    attempts: int = 3
    wait: float = 10.0
    energy: bool = False
    timeout: float = 1800.0

    def __post_init__(self):
        for name, least, most in (
            ("chips", 1, 10_000),
            ("attempts", 1, 1000),
            ("wait", 0, 86_400),
            ("timeout", 1e-3, 864_000),
        ):
            value = getattr(self, name)
            if value < least:
                raise UserError(f"--{name} must be at least {least:g}")
            if not value <= most:  # which NaN is not either
                raise UserError(f"--{name} must be at most {most:g}")


class BoardLost(Exception):
    """The connection failed or broke, or fewer steps came back than the board was asked for."""


def nxsdk_version() -> str:
    """The version of NxSDK on this host.

    Raises
    ------
    UserError
        There is none, or not one that NengoLoihi knows.
    """
    interface = nengo_loihi.hardware.interface
    if not nengo_loihi.hardware.HAS_NXSDK:
        raise UserError(
            "target loihi needs Intel's NxSDK, which is not installed here: run this on an INRC "
            "host (see deploy/inrc/README.md), or use --target emulator"
        )
    found = interface.nxsdk.__version__
    number = interface.parse_nxsdk_version(found)
    oldest = interface.HardwareInterface.min_nxsdk_version
    newest = interface.HardwareInterface.max_nxsdk_version
    if number < oldest or number.release[:2] > newest.release[:2]:
        raise UserError(
            f"NxSDK {found} is too {'old' if number < oldest else 'new'}: "
            f"NengoLoihi {nengo_loihi.__version__} works with {oldest} to {newest}; "
            "activate an environment with one of those"
        )
    return found


def run_loihi(spec: NetworkSpec, streams, seed=0, options=None) -> Iterator[Responses]:
    """Show streams of samples to a board.

    Parameters
    ----------
    spec : NetworkSpec
    streams : iterable of ndarray
        As `Stimulus.flat` gives samples.
    seed : int
    options : BoardOptions, optional

    Yields
    ------
    Responses
        Of each stream in order; what the hardware said is in ``notes``.

    Raises
    ------
    UserError
        No NxSDK, a network that does not fit, or a board that could not be reached or kept.
    """
    options = options or BoardOptions()
    version = nxsdk_version()
    require_fit(spec, options.chips)
    for index, samples in enumerate(streams):
        for attempt in range(1, options.attempts + 1):
            try:
                responses = _run_stream(spec, samples, seed, options)
                break
            except BoardLost as error:
                if attempt == options.attempts:
                    raise UserError(
                        f"board lost in stream {index + 1} of this run, {attempt} attempts: "
                        f"{error}; the streams before it are saved: the same command goes on there"
                    ) from error
                time.sleep(options.wait * 2 ** (attempt - 1))
        responses.notes.update(nxsdk=version, attempts=attempt)
        yield responses


def _run_stream(spec, samples, seed, options):
    built = build(spec, seed)
    steps = built.feed.period * len(samples)
    begun = time.perf_counter()
    with _environment(options):
        sim = _simulator(built.network, options)
        built_at = time.perf_counter()
        try:
            board = sim.sims["loihi"].nxsdk_board
            if options.energy:
                _probe_energy(board, steps)
            with _board_errors(), _time_limit(options.timeout):
                sim.__enter__()
            connected_at = time.perf_counter()
            with _board_errors(), _time_limit(options.timeout):
                responses = respond(spec, built, sim, samples)
            ended_at = time.perf_counter()
        finally:
            _close(sim)
    notes = {
        "board": options.board or os.environ.get("BOARD"),
        "partition": options.partition or os.environ.get("PARTITION"),
        "chips": options.chips,
        "build_seconds": built_at - begun,
        "connect_seconds": connected_at - built_at,
        "run_seconds": ended_at - connected_at,
        "samples": len(samples),
        "steps": steps,
    }
    if options.energy:
        notes["power"] = _measured_power(board)
    return replace(responses, notes=notes)


def _simulator(network, options):
    try:
        return nengo_loihi.Simulator(
            network,
            target="loihi",
            precompute=True,
            hardware_options={"n_chips": options.chips},
        )
    except (nengo.exceptions.NengoException, ImportError, NotImplementedError) as error:
        raise UserError(f"NengoLoihi cannot build this network for a board: {error}") from error


@contextlib.contextmanager
def _board_errors():
    """Whatever the board, its driver or the way to it raises, told as one thing.

    NxSDK has no error class of its own, and NengoLoihi asserts where data is short.
    """
    try:
        yield
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if "AxonCfg" in text:
            raise UserError(
                f"the board refuses the network: {text}; give the layer a smaller block_shape "
                "(see 'stmnist deploy plan')"
            ) from error
        raise BoardLost(text) from error


@contextlib.contextmanager
def _time_limit(seconds):
    """Raise TimeoutError in what takes longer; where no timer can be set there is no limit."""

    def over(signum, frame):
        raise TimeoutError(f"no answer for {seconds:g} s")

    try:
        before = signal.signal(signal.SIGALRM, over)
    except ValueError:  # not the main thread
        yield
        return
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _environment(options):
    """NxSDK reads the board, the partition and whether to go through SLURM from here."""
    wanted = {"BOARD": options.board, "PARTITION": options.partition}
    if options.partition is not None:
        wanted["SLURM"] = "1"
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update({name: value for name, value in wanted.items() if value is not None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _close(sim):
    """Let go of the board; a connection that is broken already may complain, to no end."""
    with contextlib.suppress(Exception):
        sim.close()
    sim.closed = True


def _probe_energy(board, steps):
    """Place NxSDK's energy probe; it must be there before the board starts."""
    try:
        from nxsdk.api.enums.api_enums import ProbeParameter
        from nxsdk.graph.monitor.probes import PerformanceProbeCondition

        bins = max(1, -(-steps // POWER_BINS))
        condition = PerformanceProbeCondition(
            tStart=1, tEnd=steps, bufferSize=POWER_BINS, binSize=1 << (bins - 1).bit_length()
        )
        board.probe(ProbeParameter.ENERGY, condition)
    except Exception as error:
        raise UserError(f"this board has no energy probe ({error}); leave --energy out") from error


def _measured_power(board):
    """What the energy probe found, in mW: total, static (idle) and dynamic, and us a step."""
    stats = board.energyTimeMonitor.powerProfileStats
    power = {name: stats.power[name] for name in ("total", "static", "dynamic")}
    return {
        **{f"{name}_mw": float(value) for name, value in power.items()},
        "step_microseconds": float(stats.timePerTimestep),
    }


def describe(notes: list) -> dict:
    """What a result says of the hardware, from the notes of its streams.

    Parameters
    ----------
    notes : list of dict
        Of each stream, in order.

    Returns
    -------
    dict
        ``hardware`` (board, partition, chips, connections made), ``timing`` in seconds a sample,
        ``versions``, and ``power`` where it was measured: the mean over streams weighted by their
        steps; ``static_mw`` is what the chip draws idle, ``dynamic_mw`` what the network adds.
    """
    last = notes[-1]
    samples = sum(note["samples"] for note in notes)
    result = {
        "hardware": {
            "board": last["board"],
            "partition": last["partition"],
            "chips": last["chips"],
            "connections": len(notes),
            "attempts": sum(note["attempts"] for note in notes),
        },
        "timing": {
            f"{phase}_seconds_per_sample": sum(n[f"{phase}_seconds"] for n in notes) / samples
            for phase in ("build", "connect", "run")
        },
        "versions": {"nxsdk": last["nxsdk"]},
    }
    measured = [note for note in notes if "power" in note]
    if measured:
        weights = [note["steps"] for note in measured]
        result["power"] = {
            "measured_samples": sum(note["samples"] for note in measured),
            **{
                name: float(np.average([note["power"][name] for note in measured], weights=weights))
                for name in measured[0]["power"]
            },
        }
    return result
