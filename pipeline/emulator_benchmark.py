"""How fast the target ``fast`` is next to NengoLoihi's emulator, and what limits it.

Reference and fast take turns in one process, and each turn gives one ratio: on a machine with
other work, the two slow down together.  Building, compiling and reading files are in no figure.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace

import numpy as np

from deploy.fast.arrays import State
from deploy.fast.run import Emulation, compile_spec
from deploy.foreign import nengo_loihi
from deploy.network import build
from deploy.network_spec import DT, NetworkSpec
from deploy.presentation import read_output, seconds_per_sample, streams_of

KERNELS = ("numba", "numpy")


@dataclass(frozen=True)
class Turn:
    """What one pass over some samples took.

    Attributes
    ----------
    whole, chip : ndarray, shape (2,)
        Seconds of host layer, chip and decoding together, and of the chip alone: by the clock on
        the wall, and of this thread's processor time, which other work on the machine lengthens
        less.
    samples : int
    """

    whole: np.ndarray
    chip: np.ndarray
    samples: int


def _clocks():
    return np.array([time.perf_counter(), time.thread_time()])


class _TimedKernel:
    """A kernel that adds up the time spent in it."""

    def __init__(self, kernel):
        self.kernel, self.seconds = kernel, np.zeros(2)
        self.bytes_per_spike = kernel.bytes_per_spike

    def advance(self, state, inputs):
        begun = _clocks()
        steps = self.kernel.advance(state, inputs)
        self.seconds += _clocks() - begun
        return steps


def kernels_here() -> tuple:
    """The kernels that can run here, the faster first."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return KERNELS[1:]
    return KERNELS


def compare(spec: NetworkSpec, images, advance=None) -> dict:
    """Let reference and fast take turns over a set of samples.

    Parameters
    ----------
    spec : NetworkSpec
    images : ndarray, shape (n_samples, ...)
    advance : callable, optional
        Called with the number of samples that the reference has done since the last call.

    Returns
    -------
    dict
        Ready for JSON.  Ratios are medians over the turns, one turn a stream of the reference.
    """
    images = np.asarray(images, float).reshape(len(images), -1)
    parts = streams_of(len(images), spec.presentation.stream_length)
    program = compile_spec(spec)
    emulations = {name: Emulation(program, name) for name in kernels_here()}
    whole_set = _equal_streams(images, parts)
    identical, reference, turns = True, [], {name: [] for name in emulations}
    for emulation in emulations.values():  # compiles, and warms the caches
        emulation.run(whole_set[:1, :1], spec.presentation.steps, spec.presentation.gap)
    for part in parts:
        turn, *answer = reference_turn(spec, images[part])
        reference.append(turn)
        for name, emulation in emulations.items():
            turns[name].append(fast_turn(emulation, spec, whole_set))
            identical &= same_answer(spec, emulation, images[part], *answer)
        if advance is not None:
            advance(turn.samples)
    best = next(iter(emulations))
    walls, processor = (_ratios(reference, turns, best, clock) for clock in (0, 1))
    return {
        "identical": bool(identical),
        **walls,
        "processor_time": processor,
        "samples_per_second": _pace(turns[best]),
        "samples_per_second_numpy": _pace(turns["numpy"]),
        "reference_samples_per_second": _pace(reference),
        "kernel": best,
        "n_samples": len(images),
        "steps_per_sample": spec.presentation.steps,
        "gap_per_sample": spec.presentation.gap,
        "turns": len(parts),
        "mean_rates_hz": _rates(spec, emulations[best], whole_set),
    }


def _ratios(reference, turns, best, clock):
    """How many times faster, by one of the two clocks."""

    def ratio(name, what):
        ratios = [
            (getattr(a, what)[clock] / a.samples) / (getattr(b, what)[clock] / b.samples)
            for a, b in zip(reference, turns[name], strict=True)
        ]
        return float(np.median(ratios))

    return {
        "ratio_whole": ratio(best, "whole"),
        "ratio_chip": ratio(best, "chip"),
        "ratio_whole_numpy": ratio("numpy", "whole"),
        "ratio_chip_numpy": ratio("numpy", "chip"),
    }


