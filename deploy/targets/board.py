"""The board: Loihi 1, reached through NengoLoihi and Intel's NxSDK.

No other module uses NxSDK.  NengoLoihi builds and places the network; this module connects, with
several attempts, presents one stream of samples per connection (a board cannot be reset, so that a
fresh network needs a new connection), and records what only hardware can report: the board, the
time for building, connecting and running, and the power if the board measures it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import replace
from typing import Iterator

import numpy as np

from ..arithmetic import divide_up
from ..errors import UserError, format_as_line
from ..network.build import build_nengo_network
from ..network.loihi_import import BUILD_ERRORS, nengo_loihi
from ..network.output import TargetOutput
from ..network.simulation import record_stream
from ..network.spec import NetworkSpec
from ..preflight.plan import REMEDIES, require_fit_on_chips
from .options import MAX_WAIT_S, BoardOptions

# Number of bins of the board's energy probe, spread over the steps of a stream.
POWER_BINS = 1024


class BoardLost(Exception):
    """The connection failed or was lost, or the board returned fewer steps than requested."""


def find_nxsdk_version() -> str:
    """The version of NxSDK on this host.

    Raises
    ------
    UserError
        NxSDK is not installed, or NengoLoihi does not support its version.
    """
    interface = nengo_loihi.hardware.interface
    if not nengo_loihi.hardware.HAS_NXSDK:
        raise UserError(
            "target loihi needs Intel's NxSDK, which is not installed in this Python: on an INRC "
            "host, activate the environment that has it; elsewhere there is no board, and the "
            "target emulator gives the same spikes without one"
        )
    installed = interface.nxsdk.__version__
    number = interface.parse_nxsdk_version(installed)
    oldest = interface.HardwareInterface.min_nxsdk_version
    newest = interface.HardwareInterface.max_nxsdk_version
    if number < oldest or number.release[:2] > newest.release[:2]:
        raise UserError(
            f"NxSDK {installed} is too {'old' if number < oldest else 'new'}: "
            f"NengoLoihi {nengo_loihi.__version__} works with {oldest} to {newest}; "
            "activate an environment with one of those"
        )
    return installed


def run_loihi(
    spec: NetworkSpec, streams, seed: int, options: BoardOptions
) -> Iterator[TargetOutput]:
    """Present streams of samples to a board: ``run`` of :class:`~.registry.Target`.

    Yields
    ------
    TargetOutput
        The output for each stream in order; ``notes`` has the hardware's data.

    Raises
    ------
    UserError
        NxSDK is missing, the network does not fit, or the board could not be reached or was lost.
    """
    version = find_nxsdk_version()
    require_fit_on_chips(spec, options.chips)
    for index, samples in enumerate(streams):
        for attempt in range(1, options.attempts + 1):
            try:
                output = _run_stream(spec, samples, seed, options)
                break
            except BoardLost as error:
                if attempt == options.attempts:
                    raise UserError(
                        f"board lost in stream {index + 1} of this run, {attempt} attempts: "
                        f"{error}; the previous streams are saved: repeat the command to resume"
                    ) from error
                time.sleep(min(options.wait * 2 ** (attempt - 1), max(options.wait, MAX_WAIT_S)))
        output.notes.update(nxsdk=version, attempts=attempt)
        yield output


def _run_stream(spec, samples, seed, options):
    built = build_nengo_network(spec, seed)
    steps = built.feed.period * len(samples)
    begun = time.perf_counter()
    with _set_environment(options):
        sim = _make_simulator(built.network, options)
        built_at = time.perf_counter()
        try:
            board = sim.sims["loihi"].nxsdk_board
            if options.energy:
                _place_energy_probe(board, steps)
            with _convert_board_errors(), _time_limit(options.timeout):
                sim.__enter__()
            connected_at = time.perf_counter()
            with _convert_board_errors(), _time_limit(options.timeout):
                output = record_stream(spec, built, sim, samples)
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
        notes["power"] = _read_power(board)
    return replace(output, notes=notes)


def _make_simulator(network, options):
    try:
        return nengo_loihi.Simulator(
            network, target="loihi", precompute=True, hardware_options={"n_chips": options.chips}
        )
    except (*BUILD_ERRORS, ImportError, NotImplementedError, ValueError) as error:
        problem = (
            format_as_line(str(error))
            or "a limit that it does not name is exceeded; see the command 'plan'"
        )
        raise UserError(f"NengoLoihi cannot build this network for a board: {problem}") from error


@contextlib.contextmanager
def _convert_board_errors():
    """Convert all errors of the board, its driver and its connection to `BoardLost`.

    NxSDK has no error class of its own, and NengoLoihi raises AssertionError for missing data.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if "AxonCfg" in text:
            raise UserError(
                f"the board refuses the network: {text}; "
                f"{REMEDIES['AxonCfg registers']} (see the command 'plan')"
            ) from error
        raise BoardLost(text) from error


