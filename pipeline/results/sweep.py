"""A sweep: every combination of some settings, tested on validation samples by the fast emulator.

A sweep selects settings, so it does not use the test split: networks are trained on the training
samples without a held-out validation part, and tested on that part.  Points that differ only in
deployment or presentation share one training.
"""

from __future__ import annotations

import functools
import itertools
import re
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import replacing
from deploy.preflight.plan import make_plan
from deploy.targets.registry import answer
from pipeline import stages
from pipeline.artifacts import Library, Origin
from pipeline.data.dataset import Dataset, dataset_origin, require_recordings_fit
from pipeline.data.events import Recordings
from pipeline.data.library import recordings_of
from pipeline.jobs import Failure
from pipeline.paper import CNN_MACS
from pipeline.progress import hidden
from pipeline.results.study import (
    Findings,
    Task,
    Workers,
    begin,
    concluded,
    fitted_to_inputs,
    silent,
    study,
)
from pipeline.results.sweep_text import sweep_csv
from pipeline.roads.origins import bundle_origin
from pipeline.run import RunFolder
from pipeline.settings import Settings, parse_assignments, put

TARGET = "fast"
"""The target on which points are evaluated; bit-identical to NengoLoihi's emulator."""

POINT_SCHEMA = "stmnist-sweep-point/3"
SCHEMA = "stmnist-sweep/2"
VALIDATION = 0.15
"""Share of the training samples held out for the evaluation, if the settings have none."""

DEFAULT_GRID = (
    "presentation.steps=50,100",
    "deployment.synapse=0.005,0.01",
    "snn.max_rates=100,150",
    "snn.spike_penalty=0,0.05",
)
"""16 points from four trainings, of images."""

EVENTS_GRID = ("events.budget=0.6,0.9", "events.early=0.3,1")
"""Four points from four trainings, on events."""

SAMPLES_APART = ("seed", "data", "split", "check")
"""Settings that change which samples there are; points on different ones cannot be compared."""


@dataclass(frozen=True)
class SweepTask(Task):
    """A training or a point of a sweep; its samples have no test split."""

    def dataset(self) -> Dataset:
        """The samples, without the test split."""
        return without_test(super().dataset())


@dataclass(frozen=True)
class Point:
    """A combination of settings.

    Attributes
    ----------
    settings : Settings
    changes : tuple of (str, value)
        The values of the settings in the grid.
    trainings : tuple of SweepTask
        Trainings of its CNN and of the network for the chip; on events only of the latter.
    evaluation : SweepTask
        Evaluation of the network on the validation samples.
    """

    settings: Settings
    changes: tuple
    trainings: tuple
    evaluation: SweepTask


def base_settings(settings: Settings) -> Settings:
    """The settings with a validation part."""
    fraction = settings.split.validation_fraction or VALIDATION
    return settings.with_values({"split": {"validation_fraction": fraction}}, "sweep")


def points_of(folder: Path, base: Settings, grid, recordings: Recordings) -> list:
    """Every combination of the grid's values.

    Parameters
    ----------
    folder : Path
        Folder of the sweep.
    base : Settings
        From :func:`base_settings`.
    grid : sequence of str
        Such as ``"presentation.steps=50,100"`` or ``"snn.max_rates=[100,150],[150,150]"``; a single
        number is taken as a list of one.
    recordings : Recordings
        Recordings that the settings name.

    Returns
    -------
    list of Point

    Raises
    ------
    UserError
        An entry cannot be read, names no setting or one that changes the samples, or a combination
        is out of range.
    """
    if base.nir.file:
        raise UserError(
            f"{base.nir.file}: a NIR graph cannot be swept, because it is not trained; convert "
            "it with each of the settings in a run of its own, and use 'stmnist compare'"
        )
    axes = [_axis(entry, base) for entry in grid]
    names = [axis[0][0] for axis in axes]
    if len(set(names)) < len(names):
        raise UserError("--grid: a setting is given twice; write all its values in one")
    points = []
    for combination in itertools.product(*axes):
        values: dict = {}
        for name, value in combination:
            put(values, name, value, "--grid")
        settings = base.with_values(values, "--grid")
        require_recordings_fit(recordings, settings)
        points.append(_point(folder, settings, combination, recordings.source.sha256))
    return points


