"""``stmnist benchmark emulator``: the speed of the target ``fast``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy.check.bundle import read_bundle
from deploy.errors import CheckFailed
from pipeline.commands import options
from pipeline.commands.benchmark import app
from pipeline.experiments import emulator_limits
from pipeline.experiments.emulator_speed import compare
from pipeline.progress import progress


@app.command()
def emulator(
    bundle: Annotated[Path, typer.Argument(help="The bundle's folder.")] = Path(
        "runs/default/bundle"
    ),
    samples: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Use only the first samples of the bundle's check.", min=1),
    ] = None,
    compare_only: Annotated[
        bool, typer.Option("--compare-only", help="Leave out how the cost grows and its limit.")
    ] = False,
    as_json: options.Json = False,
):
    """Time NengoLoihi's emulator and the target fast in turns, on a bundle's samples.

    Checks that both give the same spikes; exit status 1 if not.
    """
    opened = read_bundle(bundle)
    images = opened.checks.images[:samples]
    with progress("benchmark", len(images)) as advance:
        result = compare(opened.spec, images, advance)
    result["simulated"] = opened.spec.provenance.get("simulated")
    if not compare_only:
        with progress("growth and limit", 2) as advance:
            result["growth"] = emulator_limits.growth(opened.spec, images)
            advance()
            if result["kernel"] == "numba":
                result["limits"] = emulator_limits.limits(opened.spec, images)
            advance()
    print(json.dumps(result, indent=2) if as_json else as_text(result))
    if not result["identical"]:
        raise CheckFailed("the target fast and NengoLoihi's emulator do not give the same spikes")


def as_text(result: dict) -> str:
    """The result as a table and a few lines."""
    kind = "simulated samples" if result["simulated"] else "samples"
    verdict = (
        "every spike at every step, predictions, outputs within 1e-9"
        if result["identical"]
        else "NO: the answers differ"
    )
    lines = [
        f"{result['n_samples']} {kind} of {result['gap_per_sample']} blank and "
        f"{result['steps_per_sample']} shown steps, one thread, medians of {result['turns']} turns",
        f"identical: {verdict}",
        f"{'':<22}{'samples/s':>10}{'whole':>9}{'chip':>9}{'whole, CPU':>12}{'chip, CPU':>11}",
        _row("NengoLoihi's emulator", result["reference_samples_per_second"], [1, 1, 1, 1]),
    ]
    for name, suffix in (("numba", ""), ("numpy", "_numpy")):
        if name == "numpy" or result["kernel"] == name:
            ratios = [
                times[f"ratio_{part}{suffix}"]
                for times in (result, result["processor_time"])
                for part in ("whole", "chip")
            ]
            lines.append(_row(f"fast, {name}", result["samples_per_second" + suffix], ratios))
    rates = ", ".join(f"{name} {rate:.0f}" for name, rate in result["mean_rates_hz"].items())
    lines.append(f"mean rates in Hz: {rates}")
    lines += _growth(result["growth"]) if "growth" in result else []
    lines += _limits(result["limits"]) if "limits" in result else []
    return "\n".join(lines)


def _row(name, pace, ratios):
    whole, chip, whole_cpu, chip_cpu = (f"{ratio:.0f}x" for ratio in ratios)
    return f"{name:<22}{pace:>10.0f}{whole:>9}{chip:>9}{whole_cpu:>12}{chip_cpu:>11}"


def _growth(growth):
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


def _limits(limits):
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
