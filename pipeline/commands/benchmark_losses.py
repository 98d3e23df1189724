"""``stmnist benchmark losses``: what conversion and chip cost, over seeds."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import CheckFailed
from deploy.files import write_json
from pipeline import losses
from pipeline.commands import options
from pipeline.commands.benchmark import app
from pipeline.parallel import Failure, run_jobs
from pipeline.progress import progress
from pipeline.run_folder import RunFolder, read_stamped, stamp_of
from pipeline.sources import load_recordings


@app.command("losses")
def losses_(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; seeds that are there are not run again.")
    ] = Path("runs/losses"),
    seeds: Annotated[int, typer.Option(help="Seeds, from 0 on.", min=1)] = 10,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Measure what is lost from the CNN to the chip: whole test split, several seeds.

    The chip is the target fast, at 100 and at 50 steps.  Goes on where it was interrupted.
    """
    folder = RunFolder(out)
    with folder.locked():
        resolved = options.resolve(folder, data, None, None, None, settings, set_)
        chosen = resolved.data
        recordings = load_recordings(
            chosen.source, chosen.simulation_seed, chosen.samples_per_digit, chosen.skip_bad, jobs
        )
        stamp = stamp_of(recordings.source.sha256, asdict(resolved))
        results = {seed: read_stamped(_path(out, seed), stamp) for seed in range(seeds)}
        todo = [losses.Job(resolved, seed) for seed, result in results.items() if result is None]
        with progress("losses", len(todo)) as advance:
            for job, result in run_jobs(losses.measure, todo, jobs):
                if isinstance(result, Failure):
                    print(result.details, file=sys.stderr)
                else:
                    results[job.seed] = result
                    write_json(_path(out, job.seed), {"made_from": stamp, **result})
                advance(1)
        failed = [seed for seed, result in results.items() if result is None]
        if len(failed) == len(results):
            raise CheckFailed("every seed failed; see above")
        whole = [result for result in results.values() if result is not None]
        summary = losses.summarise(whole, recordings.source.simulated)
        write_json(out / "losses.json", summary)
    print(json.dumps(summary, indent=2) if as_json else losses.losses_text(summary))
    if failed:
        raise CheckFailed(f"seeds {failed} failed; the same command tries them again")


def _path(out, seed):
    return out / f"seed-{seed:02d}.json"