def _point(folder, settings, changes, recordings):
    """A point with its tasks: its networks, which other points may share, and its result."""
    dataset = _without_test_origin(dataset_origin(settings, recordings))
    networks, trainings = Library(folder / "networks"), []
    for name in ("events",) if settings.on_events else ("cnn", "rate-lif"):
        artifact = stages.network_artifact(name, networks, settings, dataset)
        view = artifact.origin.view(settings)
        unique = replace(artifact, name=f"{name} {artifact.origin.key[:16]}")
        trainings.append(SweepTask(unique, view, recordings, networks, subject=name))
    origin = result_origin(settings, dataset)
    key = origin.key[:16]
    evaluation = SweepTask.of(
        folder, f"points/{key}.json", f"point {key}", origin, settings, recordings
    )
    return Point(settings, tuple(changes), tuple(trainings), evaluation)


def result_origin(settings: Settings, dataset: Origin) -> Origin:
    """The origin of a point's result."""
    contents = {"schema": POINT_SCHEMA, "target": TARGET}
    return Origin.of(settings, uses=[bundle_origin(settings, dataset)], contents=contents)


def _axis(entry, base):
    """[(name, value), ...] of a grid's entry."""
    name, equals, text = entry.partition("=")
    name = name.strip()
    pieces = [piece.strip() for piece in re.split(r",(?![^\[]*\])", text)]
    if not equals or not name or not all(pieces):
        raise UserError(f"--grid {entry!r}: expected section.name=value,value,...")
    if name.partition(".")[0] in SAMPLES_APART:
        raise UserError(
            f"--grid {entry!r}: points on different samples cannot be compared; "
            f"give {name} with --set, one sweep for each"
        )
    axis = []
    for piece in pieces:
        value = functools.reduce(
            dict.__getitem__, name.split("."), parse_assignments([f"{name}={piece}"])
        )
        if isinstance(base.flat().get(name), tuple) and not isinstance(value, list):
            value = [value]
        axis.append((name, value))
    return axis


def without_test(dataset: Dataset) -> Dataset:
    """A data set without its test split.

    Raises
    ------
    UserError
        There are too few samples for a validation part.
    """
    if not len(dataset.split.validation):
        raise UserError(
            f"{dataset.settings.data.source}: too few samples for a validation part; give more data"
        )
    split = replace(dataset.split, test=dataset.split.test[:0])
    return replace(dataset, split=split, origin=_without_test_origin(dataset.origin))


def _without_test_origin(dataset):
    return replace(dataset, contents={**dataset.contents, "samples": "without the test split"})


def train_network(task: SweepTask) -> dict:
    """Train a network that points share; return the record of its artifact.

    A worker without access to the folder also trains the network from which this one starts.
    """
    dataset = task.dataset()
    with hidden():
        for name in ("cnn", task.subject) if task.subject == "rate-lif" else (task.subject,):
            record = stages.train(name, task.networks, task.settings, dataset, silent)
    return record


def evaluate(task: SweepTask) -> dict:
    """Run a point's network on the validation samples on the fast emulator.

    Returns
    -------
    dict
        ``accuracy`` with its interval; the mean synaptic ``operations`` per inference, also
        as ``operations_per_mac`` relative to the multiply-accumulates of the paper's CNN, and
        ``spikes`` by layer; ``cores``; ``stable_after_median``; the accuracies of the CNN (None on
        events) and of the trained network on the same samples.
    """
    begun = time.perf_counter()
    settings, dataset = task.settings, task.dataset()
    trained = task.trained(dataset)
    cnn_accuracy = None
    if not settings.on_events:
        cnn = stages.network_artifact("cnn", task.networks, settings, dataset.origin)
        cnn_accuracy = cnn.state().record["accuracy"]["validation"]
    inputs, labels = dataset.part("validation")
    spec = stages.spec_of(task.networks, settings, dataset, {})
    responses = answer(spec, inputs, TARGET, settings.seed)
    right = responses.predictions == labels
    operations = float(sum(counts.mean() for counts in responses.operations.values()))
    return {
        "schema": POINT_SCHEMA,
        "simulated": dataset.recordings.source.simulated,
        "target": TARGET,
        "n_samples": len(labels),
        "steps": settings.steps,
        "accuracy": float(right.mean()),
        "accuracy_ci95": list(wilson_interval(int(right.sum()), len(labels))),
        "cnn_accuracy": cnn_accuracy,
        "trained_accuracy": trained["accuracy"]["validation"],
        "operations": operations,
        "operations_per_mac": operations / CNN_MACS,
        "cores": len(make_plan(spec).to_json()["cores"]),
        "spikes": {name: float(counts.mean()) for name, counts in responses.spikes.items()},
        "stable_after_median": responses.stable_after_median,
        "seconds": time.perf_counter() - begun,
    }


