"""``stmnist benchmark``: the paper's Table 2, and the speed of training."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy.errors import CheckFailed, UserError
from deploy.files import write_json
from pipeline.commands import options
from pipeline.experiments import table2
from pipeline.experiments.jobs import Failure, run_jobs
from pipeline.experiments.table2_summary import summarise, table_text
from pipeline.inputs.library import load_recordings, recordings_of
from pipeline.progress import progress
from pipeline.run.folder import RunFolder
from pipeline.settings import Settings

app = typer.Typer(help="The paper's Table 2, and speed.", no_args_is_help=True)

WITHOUT_SLAYER = tuple(name for name in table2.MODELS if name != "slayer")


@app.command("table2")
def table2_(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; splits that are there are not run again.")
    ] = Path("runs/table2"),
    splits: Annotated[int, typer.Option(help="Splits of each kind.", min=1)] = 10,
    models: Annotated[
        str,
        typer.Option(
            help=f"Rows, separated by commas: {', '.join(table2.MODELS)}. Left out by default "
            "is slayer, which takes some forty minutes a split."
        ),
    ] = ",".join(WITHOUT_SLAYER),
    kind: Annotated[
        str,
        typer.Option(
            help="Splits: random (the paper's), writers (nobody in both training and test), or "
            "both; by default both where the writers are known."
        ),
    ] = "",
    data: options.Data = None,
    seed: options.Seed = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    scheduler: Annotated[
        Optional[str],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(help="Address of a Dask scheduler whose workers run the splits, one a job."),
    ] = None,
    as_json: options.Json = False,
):
    """Run the paper's Table 2: mean (SD) over splits, beside the paper's figures.

    Goes on where it was interrupted.  A split that fails is reported and its row is of the others;
    exit status 1.
    """
    names = _names(models)
    folder = RunFolder(out)
    with folder.locked():
        resolved = options.resolve(folder, data, seed, None, None, settings, set_)
        recordings = recordings_of(resolved.data, jobs)
        kinds = _kinds(kind, recordings)
        try:
            for each in kinds:
                test = table2.split_of(recordings, resolved, each, resolved.seed).test
                table2.draw_check_samples(test, resolved.check.samples, resolved.seed)
        except ValueError as error:
            raise UserError(
                f"{resolved.data.source}: {error}; change --kind, check.samples or the data"
            ) from error
        folder.save_settings(resolved)
        benchmark = table2.Benchmark(
            resolved, recordings.source.sha256, out.absolute(), kinds, splits, names
        )
        todo = table2.plan(benchmark, splits if scheduler else jobs)
        failures = []
        with progress("table 2", sum(len(job.indices) for job in todo)) as advance:
            for job, result in run_jobs(table2.run, todo, jobs, scheduler):
                if not isinstance(result, Failure) and not table2.of_this_version(job, result):
                    message = "the worker has another version of this package"
                    result = Failure(message, message)
                if isinstance(result, Failure):
                    failures.append((job, result))
                    print(result.details, file=sys.stderr)
                else:
                    table2.write_splits(job, result)
                advance(len(job.indices), f"{job.kind} splits")
        table = summarise(benchmark, failures)
        write_json(out / "table2.json", table)
    print(json.dumps(table, indent=2) if as_json else table_text(table))
    if failures:
        raise CheckFailed(
            f"{len(failures)} of {len(todo)} jobs failed; the same command tries them again"
        )


@app.command()
def training(
    networks: Annotated[int, typer.Option(help="Networks to train.", min=1)] = 5,
    rounds: Annotated[int, typer.Option(help="Epochs that are timed.", min=1)] = 3,
    samples: Annotated[
        int, typer.Option(help="Simulated recordings of each digit; 0 for 6,953 in all.", min=0)
    ] = 0,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Time the training of the rate-based network: NengoDL's fit, Keras's, several at once."""
    from pipeline.experiments.training_speed import WAYS, measure, speed_text
    from pipeline.inputs.images import tactile_images

    settings = Settings()
    recordings = load_recordings(samples_per_digit=samples, jobs=jobs)
    split = table2.split_of(recordings, settings, "random", settings.seed)
    images = tactile_images(recordings, settings.image.aggregation, settings.image.normalisation)
    data = images[split.train], recordings.labels[split.train]
    with progress("training speed", len(WAYS) * (rounds + 1)) as advance:
        result = measure(settings, data, networks, rounds, advance)
    print(json.dumps(result, indent=2) if as_json else speed_text(result))


def _names(models):
    names = tuple(dict.fromkeys(name.strip() for name in models.split(",") if name.strip()))
    unknown = [name for name in names if name not in table2.MODELS]
    if unknown or not names:
        raise UserError(
            f"--models {models!r}: no model {(unknown or [''])[0]!r}; "
            f"the models are {', '.join(table2.MODELS)}"
        )
    return tuple(name for name in table2.MODELS if name in names)


def _kinds(kind, recordings):
    known = recordings.writers.min(initial=0) >= 0
    if kind in ("random", "writers"):
        return (kind,)
    if kind == "both" or (kind == "" and known):
        return table2.KINDS
    if kind == "":
        return ("random",)
    raise UserError(f"--kind {kind!r}: must be random, writers or both")
