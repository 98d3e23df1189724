"""Experiments: many results of the same kind, each measured once and saved.

A :class:`Task` is one result that is to be measured: an artifact with its origin.  Tasks that train
the same networks go into one group, which one process does in order; groups are shared among
processes of this machine or workers of a Dask cluster.  Each result is written as soon as it is
measured, so that an interrupted experiment continues with the remaining tasks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.errors import CheckFailed, UserError
from deploy.files import write_json
from pipeline import stages
from pipeline.artifacts import Artifact, Library, Origin
from pipeline.data.dataset import Dataset, dataset_origin, require_recordings_fit
from pipeline.data.events import Recordings
from pipeline.data.library import recordings_of
from pipeline.jobs import Failure, attempt, run_jobs
from pipeline.progress import hidden, progress
from pipeline.roads.fitting import fitted
from pipeline.run import RunFolder
from pipeline.settings import SIMULATED, Settings


@dataclass(frozen=True)
class Workers:
    """The processes that perform the tasks.

    Attributes
    ----------
    processes : int
        Number of processes on this machine.
    scheduler : str or None
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers perform the tasks
        instead.
    """

    processes: int = 2
    scheduler: str | None = None


@dataclass(frozen=True)
class Findings:
    """The result of an experiment.

    Attributes
    ----------
    summary : dict
        Plain values.
    failed : str
        The failed parts, in one line; empty if nothing failed.
    """

    summary: dict
    failed: str = ""


@dataclass(frozen=True)
class Task:
    """One result to measure.

    Attributes
    ----------
    artifact : Artifact
        Artifact of the result.
    settings : Settings
        Only the settings that the origin declares.
    recordings : str
        SHA-256 of the recordings.
    networks : Library
        Library of its trained networks.
    split : str
        Kind of its split, see :class:`pipeline.data.splits.Split`.
    subject : str
        Subject of the measurement, such as the name of a model; empty if there is only one.
    """

    artifact: Artifact
    settings: Settings
    recordings: str
    networks: Library
    split: str = "random"
    subject: str = ""

    @classmethod
    def of(cls, folder: Path, file: str, name: str, origin: Origin, settings, recordings, **more):
        """A task whose result is a file in an experiment's folder, beside its trained networks.

        Parameters
        ----------
        folder : Path
            Made absolute: a worker may have been started in another folder.
        file : str
            Path below the folder.
        name : str
            Name of the result.
        origin : Origin
            Origin of the result.
        settings : Settings
        recordings, **more
            Other attributes.
        """
        folder = folder.absolute()
        artifact = Artifact(name, folder / file, origin)
        networks = Library(folder / "networks")
        return cls(artifact, origin.view(settings), recordings, networks, **more)

    @property
    def name(self) -> str:
        """The artifact's name."""
        return self.artifact.name

    @property
    def origin(self) -> Origin:
        """The artifact's origin."""
        return self.artifact.origin

    @property
    def seed(self) -> int:
        """Seed of the split and of the trainings on it."""
        return self.settings.seed

    def dataset(self) -> Dataset:
        """The samples with the task's split.

        Raises
        ------
        UserError
            The recordings here are not those that the experiment was begun with.
        """
        return _dataset_of(self.settings, self.recordings, self.split)

    def trained(self, dataset: Dataset) -> dict:
        """Train the networks from which a run would make its bundle, unless they are up to date.

        Returns
        -------
        dict
            Metrics of the network that is deployed.
        """
        with hidden():
            return stages.train_all(self.networks, self.settings, dataset, silent)

    def weights(self, name: str, dataset: Dataset) -> dict:
        """Weights of a trained network, one of :data:`pipeline.stages.training.ARTIFACTS`."""
        return stages.weights_of(name, self.networks, self.settings, dataset.origin)