def pareto_front(costs) -> np.ndarray:
    """Points of the Pareto front: no other is at least as good in every cost and better in one.

    Parameters
    ----------
    costs : array_like, shape (n_points, n_costs)
        The less, the better.

    Returns
    -------
    ndarray of bool, shape (n_points,)
    """
    costs = np.asarray(costs, float)
    no_worse = np.all(costs[:, None] <= costs[None], axis=2)
    better = np.any(costs[:, None] < costs[None], axis=2)
    return ~np.any(no_worse & better, axis=0)


def summarise(points, results) -> dict:
    """Combine the points in one summary, the most accurate first, the failed ones last.

    Parameters
    ----------
    points : list of Point
    results : list of dict or Failure
        From :func:`evaluate`, one per point.
    """
    both = list(zip(points, results, strict=True))
    done = [
        {
            # Results that were read from a file have their entries in another order.
            **{key: result[key] for key in sorted(result) if key != "made_from"},
            "changes": dict(point.changes),
        }
        for point, result in both
        if not isinstance(result, Failure)
    ]
    costs = [(-r["accuracy"], r["operations"], r["cores"], r["steps"]) for r in done]
    for result, on_front in zip(done, pareto_front(costs) if done else (), strict=True):
        result["pareto"] = bool(on_front)
    done.sort(key=lambda r: (-r["accuracy"], r["operations"], r["steps"]))
    return {
        "schema": SCHEMA,
        "target": "fast",
        "part": "validation",
        "names": [name for name, _ in points[0].changes],
        "points": done,
        "failed": [
            {"changes": dict(point.changes), "error": result.error}
            for point, result in both
            if isinstance(result, Failure)
        ],
    }


def measure_sweep(folder: RunFolder, settings: Settings, grid, workers: Workers, say) -> Findings:
    """Train and test the missing points of a sweep, and write the summary.

    Parameters
    ----------
    folder : RunFolder
        Folder of the sweep, locked.  Workers of a cluster without access to it train separately.
    settings : Settings
    grid : sequence of str or None
        As in :func:`points_of`; None for the default of the kind of input.
    workers, say
        As in :func:`pipeline.results.study.study`.

    Raises
    ------
    UserError
        As in :func:`points_of`, or the recordings cannot be read or are too few.
    """
    recordings, kind = recordings_of(settings, workers.processes, say), settings.input.kind
    base = base_settings(fitted_to_inputs(settings, (kind,), recordings, say)[kind])
    dataset = without_test(Dataset.of(base, workers.processes))
    grid = grid or (EVENTS_GRID if settings.on_events else DEFAULT_GRID)
    points = points_of(folder.path.absolute(), base, grid, dataset.recordings)
    begin(folder, base, say)
    results = _measure(points, workers, say)
    failed = sum(isinstance(result, Failure) for result in results)
    summary = summarise(points, results)
    with replacing(folder.path / "sweep.csv", "w") as file:
        file.write(sweep_csv(summary))
    return concluded(
        folder, "sweep", summary, f"{failed} of {len(points)} points" if failed else ""
    )


def _measure(points, workers, say):
    """Results or failures of the points, after the trainings that they share."""
    left = [point for point in points if not point.evaluation.artifact.state().is_current]
    trained = {}
    for label, tasks in (
        ("train cnn", [task for point in left for task in point.trainings[:-1]]),
        ("train for the chip", [point.trainings[-1] for point in left]),
    ):
        shared = {task.name: [task] for task in tasks}
        trained |= study(label, train_network, shared.values(), workers, say)
    failed = {
        point.evaluation.name: trained[task.name]
        for point in points
        for task in point.trainings
        if isinstance(trained.get(task.name), Failure)
    }
    whole = [[point.evaluation] for point in points if point.evaluation.name not in failed]
    found = study("evaluate", evaluate, whole, workers, say) | failed
    return [found[point.evaluation.name] for point in points]
