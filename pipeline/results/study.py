"""Studies: cases that are measured once each, and tables of them over splits.

A :class:`Case` is one result to measure: a stage of a network that is trained with some settings on
one split.  :func:`run_study` measures the cases that a folder does not have yet, in processes of
this machine or on a Dask cluster, and writes each row as soon as it is measured, so that an
interrupted study goes on.
"""

import functools
import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.check.bundle import CheckSet
from deploy.errors import CheckFailed, UserError
from deploy.files import read_json, write_json
from deploy.network.decision import compute_share_of_time
from deploy.network.stimulus import find_last_steps
from deploy.preflight.plan import make_plan
from deploy.targets.registry import TARGETS, run_target
from pipeline.jobs import Failure, attempt, run_jobs
from pipeline.kinds.reference import make_responses_of_logits
from pipeline.paper import CNN_MACS
from pipeline.progress import hide_progress, progress
from pipeline.recordings.dataset import Dataset
from pipeline.settings import Settings
from pipeline.sources import load_dataset
from pipeline.storage.artifacts import DELETE_IT, Library
from pipeline.workflow import OpenedRun, open_experiment

SCHEMA = "stmnist-row/1"


@dataclass(frozen=True)
class Workers:
    """The processes that measure the cases.

    Attributes
    ----------
    processes : int
        Number of processes on this machine.
    scheduler : str or None
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers measure instead.
    """

    processes: int = 2
    scheduler: str | None = None


