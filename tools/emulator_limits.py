"""The scaling of the cost of the target ``fast``, and the limits of its kernel with Numba.

``python -m tools.emulator_limits BUNDLE``
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.network.spec import NetworkSpec
from deploy.targets.fast.arrays import State
from deploy.targets.fast.emulation import Emulation, compile_spec
from deploy.targets.fast.wiring import wiring
from pipeline.commands import options
from pipeline.commands.main import run_tool
from pipeline.experiments.emulator_speed import kernels_here, mean_rate
from pipeline.progress import progress


def growth(spec: NetworkSpec, images) -> dict:
    """Measure the seconds of a complete run for more samples, more steps and more spikes.

    Returns
    -------
    dict
        ``samples``, ``steps`` and ``brightness``: lists of dicts with the seconds of each; the
        last with the mean rate on the chip in Hz, for events with all events and with none.
    """
    static = spec.stimulus.static
    images = spec.stimulus.flat(images)
    emulation = Emulation(compile_spec(spec))
    length = min(spec.presentation.stream_length, len(images))
    steps, gap = spec.presentation.steps, spec.presentation.gap

    def streams(n):
        repeated = images[np.arange(n * length) % len(images)]
        return repeated.reshape(n, length, *images.shape[1:])

    def lasting(streams, n):
        return streams if static else _lasting(streams, n)

    base = streams(max(1, len(images) // length))
    return {
        "samples": [
            {"samples": n * length, "seconds": _best(emulation, streams(n), steps, gap)}
            for n in (1, 5, 20, 100)
        ],
        "steps": [
            {"steps": n, "seconds": _best(emulation, lasting(base, n), n, gap)}
            for n in (25, 50, 100, 200, 400)
        ],
        "brightness": [
            {
                "brightness": factor,
                "chip_hz": _chip_rate(spec, emulation, factor * base),
                "seconds": _best(emulation, factor * base, steps, gap),
            }
            for factor in ((0.0, 0.5, 1.0, 2.0) if static else (0, 1))
        ],
    }


def _lasting(streams, steps):
    """Streams of frames, extended to a number of steps without events."""
    frames = streams[:, :, :steps]
    silent = np.zeros((*frames.shape[:2], steps - frames.shape[2], frames.shape[3]), frames.dtype)
    return np.concatenate([frames, silent], 2)


def _best(emulation, streams, steps, gap, repeats=3):
    seconds = []
    for _ in range(repeats):
        begun = time.perf_counter()
        emulation.run(streams, steps, gap)
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


def _chip_rate(spec, emulation, streams):
    counts = emulation.run(streams, spec.presentation.steps, spec.presentation.gap).counts
    on_chip = [counts[layer.label] for layer in emulation.program.network.layers]
    return mean_rate(spec, np.concatenate([c.reshape(-1) for c in on_chip]))


def limits(spec: NetworkSpec, images) -> dict:
    """Operations per second of the kernel with Numba, and the limits of this machine.

    The chip's cost has two parts: updating every compartment at every step, measured on a network
    without spikes, and delivering spikes, the rest.  A synaptic operation reads a weight and a
    total and writes the total.  The machine's maximum rate of such operations is measured by adding
    one vector to another in its fastest cache, and by adding vectors from its main memory.

    Returns
    -------
    dict
        Operations per second, and shares.
    """
    from deploy.targets.fast import kernel_numba  # Numba need not be installed

    images = spec.stimulus.flat(images)
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
    wires = wiring(network)
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
    """A kernel that records its input."""

    def __init__(self, kernel, kept):
        self.kernel, self.kept = kernel, kept
        self.bytes_per_spike = kernel.bytes_per_spike

    def advance(self, state, inputs):
        self.kept.append(inputs.copy())
        return self.kernel.advance(state, inputs)


def _adds(dtype, length):
    """Additions per second of one vector to another, of ``length`` numbers each."""
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


def growth_text(growth: dict) -> list:
    """The result of :func:`growth`, as lines."""

    def listed(name, unit):
        return ", ".join(f"{row[name]:g}{unit} {1e3 * row['seconds']:.0f}" for row in growth[name])

    brightness = ", ".join(
        f"{row['chip_hz']:.0f} Hz {1e3 * row['seconds']:.0f}" for row in growth["brightness"]
    )
    return [
        "milliseconds for",
        f"  samples: {listed('samples', '')}",
        f"  steps a sample: {listed('steps', '')}",
        f"  mean rate on the chip: {brightness}",
    ]


def limits_text(limits: dict) -> list:
    """The result of :func:`limits`, as lines."""

    return [
        f"chip: {limits['compartment_updates_per_second'] / 1e9:.2f} G compartment updates and "
        f"{limits['synaptic_operations_per_second'] / 1e9:.2f} G synaptic operations a second; "
        f"updates take {limits['share_of_time_updating']:.0%} of the time",
        f"limit: this machine adds {limits['adds_per_second_in_cache'] / 1e9:.0f} G weights of "
        f"{limits['weight_bits']} bits a second in its first cache and "
        f"{limits['adds_per_second_from_memory'] / 1e9:.1f} G from memory;",
        "  delivering spikes, padding included, adds "
        f"{limits['weights_added_per_second'] / 1e9:.1f} G, "
        f"{limits['share_of_cache_limit']:.0%} of the first",
    ]


def main(
    bundle: options.Bundle = Path("runs/default/bundle"),
    samples: Annotated[
        Optional[int],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(help="Use only the first samples of the bundle's check.", min=1),
    ] = None,
    as_json: options.Json = False,
):
    """Measure how the time of the target fast grows, and what limits its kernel with Numba."""
    opened = read_bundle(options.bundle_in(bundle))
    images = opened.checks.inputs[:samples]
    with progress("growth and limits", 2) as advance:
        measured = {"growth": growth(opened.spec, images)}
        advance()
        if "numba" in kernels_here():
            measured["limits"] = limits(opened.spec, images)
        advance()
    lines = growth_text(measured["growth"])
    lines += limits_text(measured["limits"]) if "limits" in measured else []
    options.tell(measured, lambda _: "\n".join(lines), as_json)


if __name__ == "__main__":
    run_tool(main)
