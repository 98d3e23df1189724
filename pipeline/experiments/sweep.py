"""A sweep: every combination of some settings, judged on validation samples by the fast emulator.

Settings are chosen here, so the test split has no part in it: networks are trained on the training
samples less a validation part, and only that part is shown to them.  What differs in deployment or
presentation only is trained once.
"""

from __future__ import annotations

import functools
import itertools
import re
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import read_json, replacing, write_json
from deploy.preflight.plan import make_plan
from deploy.targets.registry import answer
from pipeline.experiments.study import Findings, Workers, read_kept, study, write_kept
from pipeline.experiments.sweep_text import sweep_csv
from pipeline.inputs.dataset import Dataset
from pipeline.jobs import Failure
from pipeline.paper import CNN_MACS
from pipeline.progress import hidden
from pipeline.run import stages
from pipeline.run.folder import DELETE_ITS_FOLDER, RunFolder, stamp_of
from pipeline.run.stages.stamps import cnn_stamp, trained_stamp
from pipeline.settings import Settings, parse_assignments, put

POINT_SCHEMA = "stmnist-sweep-point/3"
SCHEMA = "stmnist-sweep/2"
VALIDATION = 0.15
"""Share of the training samples that judges, where the settings keep none."""

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
class Point:
    """A combination of settings.

    Attributes
    ----------
    folder : Path
        Of the sweep.
    settings : Settings
    changes : tuple of (str, value)
        What the grid gave to each of its settings.
    stamp : str
        Hash of all that its result depends on.
    cnn, snn : str
        Hashes of what its networks' trainings depend on; on events there is no CNN.
    """

    folder: Path
    settings: Settings
    changes: tuple
    stamp: str
    cnn: str
    snn: str

    @property
    def networks(self) -> Networks:
        """Where its trained networks are."""
        return Networks(self.folder, self.cnn, self.snn)

    @property
    def path(self) -> Path:
        """Where its result is."""
        return self.folder / "points" / f"{self.stamp[:16]}.json"


@dataclass(frozen=True)
class Networks(RunFolder):
    """A run's folder whose networks many points share.

    Attributes
    ----------
    cnn_stamp, snn_stamp : str
    """

    cnn_stamp: str
    snn_stamp: str

    @property
    def cnn(self) -> Path:
        """Weights, history and metrics of the CNN."""
        return self.path / "cnn" / self.cnn_stamp[:16]

    @property
    def snn(self) -> Path:
        """Weights, history and metrics of the network for the chip."""
        return self.path / "snn" / self.snn_stamp[:16]


def base_settings(settings: Settings) -> Settings:
    """The settings with a validation part."""
    fraction = settings.split.validation_fraction or VALIDATION
    return settings.with_values({"split": {"validation_fraction": fraction}}, "sweep")


def points_of(folder: Path, base: Settings, grid) -> list:
    """Every combination of the grid's values.

    Parameters
    ----------
    folder : Path
        Of the sweep.
    base : Settings
        From :func:`base_settings`.
    grid : sequence of str
        Such as ``"presentation.steps=50,100"`` or ``"snn.max_rates=[100,150],[150,150]"``; a single
        number stands for a list of one.

    Returns
    -------
    list of Point

    Raises
    ------
    UserError
        An entry cannot be read, names no setting or one that changes the samples, or a combination
        is out of range.
    """
    axes = [_axis(entry, base) for entry in grid]
    names = [axis[0][0] for axis in axes]
    if len(set(names)) < len(names):
        raise UserError("--grid: a setting is given twice; write all its values in one")
    points = []
    for combination in itertools.product(*axes):
        settings, changes = base, []
        values: dict = {}
        for name, value in combination:
            put(values, name, value, "--grid")
            changes.append((name, value))
        settings = base.with_values(values, "--grid")
        dataset = dataset_of(settings)
        source = dataset.recordings.source.sha256
        points.append(
            Point(
                folder=folder,
                settings=settings,
                changes=tuple(changes),
                stamp=stamp_of(__version__, POINT_SCHEMA, source, asdict(settings)),
                cnn=cnn_stamp(settings, dataset),
                snn=trained_stamp(settings, dataset),
            )
        )
    return points


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
        if isinstance(_setting(base, name), tuple) and not isinstance(value, list):
            value = [value]
        axis.append((name, value))
    return axis


def _setting(settings, name):
    return functools.reduce(lambda part, key: getattr(part, key, None), name.split("."), settings)


def dataset_of(settings: Settings, jobs: int = 1, warn=None) -> Dataset:
    """The samples of a sweep: as for a run, but without a test split.

    Parameters
    ----------
    settings, jobs, warn
        As in :meth:`pipeline.inputs.dataset.Dataset.of`.
    """
    # What does not tell in the samples is left out, so that points share them.
    shown = Settings()
    if settings.on_events:
        shown = replace(shown, presentation=settings.presentation)
    dataset = _dataset_of(
        replace(
            shown,
            **{name: getattr(settings, name) for name in ("seed", "data", "input", "skin")},
            **{name: getattr(settings, name) for name in ("image", "split", "cnn", "events")},
        ),
        jobs,
        warn,
    )
    if not len(dataset.split.validation):
        raise UserError(
            f"{settings.data.source}: too few samples for a validation part of "
            f"{settings.split.validation_fraction:g}; give more data"
        )
    return dataset


@functools.lru_cache(maxsize=4)
def _dataset_of(settings, jobs, warn):
    dataset = Dataset.of(settings, jobs, warn)
    return replace(dataset, split=replace(dataset.split, test=dataset.split.test[:0]))