@contextlib.contextmanager
def _time_limit(seconds):
    """Raise TimeoutError after a time limit, which is not enforced where timers are not allowed."""

    def raise_timeout(signum, frame):
        raise TimeoutError(f"no answer for {seconds:g} s")

    try:
        before = signal.signal(signal.SIGALRM, raise_timeout)
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
def _set_environment(options):
    """Set the environment from which NxSDK reads the board, the partition and the use of SLURM."""
    variables = {"BOARD": options.board, "PARTITION": options.partition}
    if options.partition is not None:
        variables["SLURM"] = "1"
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update({name: value for name, value in variables.items() if value is not None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _close(sim):
    """Disconnect from the board; errors of a lost connection are ignored."""
    with contextlib.suppress(Exception):
        sim.close()
    sim.closed = True


def _place_energy_probe(board, steps):
    """Place NxSDK's energy probe, which must be done before the board starts."""
    try:
        from nxsdk.api.enums.api_enums import ProbeParameter
        from nxsdk.graph.monitor.probes import PerformanceProbeCondition

        bins = max(1, divide_up(steps, POWER_BINS))
        condition = PerformanceProbeCondition(
            tStart=1, tEnd=steps, bufferSize=POWER_BINS, binSize=1 << (bins - 1).bit_length()
        )
        board.probe(ProbeParameter.ENERGY, condition)
    except Exception as error:
        raise UserError(f"this board has no energy probe ({error}); leave --energy out") from error


def _read_power(board):
    """The energy probe's total, static (idle) and dynamic power in mW, and us per step."""
    stats = board.energyTimeMonitor.powerProfileStats
    power = {name: stats.power[name] for name in ("total", "static", "dynamic")}
    return {
        **{f"{name}_mw": float(value) for name, value in power.items()},
        "step_microseconds": float(stats.timePerTimestep),
    }


def summarise_notes(notes: list) -> dict:
    """Summarise the hardware's data for a result, from the notes of its streams.

    Parameters
    ----------
    notes : list of dict
        Notes of each stream, in order.

    Returns
    -------
    dict
        ``hardware`` (board, partition, chips, number of connections), ``timing`` in seconds per
        sample, ``versions``, and ``power`` if it was measured: the mean over streams weighted by
        their steps; ``static_mw`` is the idle power, ``dynamic_mw`` the additional power.  If a
        check was resumed elsewhere, board, partition or chips are the list of all, in order.
    """

    def list_values(name):
        return list(dict.fromkeys(note[name] for note in notes))

    def find_value(name):
        values = list_values(name)
        return values[0] if len(values) == 1 else values

    def sum_seconds(phase):
        return sum(note[f"{phase}_seconds"] for note in notes)

    samples = sum(note["samples"] for note in notes)
    result = {
        "hardware": {
            **{name: find_value(name) for name in ("board", "partition", "chips")},
            "connections": len(notes),
            "attempts": sum(note["attempts"] for note in notes),
        },
        "timing": {
            f"{phase}_seconds_per_sample": sum_seconds(phase) / samples
            for phase in ("build", "connect", "run")
        },
        "versions": {"nxsdk": ", ".join(list_values("nxsdk"))},
    }
    measured = [note for note in notes if "power" in note]
    if measured:
        power = {"measured_samples": sum(note["samples"] for note in measured)}
        weights = [note["steps"] for note in measured]
        for name in measured[0]["power"]:
            values = [note["power"][name] for note in measured]
            power[name] = float(np.average(values, weights=weights))
        result["power"] = power
    return result
