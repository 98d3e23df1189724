"""``stmnist deploy``: pre-flight, exports, and the estimate of energy."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import require_ending
from deploy.terminal import format_command, show
from pipeline.commands import options
from pipeline.storage.run_folder import find_checks_folder


class Format(StrEnum):
    """Formats to which a bundle can be exported."""

    nir = "nir"


def plan(
    bundle: options.Bundle,
    chips: Annotated[int, typer.Option(help="Largest number of chips to use.", min=1)] = 1,
    as_json: options.Json = False,
):
    """Print the resources that the network needs on each core; exit status 2 if it does not fit."""
    from deploy.preflight.plan import format_plan, make_plan

    placement = make_plan(_read_bundle(bundle).spec, chips)
    options.print_result(placement.to_json(), lambda _: format_plan(placement), as_json)
    if placement.problems:
        raise UserError("the network does not fit: " + placement.problems[0])


def export(
    bundle: options.Bundle,
    out: Annotated[Path, typer.Option(help="The file to write, .nir.")],
    format: Annotated[Format, typer.Option(help="Format of the exported network.")] = Format.nir,
    inputs: Annotated[
        Path | None,
        typer.Option(help="Also write the input spikes of the check's samples, as .npz."),
    ] = None,
):
    """Export the network for other neuromorphic platforms."""
    from deploy.files import write_arrays
    from deploy.network.nir import make_graph_input, write_nir
    from pipeline.settings import Settings

    require_ending(out, ".nir")
    if inputs is not None:
        require_ending(inputs, ".npz")
    opened = _read_bundle(bundle)
    write_nir(out, opened.spec)
    show(f"written to {out}")
    if not (stimulus := opened.spec.stimulus).is_static:
        step = 1000 * stimulus.step_seconds
        silent = 1000 * stimulus.step_seconds * stimulus.refractory
        show(f"convert with --step {step:g} --set input.refractory={silent:g} for the same input")
    elif opened.spec.input_shape[-1] > 1:
        names = ", ".join(name for name in Settings().flatten() if name.startswith("image."))
        show(f"convert with --input image and the run's settings for the same input: {names}")
    if inputs is not None:
        checks = opened.checks
        write_arrays(
            inputs, spikes=make_graph_input(opened.spec, checks.inputs), labels=checks.labels
        )
        show(f"input spikes of {len(checks)} samples written to {inputs}")


def energy(
    bundle: options.Bundle,
    result: Annotated[
        Path | None,
        typer.Argument(help="Check result (default: the bundle's own, of emulator or fast)."),
    ] = None,
    as_json: options.Json = False,
):
    """Estimate the energy of an inference from the spikes that a check counted."""
    from deploy.check.energy import estimate_energy, format_estimate
    from deploy.check.results import read_result
    from deploy.targets.registry import list_exact_targets

    opened = _read_bundle(bundle)
    exact = list_exact_targets()
    remedy = f"run {format_command('check', 'run', bundle, '--target', exact[-1])}"
    if result is not None:
        paths = [result]
        results = [read_result(result, "give a check's result")]
    else:
        files = [find_checks_folder(opened.path) / f"{target}.json" for target in exact]
        paths = [path for path in files if path.exists()] or files[-1:]
        results = [read_result(path, remedy) for path in paths]
    counted = next((each for each in results if each.bundle_id == opened.id), None)
    if counted is None:
        raise UserError(f"{paths[-1]}: belongs to another bundle than {bundle}; {remedy}")
    value = estimate_energy(opened.spec, counted)
    options.print_result(value.to_json(), lambda _: format_estimate(value), as_json)


def _read_bundle(path):
    """The bundle of a command, with a warning if it is outdated."""
    from deploy.check.bundle import read_bundle

    bundle = read_bundle(options.find_bundle(path))
    options.warn_if_outdated(bundle.path)
    return bundle
