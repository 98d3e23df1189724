"""The speed of the target ``fast`` relative to NengoLoihi's emulator.

Reference and fast run alternately in one process, and each turn gives one ratio, because other work
on the machine slows down both.  Building, compiling and reading files are not included.
"""

from __future__ import annotations

import contextlib
import importlib.util
import time
import warnings
from dataclasses import dataclass

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.build import build
from deploy.network.loihi_import import nengo_loihi
from deploy.network.responses import read_output, seconds_per_sample
from deploy.network.spec import NetworkSpec
from deploy.network.stream import show, streams_of
from deploy.tables import aligned
from deploy.targets.fast.emulation import KERNELS, Emulation, compile_spec
from pipeline.progress import progress


@dataclass(frozen=True)
class Turn:
    """The duration of one pass over some samples.

    Attributes
    ----------
    whole, chip : ndarray, shape (2,)
        Seconds of host layer, chip and decoding together, and of the chip alone: elapsed time,
        and processor time of this thread, which depends less on other work of the machine.
    samples : int
    """

    whole: np.ndarray
    chip: np.ndarray
    samples: int


def _clocks():
    return np.array([time.perf_counter(), time.thread_time()])


@contextlib.contextmanager
def _timed(part, method):
    """Measure the seconds spent in a method of an object, by both clocks."""
    function, seconds = getattr(part, method), np.zeros(2)

    def timed(*arguments):
        begun = _clocks()
        result = function(*arguments)
        seconds[:] += _clocks() - begun
        return result

    setattr(part, method, timed)
    try:
        yield seconds
    finally:
        delattr(part, method)  # restores the class's method


def kernels_here() -> tuple:
    """The kernels that can run here, the faster first."""
    return KERNELS if importlib.util.find_spec("numba") else KERNELS[1:]


def measure(bundle: Bundle, samples: int | None = None) -> dict:
    """Run reference and fast alternately on a bundle's samples.

    Parameters
    ----------
    bundle : Bundle
    samples : int, optional
        Number of samples to use, from the first on.

    Returns
    -------
    dict
        Ready for JSON.  Ratios are medians over the turns, one turn for each stream of the
        reference.
    """
    spec = bundle.spec
    images = spec.stimulus.flat(bundle.checks.inputs[:samples])
    parts = streams_of(len(images), spec.presentation.stream_length)
    program = compile_spec(spec)
    emulations = {name: Emulation(program, name) for name in kernels_here()}
    # Streams of equal length, without a shorter last one.
    length = parts[0].stop
    whole_set = np.stack([images[part] for part in parts if part.stop - part.start == length])
    identical, reference, turns = True, [], {name: [] for name in emulations}
    for emulation in emulations.values():  # compiles, and warms the caches
        emulation.run(whole_set[:1, :1], spec.presentation.steps, spec.presentation.gap)
    with progress("benchmark", len(images)) as advance:
        for part in parts:
            turn, *answer = reference_turn(spec, images[part])
            reference.append(turn)
            for name, emulation in emulations.items():
                turns[name].append(fast_turn(emulation, spec, whole_set))
                identical &= same_answer(spec, emulation, images[part], *answer)
            advance(turn.samples)
    best = next(iter(emulations))
    elapsed, processor = (
        {
            f"ratio_{part}{suffix}": _ratio(reference, turns[name], part, clock)
            for name, suffix in ((best, ""), ("numpy", "_numpy"))
            for part in ("whole", "chip")
        }
        for clock in (0, 1)
    )
    counts = emulations[best].run(whole_set, spec.presentation.steps, spec.presentation.gap).counts
    return {
        "identical": bool(identical),
        **elapsed,
        "processor_time": processor,
        "samples_per_second": _pace(turns[best]),
        "samples_per_second_numpy": _pace(turns["numpy"]),
        "reference_samples_per_second": _pace(reference),
        "kernel": best,
        "n_samples": len(images),
        "steps_per_sample": spec.presentation.steps,
        "gap_per_sample": spec.presentation.gap,
        "step_ms": 1000 * spec.stimulus.step_seconds,
        "turns": len(parts),
        "mean_rates_hz": {name: mean_rate(spec, spikes) for name, spikes in counts.items()},
        "simulated": spec.provenance.get("simulated"),
    }


