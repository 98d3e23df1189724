"""``stmnist sweep``: a grid of settings, compared on validation samples."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import options


def sweep(
    out: Annotated[Path, typer.Argument(help="Folder of the sweep, such as runs/sweep.")],
    grid: Annotated[
        list[str] | None,
        typer.Option(
            help="Values of a setting, such as cnn.epochs=5,10 or "
            "snn.max_rates=100,150; repeatable, all combinations are tried "
            "(default: 16 combinations of steps, synapse, rates and penalty, on events four of "
            "budget and early; see docs/training.md)."
        ),
    ] = None,
    *,
    requested: options.TrainingRequested,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Compare settings by accuracy, synaptic operations, cores and steps, on held-out samples.

    Writes sweep.json.  Existing points are not computed again.
    """
    from pipeline.results.sweep import format_sweep, measure_sweep

    with options.lock_and_resolve_settings(out, requested, of_results=True) as (folder, resolved):
        summary, failed = measure_sweep(folder, resolved, grid, workers, options.say)
    options.print_summary(summary, failed, format_sweep, as_json)
