"""``stmnist check``: the 200-sample check."""

import contextlib
from dataclasses import field, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from deploy import limits
from deploy.errors import UserError
from deploy.targets.options import format_flag
from deploy.targets.registry import TARGETS, list_options, select_options
from deploy.terminal import WARNING
from pipeline.commands import options
from pipeline.results.check_on_others import OtherRecordings, check_on_others
from pipeline.storage.run_folder import find_checks_folder


def _annotate_option(target, option):
    """The annotation from which Typer makes an option of a target."""
    kind = str | None if option.default is None else type(option.default)
    names = (format_flag(option.name),) if kind is bool else ()  # without --no-...
    return Annotated[
        kind,
        typer.Option(*names, help=option.metadata["help"], rich_help_panel=f"Target {target}"),
    ]


def _make_target_options() -> options.Group:
    """``--target``, and the options of all targets that are registered now."""
    options_of_targets = list_options()
    entries = [
        (name, option.type, field(default=option.default))
        for name, (_, option) in options_of_targets.items()
    ]
    names = ", ".join(TARGETS)
    return options.group_options(
        make_dataclass("TargetRequested", [("target", str), *entries]),
        target=Annotated[str, typer.Option(help=f"One of {names}.")],
        **{name: _annotate_option(*owned) for name, owned in options_of_targets.items()},
    )


Others = Annotated[
    OtherRecordings,
    options.group_options(
        OtherRecordings,
        data=Annotated[
            str | None,
            typer.Option(
                help="Other recordings, zip or folder, instead of the bundle's samples; sensor "
                "and classes must be the same."
            ),
        ],
        samples=Annotated[
            int | None,
            typer.Option(
                help="With --data: recordings drawn at random; 0 for all (default: 200 at most).",
                min=0,
                max=limits.SAMPLES,
            ),
        ],
        skip_bad=Annotated[
            bool,
            typer.Option("--skip-bad", help="With --data: leave out files that cannot be read."),
        ],
        time_unit=options.TimeUnit,
        jobs=options.Jobs,
    ),
]


Out = Annotated[
    Path | None,
    typer.Option(
        help="The result, .json (default: checks/TARGET.json in the run, or in a bundle that has "
        "none)."
    ),
]

SimulatorSeed = Annotated[
    int | None,
    typer.Option(help="Seed given to the simulator (default: that of the bundle's run)."),
]

Faults = Annotated[
    list[str] | None,
    typer.Option(
        help="Faulty taxels at random places in each sample, such as hot=1 (a spike of each "
        "polarity every 80 ms) or hot=1,dead=5; the result gets a file of its own.",
    ),
]


def run(  # noqa: PLR0913 - each is an option of the command
    bundle: options.Bundle,
    target_requested: Annotated[Any, _make_target_options],
    out: Out = None,
    seed: SimulatorSeed = None,
    fault: Faults = None,
    *,
    others: Others,
    as_json: options.Json = False,
):
    """Run a target on the bundle's samples; an interrupted check continues where it stopped."""
    from deploy.check.bundle import read_bundle
    from deploy.check.text import format_result, format_result_on_others
    from deploy.files import require_ending
    from pipeline.results.check_with_faults import parse_faults
    from pipeline.workflow.target_check import TargetCheck

    values = dict(vars(target_requested))
    target = values.pop("target")
    target_options = select_options(target, **values)
    if out is not None:
        require_ending(out, ".json")
    _require_data(others)
    faults = parse_faults(fault) if fault else None
    folder = options.find_bundle(bundle)
    deployed = read_bundle(folder)
    options.warn_if_outdated(folder)
    check = TargetCheck(target, deployed.seed if seed is None else seed, target_options)
    as_text = format_result
    if others.data is not None:
        as_text = format_result_on_others
        result, path = check_on_others(deployed, others, check, options.say, faults, out)
    elif faults is not None:
        result, path = _check_with_faults(deployed, faults, others.jobs, check, out)
    else:
        result, path = _check_own_samples(deployed, check, out)
    text = f"{as_text(result)}\nwritten to {path}"
    options.print_result(result.to_dict(), lambda _: text, as_json)
    if others.data is None and faults is None:
        _say_loss(deployed, result)


def _find_result_path(bundle, check):
    return find_checks_folder(bundle.path) / f"{check.target}.json"


def _check_own_samples(bundle, check, out) -> tuple:
    """Run the check on the bundle's samples; say if the network was fitted to some of them.

    Returns
    -------
    result : CheckResult
    path : Path
        The file of the result.
    """
    from deploy.check.results import write_result

    path = out or _find_result_path(bundle, check)
    result = check.run(bundle, path)
    if number := _count_samples_of_fit(bundle.spec):
        options.say(
            f"{WARNING}{bundle.path}: was fitted to {number} of the {len(bundle.checks)} samples "
            "of its check; its accuracy on them says little about others"
        )
        result = replace(result, trained_on=number)
        write_result(path, result)
    return result, path


def _require_data(others):
    """Refuse options that are about other recordings where there are none."""
    if others.data is not None:
        return
    if others.skip_bad:
        raise UserError("--skip-bad: needs other recordings; give them with --data FILE")
    if others.samples is not None:
        raise UserError("--samples: needs other recordings; give them with --data FILE")


def _count_samples_of_fit(spec):
    """Number of the check's samples that an adapted network was fitted to."""
    adapted = spec.provenance.adapted
    number = adapted.get("in_check") if isinstance(adapted, dict) else None
    return number if type(number) is int else 0


def _say_loss(bundle, result):
    """Say what the target loses relative to the network before it, if its predictions exist."""
    from deploy.check.comparison import describe_loss
    from deploy.check.results import read_result
    from pipeline.kinds.registry import list_compared_stages

    for stage in list_compared_stages():
        with contextlib.suppress(UserError):  # missing or damaged: no comparison
            reference = read_result(find_checks_folder(bundle.path) / f"{stage}.json")
            if reference.bundle_id == bundle.id:
                loss = describe_loss(reference, result)
                if loss is not None:
                    options.say(f"check: {loss}")
                return


def _check_with_faults(bundle, counts, jobs, check, out) -> tuple:
    """Run the check with faulty taxels in its samples; see :func:`_check_own_samples`."""
    from pipeline.results import check_with_faults

    path = out or check_with_faults.find_fault_path(_find_result_path(bundle, check), counts)
    recordings, image = check_with_faults.read_check_recordings(bundle, jobs, options.say)
    presented = check_with_faults.add_faults_to_check(bundle, recordings, counts, image)
    result = check_with_faults.add_fault_note(check.run(presented, path), path, counts)
    return result, path


def compare_checks(
    a: Annotated[Path, typer.Argument(help="A check result (JSON).")],
    b: Annotated[Path, typer.Argument(help="Another result of the same bundle.")],
    max_disagreements: Annotated[
        int | None, typer.Option(help="Exit with status 1 if more predictions differ.", min=0)
    ] = None,
    max_accuracy_drop: Annotated[
        float | None,
        typer.Option(help="Exit with status 1 if B is less accurate by more (0.01).", min=0, max=1),
    ] = None,
    as_json: options.Json = False,
):
    """Compare two results: agreement, McNemar's test, the first samples that differ."""
    from deploy.check.comparison import compare_results, enforce_limits
    from deploy.check.results import read_result
    from deploy.check.text import format_comparison

    comparison = compare_results(read_result(a), read_result(b))
    options.warn_if_outdated(a, b)
    options.print_result(comparison.to_json(), lambda _: format_comparison(comparison), as_json)
    enforce_limits(comparison, max_disagreements, max_accuracy_drop)