def study(label: str, measure: Callable, groups, workers: Workers, say: Callable) -> dict:
    """Measure missing or outdated results; a task that fails does not stop the others.

    Parameters
    ----------
    label : str
        Label of the progress bar.
    measure : callable
        Function of a module, from a :class:`Task` to its result, a dict.
    groups : sequence of sequence of Task
        The tasks of a group are measured one after the other in one process.
    workers : Workers
    say : callable
        Called with the details of each failure, with the reason for waiting, and with the reason
        why results are measured again.

    Returns
    -------
    dict
        By task name, in the order of the groups: its result, or a :class:`pipeline.jobs.Failure`.

    Raises
    ------
    UserError
        There is no scheduler at the address, or Dask is not installed.
    """
    results, left, reasons = {}, [], {}
    for group in groups:
        todo = []
        for task in group:
            state = task.artifact.state()
            if state.is_current:
                results[task.name] = state.record
                continue
            todo.append(task)
            if state.because:
                reasons.setdefault(state.reasons(), []).append(task.name)
        if todo:
            left.append(tuple(todo))
    for reason, names in reasons.items():
        say(f"{label}: measuring {_listed(names)} again: {reason}")
    with progress(label, sum(map(len, left))) as advance:
        work = partial(_work, measure, __version__)
        for group, found in run_jobs(work, left, workers.processes, workers.scheduler, say):
            if isinstance(found, Failure):  # an error of the process, not of a task
                found = [found] * len(group)
            for task, result in zip(group, found, strict=True):
                if not isinstance(result, Failure):
                    result = _kept(task, result)
                elif result.mistake is None:
                    say(result.details)
                results[task.name] = result
            advance(len(group))
    failures = [result for result in results.values() if isinstance(result, Failure)]
    for mistake in sorted({f.details for f in failures if f.mistake is not None}):
        say(mistake)
    return {task.name: results[task.name] for group in groups for task in group}


def successful(results: dict) -> tuple:
    """The results of :func:`study` that are no failures, and the names of the others, in one line.

    Raises
    ------
    CheckFailed
        Every measurement failed.
    """
    failed = [name for name, result in results.items() if isinstance(result, Failure)]
    if len(failed) == len(results):
        raise CheckFailed("every measurement failed; see above")
    return [result for name, result in results.items() if name not in failed], ", ".join(failed)


def concluded(folder: RunFolder, name: str, summary: dict, failed: str) -> Findings:
    """Write the summary of an experiment; ``failed`` says what has failed, or is empty."""
    write_json(folder.path / f"{name}.json", summary)
    return Findings(summary, failed and f"{failed} failed; the same command tries again")


def _work(measure, version, group):
    """Measure the tasks of a group in a worker; return results and failures."""
    if version != __version__:
        raise UserError(f"the worker has version {__version__} of this package, not {version}")
    found = []
    for task in group:
        result = attempt(measure, task)
        if not isinstance(result, Failure):
            _kept(task, result)
        found.append(result)
    return found


def _kept(task, result):
    """Write a result, unless a worker with access to the folder has written it; return it."""
    state = task.artifact.state()
    return state.record if state.is_current else task.artifact.write(result)


def _listed(names):
    return names[0] if len(names) == 1 else f"{len(names)} results"


_LOADED = {}


def _dataset_of(settings, recordings, split):
    """The data set that the tasks of a group share."""
    key = dataset_origin(settings, recordings, split).key
    if key not in _LOADED:
        _LOADED.clear()
        dataset = Dataset.of(settings, kind=split)
        if dataset.recordings.source.sha256 != recordings:
            raise UserError(f"{settings.data.source}: the worker has other recordings there")
        _LOADED[key] = dataset
    return _LOADED[key].seen_by(settings)


@dataclass(frozen=True)
class Experiment:
    """A measurement that is repeated on several splits.

    Attributes
    ----------
    name : str
        Name of the summary's file.
    measure : callable
        From a :class:`Task` to a dict with the items of :func:`counted`.
    summarise : callable
        From those dicts and whether the recordings are simulated to a dict.
    origin : callable
        ``origin(settings, dataset_origin, subject) -> Origin`` of a result.
    text : callable
        From what ``summarise`` returns to the text that is printed.
    subjects : tuple of str
        Subjects that are measured on each split.
    refuse : callable
        Called with the settings; raises UserError if nothing can be measured with them.
    other_inputs : tuple of str
        Kinds of input of networks that are trained in addition to those of the settings.
    """

    name: str
    measure: Callable
    summarise: Callable
    origin: Callable
    text: Callable
    subjects: tuple = ("",)
    refuse: Callable = lambda settings: None
    other_inputs: tuple = ()

    def inputs(self, settings: Settings) -> tuple:
        """Kinds of input of the networks that are trained with the settings."""
        return tuple(dict.fromkeys((settings.input.kind, *self.other_inputs)))


CNN_SETTINGS = ("image", "cnn.architecture", "cnn.epochs", "cnn.batch_size", "cnn.learning_rate")
"""Settings that affect every network with the CNN's recipe of training."""


def on_split(settings: Settings, seed: int) -> Settings:
    """The settings of an experiment's split: a separate seed, no validation part."""
    split = replace(settings.split, validation_fraction=0.0)
    return replace(settings, seed=seed, split=split)


