"""``stmnist sweep``: a grid of settings, judged on validation samples."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy.errors import CheckFailed
from deploy.files import read_json, replacing, write_json
from pipeline.commands import options
from pipeline.experiments import sweep
from pipeline.experiments.jobs import Failure, run_jobs
from pipeline.experiments.sweep_text import sweep_csv, sweep_text
from pipeline.progress import progress
from pipeline.run.folder import RunFolder


def sweep_(
    out: Annotated[Path, typer.Argument(help="The sweep's folder, such as runs/sweep.")],
    grid: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            help="Values of a setting, such as presentation.steps=50,100 or "
            "snn.max_rates=[100,150],[150,150]; repeatable, all combinations are tried "
            f"(default: {' '.join(sweep.DEFAULT_GRID)}).",
        ),
    ] = None,
    data: options.Data = None,
    seed: options.Seed = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Compare settings by accuracy, synaptic operations and steps, on a validation part.

    Writes sweep.json, sweep.csv and pareto.png.  Points that are there are not computed again.
    """
    folder = RunFolder(out)
    with folder.locked():
        base = sweep.base_settings(options.resolve(folder, data, seed, None, None, settings, set_))
        sweep.dataset_of(base, jobs, _say)
        points = sweep.points_of(out, base, grid or sweep.DEFAULT_GRID)
        folder.save_settings(base)
        results, errors = _compute(points, jobs)
        summary = sweep.summarise(points, results, errors)
        write_json(out / "sweep.json", summary)
        with replacing(out / "sweep.csv", "w") as file:
            file.write(sweep_csv(summary))
        if summary["points"]:
            from pipeline.report.pareto import pareto  # imports Matplotlib

            with replacing(out / "pareto.png") as file:
                pareto(summary).savefig(file, format="png", dpi=120)
    print(json.dumps(summary, indent=2) if as_json else sweep_text(summary))
    if errors:
        raise CheckFailed(
            f"{len(errors)} of {len(points)} points failed; the same command tries them again"
        )


def _compute(points, jobs):
    """Results and errors by stamp: trainings that points share first, then the points."""
    results = {point.stamp: _read(point) for point in points}
    results = {stamp: result for stamp, result in results.items() if result is not None}
    errors: dict = {}

    def todo(key):
        """A point for each value of ``key`` that is still needed."""
        rest = (p for p in points if p.stamp not in results and p.stamp not in errors)
        return list({key(point): point for point in rest}.values())

    def run(label, function, key, keep):
        waiting = todo(key)
        with progress(label, len(waiting)) as advance:
            for point, result in run_jobs(function, waiting, jobs):
                if isinstance(result, Failure):
                    print(result.details, file=sys.stderr)
                    alike = (p for p in points if key(p) == key(point))
                    errors.update({p.stamp: result.error for p in alike})
                else:
                    keep(point, result)
                advance(1)

    def keep(point, result):
        write_json(point.result, result)
        results[point.stamp] = result

    run("train cnn", sweep.train_cnn, lambda p: p.cnn, lambda *_: None)
    run("train rate-lif", sweep.train_rates, lambda p: p.snn, lambda *_: None)
    run("judge", sweep.judge, lambda p: p.stamp, keep)
    return results, errors


def _read(point):
    """A point's result, if it is there."""
    if not point.result.exists():
        return None
    result = read_json(point.result, "delete it and run the sweep again")
    return result if result.get("made_from") == point.stamp else None


def _say(line):
    print(line, file=sys.stderr)
