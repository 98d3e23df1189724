"""``stmnist status``, ``compare``, ``report`` and ``animate``: what runs have, for people."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import require_ending
from pipeline.commands import options
from pipeline.storage.run_folder import RunFolder


def status(run: options.Run, as_json: options.Json = False):
    """Show each artifact of a run: current, outdated and why, or missing.

    Nothing is made or changed.
    """
    from pipeline.kinds.registry import find_kind
    from pipeline.results.status import explain_unread, format_status, list_states
    from pipeline.settings import read_settings
    from pipeline.storage.artifacts import OUTDATED

    folder = RunFolder(run)
    statuses = list_states(folder, adapted=True)
    options.print_result(
        {"run": str(run), "artifacts": [status.to_json() for status in statuses]},
        lambda _: format_status(folder, statuses),
        as_json,
        marked=OUTDATED,
    )
    settings = read_settings(folder.experiment)
    if (note := explain_unread(settings)) is not None:
        options.say(note)
    imported = find_kind(settings).imported
    for note in imported.list_warnings() if imported is not None else ():
        options.say(note)


def compare_(
    runs: Annotated[list[Path], typer.Argument(help="Folders of two or more runs.")],
    as_json: options.Json = False,
):
    """Compare runs: settings, accuracy of each stage, operations, cores, time to decide.

    Every run is compared with the first one.  If both have the same samples, the comparison is
    paired, with McNemar's test.
    """
    from pipeline.results.compare import compare_runs, format_runs, read_runs

    options.print_result(compare_runs(read_runs(runs)), format_runs, as_json)


def report(
    run: options.Run,
    out: Annotated[
        Path | None,
        typer.Option(help="The file to write (default: report.html in the run's folder)."),
    ] = None,
):
    """Write a run's ladder as one self-contained HTML file."""
    from pipeline.results.report import write_report

    path = write_report(run, out)
    options.say(f"report: {path} ({path.stat().st_size // 1024} KiB)")
    options.suggest("live", run)


def animate(
    run: options.Run,
    out: Annotated[Path, typer.Option(help="The file to write: .gif.")],
    sample: Annotated[
        str, typer.Option(help="Id of a sample of the check (default: one of usual activity).")
    ] = "",
):
    """Write an animation of a sample: touch, spikes and probabilities over time."""
    from deploy.check.bundle import read_bundle
    from pipeline.progress import progress
    from pipeline.results.report.figures import animation

    require_ending(out, ".gif")  # reports a wrong ending of the name before anything is computed
    bundle = read_bundle(options.find_bundle(run))
    options.warn_if_outdated(options.find_bundle(run))
    ids = list(bundle.checks.ids)
    if sample and sample not in ids:
        raise UserError(f"{run}: no sample {sample!r} in its check; ids are like {ids[0]!r}")
    activity = bundle.checks.inputs.reshape(len(ids), -1).sum(1, dtype=float)
    index = ids.index(sample) if sample else int(activity.argsort(kind="stable")[len(ids) // 2])
    with progress("animate", animation.FRAMES, "frames") as advance:
        animation.animate(out, bundle, index, advance)
    options.say(f"animation: {out}")
