"""``stmnist benchmark conversion``: what the choices that the paper leaves open cost."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import CheckFailed
from deploy.files import write_json
from pipeline import conversion_choices as choices
from pipeline.commands import options
from pipeline.commands.benchmark import app
from pipeline.parallel import Failure, run_jobs
from pipeline.progress import progress
from pipeline.run_folder import RunFolder, read_stamped, stamp_of
from pipeline.sources import load_recordings

TOGETHER = 5
"""Splits of a job at most, as in the benchmark of Table 2."""


@app.command("conversion")
def conversion(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; splits that are there are not run again.")
    ] = Path("runs/conversion"),
    splits: Annotated[int, typer.Option(help="Random splits.", min=1)] = 10,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Run the paper's networks under presentations, readouts and rates that it leaves open.

    Tells what could have cost the paper 2 points from CNN to spiking network and 3 to Loihi.  Goes
    on where it was interrupted.
    """
    folder = RunFolder(out)
    with folder.locked():
        resolved = options.resolve(folder, data, None, None, None, settings, set_)
        chosen = resolved.data
        recordings = load_recordings(
            chosen.source, chosen.simulation_seed, chosen.samples_per_digit, chosen.skip_bad, jobs
        )
        rows = [asdict(choice) for choice in choices.CHOICES]
        stamp = stamp_of(recordings.source.sha256, asdict(resolved), rows)
        results = {seed: read_stamped(_path(out, seed), stamp) for seed in range(splits)}
        missing = [seed for seed, result in results.items() if result is None]
        size = min(TOGETHER, -(-len(missing) // jobs)) or 1
        todo = [
            choices.Job(resolved, tuple(missing[start : start + size]))
            for start in range(0, len(missing), size)
        ]
        with progress("splits", len(missing)) as advance:
            for job, done in run_jobs(choices.measure, todo, jobs):
                if isinstance(done, Failure):
                    print(done.details, file=sys.stderr)
                else:
                    for result in done:
                        results[result["seed"]] = result
                        write_json(_path(out, result["seed"]), {"made_from": stamp, **result})
                advance(len(job.seeds))
        whole = [result for result in results.values() if result is not None]
        if not whole:
            raise CheckFailed("every split failed; see above")
        summary = choices.summarise(whole, recordings.source.simulated)
        summary["source_sha256"] = recordings.source.sha256
        write_json(out / "conversion.json", summary)
    print(json.dumps(summary, indent=2) if as_json else choices.choices_text(summary))
    if len(whole) < splits:
        failed = [seed for seed, result in results.items() if result is None]
        raise CheckFailed(f"splits {failed} failed; the same command tries them again")


def _path(out, seed):
    return out / f"split-{seed:02d}.json"