def train_cnn(point: Point) -> dict:
    """Train a point's CNN, unless it is there."""
    with hidden():
        return stages.train(point.networks, point.settings, _samples(point), _silent)


def train_networks(point: Point):
    """Train a point's networks, unless they are there; a worker may not see who trained its CNN."""
    with hidden():
        stages.train_all(point.networks, point.settings, _samples(point), _silent)


def judge(point: Point) -> dict:
    """Show the validation samples to a point's network on the fast emulator.

    Returns
    -------
    dict
        ``accuracy`` with its interval; of an inference the mean ``operations`` (synaptic), the same
        as ``operations_per_mac`` relative to the multiply-accumulates of the paper's CNN, and
        ``spikes`` by layer; ``cores``; ``decided_at_median``; the accuracies of the CNN (None on
        events) and the network as it was trained on the same samples.
    """
    train_networks(point)
    begun = time.perf_counter()
    settings, networks = point.settings, point.networks
    dataset = _samples(point)
    inputs, labels = dataset.part("validation")
    spec = stages.spec_of(networks, settings, dataset, {})
    responses = answer(spec, inputs, "fast", settings.seed)
    right = responses.predictions == labels
    operations = float(sum(counts.mean() for counts in responses.operations.values()))
    return {
        "schema": POINT_SCHEMA,
        "made_from": point.stamp,
        "changes": dict(point.changes),
        "simulated": dataset.recordings.source.simulated,
        "target": "fast",
        "n_samples": len(labels),
        "steps": settings.steps,
        "accuracy": float(right.mean()),
        "accuracy_ci95": list(wilson_interval(int(right.sum()), len(labels))),
        "cnn_accuracy": None if settings.on_events else _validated(networks.cnn),
        "trained_accuracy": _validated(networks.snn),
        "operations": operations,
        "operations_per_mac": operations / CNN_MACS,
        "cores": len(make_plan(spec).to_json()["cores"]),
        "spikes": {name: float(counts.mean()) for name, counts in responses.spikes.items()},
        "decided_at_median": float(np.median(responses.decided_at)),
        "seconds": time.perf_counter() - begun,
    }


def _validated(folder):
    """Accuracy on the validation samples, as the training measured it."""
    return read_json(folder / "metrics.json", DELETE_ITS_FOLDER)["accuracy"]["validation"]


def pareto_front(costs) -> np.ndarray:
    """Points that no other beats: at least as good in everything and better in something.

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


def summarise(points, results, errors) -> dict:
    """Put the points together, the most accurate first, the failed ones last.

    Parameters
    ----------
    points : list of Point
    results : dict of str to dict
        From :func:`judge`, by the point's stamp.
    errors : dict of str to str
        Of the points that have none.
    """
    # A result may stem from another grid, in which other settings were varied.
    done = [
        {**results[point.stamp], "changes": dict(point.changes)}
        for point in points
        if point.stamp in results
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
            {"changes": dict(point.changes), "error": errors[point.stamp]}
            for point in points
            if point.stamp in errors
        ],
    }


def measure_sweep(folder: RunFolder, settings: Settings, grid, workers: Workers, say) -> Findings:
    """Train and judge what is missing of a sweep, and write it.

    Parameters
    ----------
    folder : RunFolder
        Of the sweep, locked.  Workers of a cluster that do not see it train for themselves.
    settings : Settings
    grid : sequence of str or None
        As in :func:`points_of`; None for the default of the kind of input.
    workers, say
        As in :func:`pipeline.experiments.study.study`.

    Raises
    ------
    UserError
        As in :func:`points_of`, or the recordings cannot be read or are too few.
    """
    base = base_settings(settings)
    dataset_of(base, workers.processes, say)
    grid = grid or (EVENTS_GRID if settings.on_events else DEFAULT_GRID)
    points = points_of(folder.path.absolute(), base, grid)
    folder.save_settings(base)
    results, errors = _measure(points, workers, say)
    summary = summarise(points, results, errors)
    write_json(folder.path / "sweep.json", summary)
    with replacing(folder.path / "sweep.csv", "w") as file:
        file.write(sweep_csv(summary))
    failed = f"{len(errors)} of {len(points)} points failed; the same command tries them again"
    return Findings(summary, failed if errors else "")


def _measure(points, workers, say):
    """Results and errors by stamp: trainings that points share first, then the points."""
    results = {p.stamp: kept for p in points if (kept := read_kept(p)) is not None}
    errors = {}
    images = [point for point in points if not point.settings.on_events]
    for label, function, among, key, keep in (
        ("train cnn", train_cnn, images, lambda point: point.cnn, None),
        ("train for the chip", train_networks, points, lambda point: point.snn, None),
        ("judge", judge, points, lambda point: point.stamp, write_kept),
    ):
        left = [p for p in among if p.stamp not in results and p.stamp not in errors]
        waiting = {key(point): point for point in left}
        answers = study(label, function, waiting.values(), workers, say, keep=keep)
        for what, answer_ in zip(waiting, answers, strict=True):
            if isinstance(answer_, Failure):
                errors.update({p.stamp: answer_.error for p in left if key(p) == what})
            elif keep is not None:
                results[what] = answer_
    return results, errors


def _samples(point):
    """The samples of a point, where it is judged."""
    dataset = dataset_of(point.settings)
    if cnn_stamp(point.settings, dataset) != point.cnn:
        raise UserError(f"{point.settings.data.source}: the worker has other recordings there")
    return dataset


def _silent(line):
    """Of many trainings at a time the progress bar says enough; the metrics are kept."""