@dataclass(frozen=True)
class Case:
    """One result to measure.

    Attributes
    ----------
    name : str
        Name of the row.
    settings : Settings
        All settings of the network, its training and its presentation.
    stage : str
        A reference stage of the ladder, or a target.
    seed : int
        Seed of the split and of the training.
    split : str
        Kind of the split, see :class:`pipeline.recordings.splits.Split`.
    part : str
        ``"test"``, or ``"validation"``; then the test samples are not used at all.
    alter : str
        How the recordings are changed, for a function that measures; :func:`measure_case` does not.
    """

    name: str
    settings: Settings
    stage: str
    seed: int = 0
    split: str = "random"
    part: str = "test"
    alter: str = ""

    @property
    def resolved(self) -> Settings:
        """The settings with the seed and the split of the case."""
        split = replace(self.settings.split, kind=self.split)
        return replace(self.settings, seed=self.seed, split=split)

    def compute_key(self, recordings: str) -> str:
        """SHA-256 of all that the row depends on, given the hash of the recordings."""
        parts = [SCHEMA, __version__, recordings, self.stage, self.part, self.alter]
        text = json.dumps([*parts, self.resolved.flatten()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def trained(self) -> str:
        """Hash of what the trained networks depend on, which cases of a group share."""
        values = {
            name: value
            for name, value in self.resolved.flatten().items()
            if not name.startswith(("deployment.", "presentation.", "check."))
        }
        text = json.dumps([self.part, self.alter, values], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def run_study(
    cases, folder: Path, recordings: str, workers: Workers, say: Callable, measured_by=None
) -> tuple:
    """Measure the cases whose rows are missing; one that fails does not stop the others.

    Parameters
    ----------
    cases : sequence of Case
        Those with the same trained networks are measured one after the other in one process.
    folder : Path
        Folder of the rows and networks; on a cluster, if possible, one that all workers can access.
    recordings : str
        SHA-256 of the recordings that the settings name.
    workers : Workers
    say : callable
        Called with the details of each failure, and with the reason for waiting.
    measured_by : callable, optional
        ``measured_by(case, networks) -> dict``, a function of a module; default:
        :func:`measure_case`.

    Returns
    -------
    rows : list of dict
        In the order of the cases, without those that failed.
    failed : dict of Case to str
        The error of each failed case, in one line.

    Raises
    ------
    UserError
        There is no scheduler at the address, or Dask is not installed.
    CheckFailed
        Every case failed.
    """
    folder = folder.absolute()  # a worker may have been started in another folder
    rows = {}
    groups: dict = {}
    for case in cases:
        path = _find_row_file(folder, case, recordings)
        if path.exists():
            rows[case] = read_json(path, DELETE_IT)
        else:
            groups.setdefault(case.trained, []).append(case)
    failures = {}
    work = partial(_measure_group, measured_by or measure_case, folder, recordings)
    with progress("measure", sum(map(len, groups.values())), "cases") as advance:
        jobs = run_jobs(work, list(groups.values()), workers.processes, workers.scheduler, say)
        for group, results in jobs:
            if isinstance(results, Failure):  # an error of the process, not of a case
                results = [results] * len(group)
            for case, result in zip(group, results, strict=True):
                if isinstance(result, Failure):
                    failures[case] = result
                else:
                    rows[case] = _write_row(folder, case, recordings, result)
            advance(len(group))
    for details in dict.fromkeys(failure.details for failure in failures.values()):
        say(details)
    if failures and not rows:
        raise CheckFailed("every measurement failed; see above")
    failed = {case: failure.error for case, failure in failures.items()}
    return [{**rows[case], "name": case.name} for case in cases if case in rows], failed


def _measure_group(measured_by, folder, recordings, group):
    """Rows and failures of cases that share trained networks, in a worker."""
    networks = Library(folder / "networks")
    results = []
    for case in group:
        result = attempt(partial(_measure_one, measured_by, networks, recordings), case)
        if not isinstance(result, Failure):
            _write_row(folder, case, recordings, result)
        results.append(result)
    return results


def _measure_one(measured_by, networks, recordings, case):
    begun = time.perf_counter()
    row = measured_by(case, networks)
    if row["recordings"] != recordings:
        raise UserError(f"{case.settings.data.source}: this worker has other recordings there")
    return {**row, "seconds": time.perf_counter() - begun}


def _find_row_file(folder, case, recordings):
    """The file of a row; its name says what it is, to people."""
    key = case.compute_key(recordings)[:16]
    return folder / "rows" / f"{case.name}-{case.split}-{case.seed:02d}-{key}.json"


def _write_row(folder, case, recordings, row):
    """Write a row, unless a worker with access to the folder has written it; return it."""
    path = _find_row_file(folder, case, recordings)
    if not path.exists():
        write_json(path, row, indent=None)  # thousands of numbers
    return row


def measure_case(case: Case, networks: Library, dataset: Dataset | None = None) -> dict:
    """Train what a case needs, unless a library has it, and evaluate it.

    Parameters
    ----------
    case : Case
    networks : Library
    dataset : Dataset, optional
        Default: :func:`make_dataset` the case.

    Returns
    -------
    dict
        As :func:`evaluate_case`.
    """
    return evaluate_case(case, train_case(case, networks, dataset or make_dataset(case)))


def train_case(case: Case, networks: Library, dataset: Dataset) -> OpenedRun:
    """Train what a case needs, unless a library has it."""
    with hide_progress():
        opened = open_experiment(networks, case.resolved, dataset, _say_nothing)
        reference = opened.kind.references.get(case.stage)
        opened.make_all(None if reference is None else reference.step)
    return opened


def evaluate_case(case: Case, opened: OpenedRun, dataset: Dataset | None = None) -> dict:
    """The row of a case whose networks are trained.

    Parameters
    ----------
    case : Case
    opened : OpenedRun
        From :func:`train_case`.
    dataset : Dataset, optional
        Other samples of the same split, such as those with faulty taxels; for targets only.

    Returns
    -------
    dict
        See :func:`make_row`; of a target also its ``costs``, see :func:`measure_costs`.
    """
    if case.stage not in TARGETS:
        if dataset is not None:
            raise ValueError(f"other samples are for targets, not for the stage {case.stage!r}")
        index = opened.dataset.split.get_indices(case.part)
        return make_row(case, opened.dataset, index, _predict_before_chip(case, opened, index))
    dataset = dataset or opened.dataset
    index = dataset.split.get_indices(case.part)
    inputs, labels = dataset.subset(case.part)
    with hide_progress():
        spec = opened.make_spec()
    responses = run_target(spec, inputs, case.stage, case.seed)
    costs = measure_costs(spec, responses)
    if responses.stopped_at is not None:
        last = responses.stopped_at - 1
        early = responses.decisions[np.arange(len(index)), last]
        costs["share"] = float(compute_share_of_time(last, find_last_steps(inputs)).mean())
        costs["early"] = float(np.mean(early == labels))
    return make_row(case, dataset, index, responses.predictions, costs=costs)


def _predict_before_chip(case, opened, index) -> np.ndarray:
    """Predictions of a reference stage, shape (n_samples,)."""
    reference = opened.kind.references[case.stage]
    inputs = opened.make_step_inputs(case.resolved.flatten())
    dataset = opened.dataset
    ids = tuple(dataset.recordings.ids[i] for i in index)
    samples = CheckSet(dataset.inputs[index], dataset.labels[index], ids, case.seed)
    with hide_progress():
        logits = reference.compute_logits(case.stage, inputs, samples, None)
    return make_responses_of_logits(logits, case.resolved.presentation).predictions


def make_dataset(case: Case) -> Dataset:
    """The samples of a case, with its split.

    Raises
    ------
    UserError
        There are too few samples for the set.
    """
    settings = case.resolved
    kept = {name: getattr(settings, name) for name in ("seed", "data", "skin", "split")}
    dataset = _split_recordings(replace(Settings(), **kept)).restrict_to(settings)
    if case.part == "validation":
        if not len(dataset.split.validation):
            raise UserError(
                f"{case.settings.data.source}: too few samples for a validation set; give more"
            )
        split = replace(dataset.split, test=dataset.split.test[:0])
        dataset = replace(
            dataset, split=split, origin=dataset.origin.with_content("samples", "no test split")
        )
    return dataset


@functools.lru_cache(maxsize=1)
def _split_recordings(settings):
    """The recordings and their split, which the cases of a group share."""
    return load_dataset(settings)


def make_row(case: Case, dataset: Dataset, index, predictions, **more) -> dict:
    """The row of a case, ready for JSON.

    Parameters
    ----------
    case : Case
    dataset : Dataset
    index : ndarray of int, shape (n,)
        The evaluated samples.
    predictions : ndarray of int, shape (n,)
    **more
        Further entries.
    """
    labels = dataset.labels[index]
    split = dataset.split
    source = dataset.recordings.source
    return {
        "schema": SCHEMA,
        **{key: getattr(case, key) for key in ("stage", "seed", "split", "part", "alter")},
        "simulated": source.simulated,
        "recordings": source.sha256,
        "n_train": len(split.train),
        "n_test": len(index),
        "accuracy": float(np.mean(predictions == labels)),
        "samples": [int(i) for i in index],
        "predictions": [int(p) for p in predictions],
        "right": [int(r) for r in predictions == labels],
        **more,
    }


def measure_costs(spec, responses) -> dict:
    """Means over samples, for one inference.

    Returns
    -------
    dict
        ``operations``: synaptic, readout included; ``per_cnn`` and ``per_dense``: the same relative
        to the multiply-accumulates of the paper's CNN and of the dense form of this network;
        ``updates`` of neurons on the chip; ``cores``; ``steps`` of a presentation;
        ``spikes`` by layer.
    """
    operations = float(sum(counts.mean() for counts in responses.operations.values()))
    neurons = sum(layer.size for layer in spec.layers if layer.neurons)
    return {
        "operations": operations,
        "per_cnn": operations / CNN_MACS,
        "per_dense": operations / sum(spec.multiply_accumulates.values()),
        "updates": neurons * spec.presentation.period,
        "cores": len(make_plan(spec).to_json()["cores"]),
        "steps": spec.presentation.steps,
        "spikes": {name: float(counts.mean()) for name, counts in responses.spikes.items()},
    }


def _say_nothing(line):
    """Print nothing: for many trainings at a time the progress bar suffices."""
