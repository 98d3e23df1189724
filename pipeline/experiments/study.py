"""Jobs over splits, seeds and points: each done once, kept, and gone on with where they stopped.

A job is a value of its experiment's own; what is done with it is a function of a module, so that
processes of this machine and workers of a Dask cluster can do it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from deploy import __version__
from deploy.errors import CheckFailed, UserError
from deploy.files import write_json
from pipeline.inputs.dataset import Dataset
from pipeline.inputs.library import recordings_of
from pipeline.jobs import Failure, run_jobs
from pipeline.progress import progress
from pipeline.run.folder import RunFolder, read_stamped, stamp_of
from pipeline.settings import Settings


@dataclass(frozen=True)
class Workers:
    """Who does the jobs.

    Attributes
    ----------
    processes : int
        On this machine.
    scheduler : str or None
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers do them instead.
    """

    processes: int = 2
    scheduler: str | None = None


@dataclass(frozen=True)
class Findings:
    """What came out of an experiment.

    Attributes
    ----------
    summary : dict
        Plain values.
    failed : str
        What of it failed, in one line; empty if nothing did.
    """

    summary: dict
    failed: str = ""


def study(
    label: str,
    measure: Callable,
    jobs,
    workers: Workers,
    say: Callable,
    kept: Callable | None = None,
    keep: Callable | None = None,
    size: Callable = lambda job: 1,
) -> list:
    """Do the jobs that are not done yet; one that fails does not stop the others.

    Parameters
    ----------
    label : str
        Of the progress bar.
    measure : callable
        Of a module, from a job to its result.
    jobs : sequence
        Values that can be pickled.
    workers : Workers
    say : callable
        Called with the details of each failure, and with what the jobs wait for.
    kept : callable, optional
        From a job to its result of an earlier time, or None; see :func:`read_kept`.
    keep : callable, optional
        Called with a job and its result as soon as it is there; see :func:`write_kept`.
    size : callable, optional
        From a job to how far it brings the progress bar.

    Returns
    -------
    list
        The result of each job, or a :class:`pipeline.jobs.Failure`.

    Raises
    ------
    UserError
        There is no scheduler at the address, or Dask is not installed.
    """
    results = [kept(job) if kept else None for job in jobs]
    todo = [(number, job) for number, job in enumerate(jobs) if results[number] is None]
    with progress(label, sum(size(job) for _, job in todo)) as advance:
        work = partial(_work, measure, __version__)
        for (number, job), result in run_jobs(
            work, todo, workers.processes, workers.scheduler, say
        ):
            results[number] = result
            if isinstance(result, Failure):
                if result.mistake is None:
                    say(result.details)
            elif keep is not None:
                keep(job, result)
            advance(size(job))
    failures = [result for result in results if isinstance(result, Failure)]
    for mistake in sorted({f.details for f in failures if f.mistake is not None}):
        say(mistake)
    return results


def _work(measure, version, numbered):
    if version != __version__:
        raise UserError(f"the worker has version {__version__} of this package, not {version}")
    return measure(numbered[1])


def read_kept(job) -> dict | None:
    """The result of a job that has a ``path`` and a ``stamp``, if it is there and not outdated."""
    return read_stamped(job.path, job.stamp)


def write_kept(job, result: dict):
    """Keep a job's result for :func:`read_kept`."""
    write_json(job.path, {"made_from": job.stamp, **result})


def dataset_for(settings: Settings, source_sha256: str) -> Dataset:
    """The samples of a job, where it is done.

    Raises
    ------
    UserError
        The recordings there are not those that the experiment was begun with.
    """
    dataset = Dataset.of(settings)
    if dataset.recordings.source.sha256 != source_sha256:
        raise UserError(f"{settings.data.source}: the worker has other recordings there")
    return dataset


@dataclass(frozen=True)
class SplitJob:
    """A random split to measure.

    Attributes
    ----------
    settings : Settings
    seed : int
        Of the split and its trainings.
    source_sha256 : str
        Of the recordings that the settings name.
    path : Path
        Of the result.
    stamp : str
        Hash of all that it depends on.
    """

    settings: Settings
    seed: int
    source_sha256: str
    path: Path
    stamp: str

    @property
    def name(self) -> str:
        """What a failure is called by."""
        return f"split {self.seed}"

    def dataset(self) -> Dataset:
        """The samples with this split; see :func:`dataset_for`."""
        dataset = dataset_for(self.settings, self.source_sha256)
        return dataset.divided(self.seed, self.settings.split.test_fraction)


def one_a_split(settings, seed, source_sha256, folder, stamp) -> list:
    """The jobs of a seed where there is one; ``stamp(*more)`` hashes what it depends on."""
    return [SplitJob(settings, seed, source_sha256, folder / f"split-{seed:02d}.json", stamp())]


def of_splits(results, simulated: bool) -> dict:
    """What a summary says of its splits: ``simulated``, ``seeds``, samples trained and tested on.

    Parameters
    ----------
    results : sequence of dict
        One a split, with ``seed``, ``n_train`` and ``n_test``.
    simulated : bool
    """
    return {
        "simulated": simulated,
        "seeds": [result["seed"] for result in results],
        "n_train": results[0]["n_train"],
        "n_test": results[0]["n_test"],
    }


def measure_splits(
    name: str,
    measure: Callable,
    summarise: Callable,
    folder: RunFolder,
    settings: Settings,
    splits: int,
    workers: Workers,
    say: Callable,
    depends_on=(),
    jobs_of: Callable = one_a_split,
) -> Findings:
    """Measure the random splits that are not there yet, and write the summary of all.

    Parameters
    ----------
    name : str
        Of the summary's file.
    measure : callable
        From a :class:`SplitJob` to a dict.
    summarise : callable
        From those dicts and whether the recordings are simulated to a dict.
    folder : RunFolder
        Of the results, locked.
    settings : Settings
    splits : int
        How many, from the settings' own seed on.
    workers, say
        As in :func:`study`.
    depends_on : tuple
        Plain values that the results depend on besides recordings and settings.
    jobs_of : callable
        The jobs of a seed, see :func:`one_a_split`.

    Raises
    ------
    UserError
        The recordings cannot be read.
    CheckFailed
        Everything failed.
    """
    source = recordings_of(settings, workers.processes).source
    folder.save_settings(settings)
    stamp = partial(stamp_of, __version__, source.sha256, asdict(settings), *depends_on)
    root = folder.path.absolute()  # where a worker keeps its checkpoint too
    jobs = [
        job
        for seed in range(settings.seed, settings.seed + splits)
        for job in jobs_of(settings, seed, source.sha256, root, stamp)
    ]
    results = study(name, measure, jobs, workers, say, read_kept, write_kept)
    whole = [result for result in results if not isinstance(result, Failure)]
    if not whole:
        raise CheckFailed("all of it failed; see above")
    summary = summarise(whole, source.simulated)
    summary["source_sha256"] = source.sha256
    write_json(folder.path / f"{name}.json", summary)
    failed = [
        job.name for job, result in zip(jobs, results, strict=True) if isinstance(result, Failure)
    ]
    return Findings(
        summary, f"{', '.join(failed)} failed; the same command tries again" if failed else ""
    )