def _equal_streams(images, parts):
    """The samples as streams of one length, a shorter last one left out."""
    length = parts[0].stop
    full = [images[part] for part in parts if part.stop - part.start == length]
    return np.stack(full)


def _pace(turns):
    return float(np.median([turn.samples / turn.whole[0] for turn in turns]))


def _rates(spec, emulation, streams):
    """Spikes a second of each layer's neurons while a sample is shown and in its gap."""
    shown = emulation.run(streams, spec.presentation.steps, spec.presentation.gap)
    seconds = seconds_per_sample(spec)
    return {name: float(counts.mean() / seconds) for name, counts in shown.counts.items()}


def reference_turn(spec, images):
    """NengoLoihi's emulator on one stream.

    Returns
    -------
    Turn, ndarray (n_samples, period, n_outputs), dict of str to list of ndarray
        Time, the output probe, and every spike, for each layer packed by sample.
    """
    built = build(spec)
    built.feed.images = images
    chip, whole, outputs = np.zeros(2), np.zeros(2), []
    spikes = {name: [] for name in built.spikes}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:
            emulator = sim.sims["emulator"]
            run_steps = emulator.run_steps

            def timed(steps):
                begun = _clocks()
                run_steps(steps)
                nonlocal chip
                chip += _clocks() - begun

            emulator.run_steps = timed
            for _ in images:
                begun = _clocks()
                sim.run_steps(built.feed.period)
                whole += _clocks() - begun
                outputs.append(np.array(sim.data[built.output]))
                for name, probe in built.spikes.items():
                    spikes[name].append(np.packbits(np.array(sim.data[probe]) != 0, axis=1))
                sim.clear_probes()
    return Turn(whole, chip, len(images)), np.array(outputs), spikes


def fast_turn(emulation, spec, streams) -> Turn:
    """The target fast on all streams, side by side, in one thread."""
    kernel = emulation.kernel
    emulation.kernel = timed = _TimedKernel(kernel)
    begun = _clocks()
    emulation.run(streams, spec.presentation.steps, spec.presentation.gap)
    seconds = _clocks() - begun
    emulation.kernel = kernel
    return Turn(seconds, timed.seconds, streams.shape[0] * streams.shape[1])


def same_answer(spec, emulation, images, output, spikes) -> bool:
    """Every spike the same, outputs within 1e-9, predictions the same."""
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


# --- how the cost grows, and its limit ----------------------------------------------------------