def fitted_to_inputs(settings: Settings, kinds, recordings: Recordings, say: Callable) -> dict:
    """Adapt settings to recordings that are not simulated, for each kind of input.

    Parameters
    ----------
    settings : Settings
    kinds : iterable of str
        Values of ``input.kind``.
    recordings : Recordings
        Recordings that the settings name.
    say : callable
        Called with a message about each chosen setting.

    Returns
    -------
    dict of str to Settings
        By kind.  Each has the architectures of all kinds, and the presentation of its own.

    Raises
    ------
    SeveralErrors
        With a line for each reason why the settings do not fit the recordings.
    """
    found = {kind: on_input(settings, kind) for kind in kinds}
    if settings.data.source == SIMULATED:
        return found
    found = {
        kind: fitted(of_kind, say=say, recordings=recordings) for kind, of_kind in found.items()
    }
    sections = {"image": "cnn", "events": "events"}
    trained = {sections[kind]: getattr(of, sections[kind]) for kind, of in found.items()}
    return {kind: replace(of_kind, **trained) for kind, of_kind in found.items()}


def on_input(settings: Settings, kind: str) -> Settings:
    """The settings with another ``input.kind``."""
    return replace(settings, input=replace(settings.input, kind=kind))


def begin(folder: RunFolder, settings: Settings, say: Callable):
    """Save the settings in the folder of an experiment; of a new one, say what it measures.

    Parameters
    ----------
    folder : RunFolder
        Folder of the results, locked.
    settings : Settings
    say : callable
        Called with the source of the recordings: hours later it would be too late.
    """
    if not folder.experiment.exists():
        source = settings.data.source
        what = "simulated recordings (others: --data)" if source == SIMULATED else source
        say(f"{folder.path}: new results, on {what}")
    folder.save_settings(settings)


def measure_splits(
    experiment: Experiment,
    folder: RunFolder,
    settings: Settings,
    splits: int,
    workers: Workers,
    say: Callable,
) -> Findings:
    """Measure an experiment on random splits, and write the summary of all.

    Parameters
    ----------
    experiment : Experiment
    folder : RunFolder
        Folder of the results, locked.
    settings : Settings
    splits : int
        Number of splits, with the seeds from the settings' own on.
    workers, say
        As in :func:`study`.

    Raises
    ------
    UserError
        The recordings cannot be read or do not fit, or the experiment refuses the settings.
    CheckFailed
        Every measurement failed.
    """
    experiment.refuse(settings)
    recordings = recordings_of(settings, workers.processes, say)
    fits = fitted_to_inputs(settings, experiment.inputs(settings), recordings, say)
    for of_kind in fits.values():
        require_recordings_fit(recordings, of_kind)
    settings = fits[settings.input.kind]
    begin(folder, settings, say)
    sha256, groups = recordings.source.sha256, []
    for seed in range(settings.seed, settings.seed + splits):
        split = on_split(settings, seed)
        dataset = dataset_origin(split, sha256)
        for subject in experiment.subjects:
            name = f"{subject} of seed {seed}" if subject else f"split {seed}"
            file = f"{subject or 'split'}-{seed:02d}.json"
            origin = experiment.origin(split, dataset, subject)
            task = Task.of(folder.path, file, name, origin, split, sha256, subject=subject)
            groups.append([task])
    results = study(experiment.name, experiment.measure, groups, workers, say)
    whole, failed = successful(results)
    summary = experiment.summarise(whole, recordings.source.simulated)
    summary["source_sha256"] = sha256
    return concluded(folder, experiment.name, summary, failed)


def counted(task: Task, dataset: Dataset) -> dict:
    """The seed of a task, and the numbers of training and test samples."""
    split = dataset.split
    return {"seed": task.seed, "n_train": len(split.train), "n_test": len(split.test)}


def accuracies(predictions: dict, labels) -> dict:
    """The share of correct predictions of each network or stage, by its name."""
    return {name: float(np.mean(found == labels)) for name, found in predictions.items()}


def summary_of_splits(results, simulated: bool) -> dict:
    """The part of a summary that describes its splits.

    Parameters
    ----------
    results : sequence of dict
        One dict per split, with the items of :func:`counted`.
    simulated : bool

    Returns
    -------
    dict
        ``simulated``, ``seeds``, and the numbers of training and test samples.
    """
    return {
        "simulated": simulated,
        "seeds": [result["seed"] for result in results],
        "n_train": results[0]["n_train"],
        "n_test": results[0]["n_test"],
    }


def silent(line):
    """Print nothing: for many trainings at a time the progress bar suffices."""
