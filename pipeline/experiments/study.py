"""A measurement repeated over random splits, one seed each: what several benchmarks do."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from deploy import __version__
from deploy.errors import CheckFailed
from deploy.files import write_json
from pipeline.experiments.jobs import Failure, run_jobs
from pipeline.inputs.library import recordings_of
from pipeline.progress import progress
from pipeline.run.folder import RunFolder, read_stamped, stamp_of
from pipeline.settings import Settings


@dataclass(frozen=True)
class Job:
    """A split to measure.

    Attributes
    ----------
    settings : Settings
    seed : int
        Of the split and its trainings.
    """

    settings: Settings
    seed: int


@dataclass(frozen=True)
class Measurement:
    """What is measured, and how it is told.

    Attributes
    ----------
    name : str
        Of the summary's file.
    measure : callable
        From a :class:`Job` to a dict.
    summarise : callable
        From those dicts and whether the recordings are simulated to a dict.
    text : callable
        From that to a table.
    depends_on : tuple
        Plain values that the results depend on besides recordings and settings.
    check : callable, optional
        Called with the settings before anything is done.
    """

    name: str
    measure: Callable
    summarise: Callable
    text: Callable
    depends_on: tuple = ()
    check: Callable | None = None


def run(measurement: Measurement, out: Path, splits, resolve, jobs, as_json):
    """Measure the splits that are not there yet, write and print the summary.

    Parameters
    ----------
    measurement : Measurement
    out : Path
        Folder of the results.
    splits : int
        How many, from the settings' own seed on.
    resolve : callable
        From the folder to its settings.
    jobs : int
        Processes.
    as_json : bool

    Raises
    ------
    UserError
        The settings do not fit the measurement, or the recordings cannot be read.
    CheckFailed
        A split failed; those that did not are kept, and summarised.
    """
    folder = RunFolder(out)
    with folder.locked():
        resolved = resolve(folder)
        if measurement.check is not None:
            measurement.check(resolved)
        recordings = recordings_of(resolved.data, jobs)
        folder.save_settings(resolved)
        stamp = stamp_of(
            __version__, recordings.source.sha256, asdict(resolved), *measurement.depends_on
        )
        seeds = range(resolved.seed, resolved.seed + splits)
        results = _results(measurement, resolved, out, seeds, stamp, jobs)
        whole = [result for result in results.values() if result is not None]
        if not whole:
            raise CheckFailed("every split failed; see above")
        summary = measurement.summarise(whole, recordings.source.simulated)
        summary["source_sha256"] = recordings.source.sha256
        write_json(out / f"{measurement.name}.json", summary)
    print(json.dumps(summary, indent=2) if as_json else measurement.text(summary))
    failed = [seed for seed, result in results.items() if result is None]
    if failed:
        raise CheckFailed(f"splits {failed} failed; the same command tries them again")


def _results(measurement, settings, out, seeds, stamp, jobs):
    """The result of each seed, or None where it failed."""
    paths = {seed: out / f"split-{seed:02d}.json" for seed in seeds}
    results = {seed: read_stamped(path, stamp) for seed, path in paths.items()}
    todo = [Job(settings, seed) for seed, result in results.items() if result is None]
    with progress(measurement.name, len(todo)) as advance:
        for job, result in run_jobs(measurement.measure, todo, jobs):
            if isinstance(result, Failure):
                print(result.details, file=sys.stderr)
            else:
                results[job.seed] = result
                write_json(paths[job.seed], {"made_from": stamp, **result})
            advance(1)
    return results
