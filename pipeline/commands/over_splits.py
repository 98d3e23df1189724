"""A measurement repeated over random splits, one seed each: what several benchmarks do."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from deploy.errors import CheckFailed
from deploy.files import write_json
from pipeline.commands import options
from pipeline.parallel import Failure, run_jobs
from pipeline.progress import progress
from pipeline.run_folder import RunFolder, read_stamped, stamp_of
from pipeline.settings import Settings
from pipeline.sources import recordings_of


@dataclass(frozen=True)
class Job:
    """Some splits that are measured in one go.

    Attributes
    ----------
    settings : Settings
    seeds : tuple of int
        Of each split and its training.
    """

    settings: Settings
    seeds: tuple


@dataclass(frozen=True)
class Measurement:
    """What is measured, and how it is told.

    Attributes
    ----------
    name : str
        Of the summary's file.
    measure : callable
        From a :class:`Job` to a list with a dict for each of its seeds, which has the key
        ``"seed"``.
    summarise : callable
        From those dicts and whether the recordings are simulated to a dict.
    text : callable
        From that to a table.
    together : int
        Splits of a job at most.
    depends_on : tuple
        Plain values that the results depend on besides recordings and settings.
    """

    name: str
    measure: Callable
    summarise: Callable
    text: Callable
    together: int = 1
    depends_on: tuple = ()


def run(measurement: Measurement, out: Path, splits, data, settings, set_, jobs, as_json):
    """Measure the splits that are not there yet, write and print the summary.

    Raises
    ------
    CheckFailed
        A split failed; those that did not are kept, and summarised.
    """
    folder = RunFolder(out)
    with folder.locked():
        resolved = options.resolve(folder, data, None, None, None, settings, set_)
        recordings = recordings_of(resolved.data, jobs)
        folder.save_settings(resolved)
        stamp = stamp_of(recordings.source.sha256, asdict(resolved), *measurement.depends_on)
        results = _results(measurement, resolved, out, range(splits), stamp, jobs)
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
    missing = [seed for seed, result in results.items() if result is None]
    size = min(measurement.together, -(-len(missing) // jobs)) or 1
    todo = [
        Job(settings, tuple(missing[start : start + size]))
        for start in range(0, len(missing), size)
    ]
    with progress(measurement.name, len(missing)) as advance:
        for job, done in run_jobs(measurement.measure, todo, jobs):
            if isinstance(done, Failure):
                print(done.details, file=sys.stderr)
            else:
                for result in done:
                    results[result["seed"]] = result
                    write_json(paths[result["seed"]], {"made_from": stamp, **result})
            advance(len(job.seeds))
    return results