def growth(spec: NetworkSpec, images) -> dict:
    """Seconds of the whole pipeline for more samples, more steps and more spikes.

    Returns
    -------
    dict
        ``samples``, ``steps`` and ``brightness``: lists of dicts with the seconds of each; the
        last with the mean rate on the chip in Hz.
    """
    images = np.asarray(images, float).reshape(len(images), -1)
    emulation = Emulation(compile_spec(spec))
    length = min(spec.presentation.stream_length, len(images))
    steps, gap = spec.presentation.steps, spec.presentation.gap

    def streams(n):
        repeated = images[np.arange(n * length) % len(images)]
        return repeated.reshape(n, length, -1)

    base = streams(max(1, len(images) // length))
    return {
        "samples": [
            {"samples": n * length, "seconds": _best(emulation, streams(n), steps, gap)}
            for n in (1, 5, 20, 100)
        ],
        "steps": [
            {"steps": n, "seconds": _best(emulation, base, n, gap)} for n in (25, 50, 100, 200, 400)
        ],
        "brightness": [
            {
                "brightness": factor,
                "chip_hz": _chip_rate(emulation, factor * base, steps, gap),
                "seconds": _best(emulation, factor * base, steps, gap),
            }
            for factor in (0.0, 0.5, 1.0, 2.0)
        ],
    }


def _best(emulation, streams, steps, gap, repeats=3):
    seconds = []
    for _ in range(repeats):
        begun = time.perf_counter()
        emulation.run(streams, steps, gap)
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


def _chip_rate(emulation, streams, steps, gap):
    counts = emulation.run(streams, steps, gap).counts
    on_chip = [counts[layer.label] for layer in emulation.program.network.layers]
    return float(np.concatenate([c.reshape(-1) for c in on_chip]).mean() / ((steps + gap) * DT))


def limits(spec: NetworkSpec, images) -> dict:
    """What the kernel with Numba does a second, and what this machine could do.

    The chip's cost has two parts: updating every compartment at every step, measured on a network
    that gets no spikes at all, and delivering spikes, the rest.  A synaptic operation reads a
    weight and a total and writes the total; the most that the machine does of those is measured by
    adding one vector to another in its fastest cache, and by adding vectors that come from its main
    memory.

    Returns
    -------
    dict
        Operations a second and shares.
    """
    from deploy.fast import kernel_numba

    images = np.asarray(images, float).reshape(len(images), -1)
    program = compile_spec(spec)
    network = program.network
    emulation = Emulation(program, "numba")
    kept = []
    kernel = emulation.kernel
    emulation.kernel = _Keeping(kernel, kept)
    emulation.run(images[:, None], spec.presentation.steps, spec.presentation.gap)
    inputs = np.concatenate(kept, axis=1)
    shape = (*inputs.shape[:2], network.n)

    def seconds(arriving, biased):
        state = State.fresh(biased, shape[0])
        chip = kernel_numba.Kernel(biased, program.output.decoders)
        begun = time.perf_counter()
        steps = chip.advance(state, arriving)
        return time.perf_counter() - begun, steps

    silent = replace(network, bias=np.zeros_like(network.bias))
    busy, idle = [], []
    for _ in range(5):  # in turns, for the same reason as above
        taken, steps = seconds(inputs, network)
        busy.append(taken)
        idle.append(seconds(np.zeros_like(inputs), silent)[0])
    spiking, updating = min(busy), min(idle)
    fan_out = np.diff(network.weights.indptr)
    wires = kernel_numba.wiring(network)
    lanes_of = np.diff(np.concatenate([[0], np.cumsum(wires.length)])[wires.first]).sum(axis=0)
    counts = np.concatenate([inputs.sum(axis=(0, 1), dtype=np.int64), steps.counts.sum(axis=0)])
    operations, lanes = int(counts @ fan_out), int(counts @ lanes_of)
    delivering = max(spiking - updating, 1e-9)
    cache, memory = _adds(wires.pool.dtype, 512), _adds(wires.pool.dtype, 1 << 25)
    return {
        "weight_bits": 8 * wires.pool.dtype.itemsize,
        "compartment_updates_per_second": float(np.prod(shape) / updating),
        "synaptic_operations_per_second": operations / delivering,
        "weights_added_per_second": lanes / delivering,
        "adds_per_second_in_cache": cache,
        "adds_per_second_from_memory": memory,
        "share_of_cache_limit": lanes / delivering / cache,
        "share_of_time_updating": updating / spiking,
    }


class _Keeping:
    """A kernel that keeps what arrives."""

    def __init__(self, kernel, kept):
        self.kernel, self.kept = kernel, kept
        self.bytes_per_spike = kernel.bytes_per_spike

    def advance(self, state, inputs):
        self.kept.append(inputs.copy())
        return self.kernel.advance(state, inputs)


def _adds(dtype, length):
    """Additions a second of one vector to another, of ``length`` numbers each."""
    import numba

    @numba.njit
    def add(a, b, times):
        for _ in range(times):
            for i in range(len(a)):
                a[i] += b[i]

    a, b = np.zeros(length, dtype), np.ones(length, dtype)
    times = max(1, (1 << 26) // length)
    add(a, b, 1)
    seconds = []
    for _ in range(5):
        begun = time.perf_counter()
        add(a, b, times)
        seconds.append(time.perf_counter() - begun)
    return length * times / min(seconds)