def _ratio(reference, turns, part, clock):
    """The median ratio of the speeds of the whole or the chip, by one of the two clocks."""
    ratios = [
        (getattr(a, part)[clock] / a.samples) / (getattr(b, part)[clock] / b.samples)
        for a, b in zip(reference, turns, strict=True)
    ]
    return float(np.median(ratios))


def _pace(turns):
    return float(np.median([turn.samples / turn.whole[0] for turn in turns]))


def mean_rate(spec: NetworkSpec, counts) -> float:
    """Mean spikes per second of a neuron, while samples are presented and in their gaps.

    A second is one of the stimulus: with events, one of the recording, as in
    :mod:`deploy.check.rates`, independently of the number of steps.

    Parameters
    ----------
    spec : NetworkSpec
    counts : ndarray of int
        Spikes of each neuron and sample.
    """
    return float(np.mean(counts) / seconds_per_sample(spec))


def reference_turn(spec, images):
    """NengoLoihi's emulator on one stream.

    Returns
    -------
    Turn, ndarray (n_samples, period, n_outputs), dict of str to list of ndarray
        Time, the output probe, and every spike, for each layer packed by sample.
    """
    built, outputs = build(spec), []
    spikes = {name: [] for name in built.spikes}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with (
            nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim,
            _timed(sim.sims["emulator"], "run_steps") as chip,
            _timed(sim, "run_steps") as whole,
        ):
            for sample in show(built, sim, images):
                outputs.append(sample.output)
                for name, rows in sample.spikes.items():
                    spikes[name].append(np.packbits(rows, axis=1))
    return Turn(whole, chip, len(images)), np.array(outputs), spikes


def fast_turn(emulation, spec, streams) -> Turn:
    """The target fast on all streams, side by side, in one thread."""
    with _timed(emulation, "run") as whole, _timed(emulation.kernel, "advance") as chip:
        emulation.run(streams, spec.presentation.steps, spec.presentation.gap)
    return Turn(whole, chip, streams.shape[0] * streams.shape[1])


def same_answer(spec, emulation, images, output, spikes) -> bool:
    """True if all spikes and predictions are equal and outputs differ by at most 1e-9."""
    gap, watched = spec.presentation.gap, []
    mine = emulation.run(images[None], spec.presentation.steps, gap, watched.append)
    counts = {name: counts[0] for name, counts in mine.counts.items()}
    predictions = [
        read_output(spec, out[:, gap:], counts).predictions for out in (mine.output[0], output)
    ]
    return (
        set(watched[0]) == set(spikes)
        and all(
            np.array_equal(packed[name][0], rows[index])
            for name, rows in spikes.items()
            for index, packed in enumerate(watched)
        )
        and bool(np.allclose(mine.output[0], output, rtol=0, atol=1e-9))
        and np.array_equal(*predictions)
    )


def speed_text(result: dict) -> str:
    """The result as a table and a few lines."""
    kind = "simulated samples" if result["simulated"] else "samples"
    verdict = (
        "every spike at every step, predictions, outputs within 1e-9"
        if result["identical"]
        else "NO: the answers differ"
    )
    rows = [
        ["", "samples/s", "whole", "chip", "whole, CPU", "chip, CPU"],
        _row("NengoLoihi's emulator", result["reference_samples_per_second"], [1, 1, 1, 1]),
    ]
    for name, suffix in (("numba", ""), ("numpy", "_numpy")):
        if name == "numpy" or result["kernel"] == name:
            ratios = [
                times[f"ratio_{part}{suffix}"]
                for times in (result, result["processor_time"])
                for part in ("whole", "chip")
            ]
            rows.append(_row(f"fast, {name}", result["samples_per_second" + suffix], ratios))
    rates = ", ".join(f"{name} {rate:.0f}" for name, rate in result["mean_rates_hz"].items())
    lines = [
        f"{result['n_samples']} {kind} of {result['gap_per_sample']} blank and "
        f"{result['steps_per_sample']} presentation steps, one thread, medians of "
        f"{result['turns']} turns",
        f"identical: {verdict}",
        *aligned(rows),
        f"mean rates in Hz, at {result['step_ms']:g} ms a step: {rates}",
    ]
    return "\n".join(lines)


def _row(name, pace, ratios):
    return [name, f"{pace:.0f}", *(f"{ratio:.0f}x" for ratio in ratios)]
