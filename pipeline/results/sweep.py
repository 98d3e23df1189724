"""A sweep: every combination of some settings, tested on validation samples by the fast emulator.

A sweep selects settings, so it does not use the test set: networks are trained on the training
samples without a held-out validation set, and tested on that set.
"""

import functools
import itertools
import re
from collections import defaultdict

import numpy as np

from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import write_json
from deploy.tables import in_blocks, plain
from deploy.targets.registry import TARGETS
from pipeline.kinds import choose_settings, kind_of_network
from pipeline.paper import CNN_MACS
from pipeline.recordings.dataset import dataset_origin
from pipeline.recordings.library import recordings_of
from pipeline.recordings.splits import kind_of
from pipeline.results.study import Case, Workers, study
from pipeline.run.folder import RunFolder
from pipeline.run.settings import Settings, parse_assignments, put

SCHEMA = "stmnist-sweep/3"
# Share of the training samples held out for the evaluation, if the settings have none.
VALIDATION = 0.15

# Stages of a point: the trained network of either input, and the chip's integers.
STAGES = ("rate-lif", "trained", "fast")

# Settings that change which samples there are; points on different ones cannot be compared.
SAMPLES_APART = ("seed", "data", "split", "check")


def points_of(base: Settings, grid) -> list:
    """Every combination of the grid's values.

    Parameters
    ----------
    base : Settings
    grid : sequence of str
        Such as ``"presentation.steps=50,100"`` or ``"snn.max_rates=[100,150],[150,150]"``; a single
        number is taken as a list of one.

    Returns
    -------
    list of (dict, Settings)
        The changed values, and the settings with them.

    Raises
    ------
    UserError
        An entry cannot be read, names no setting or one that changes the samples, or a combination
        is out of range.
    """
    _ = kind_of_network(base).trained  # an error if the network is not trained here
    axes = [_axis(entry, base) for entry in grid]
    names = [axis[0][0] for axis in axes]
    if len(set(names)) < len(names):
        raise UserError("--grid: a setting is given twice; write all its values in one")
    points = []
    for combination in itertools.product(*axes):
        values: dict = {}
        for name, value in combination:
            put(values, name, value, "--grid")
        points.append((dict(combination), base.with_values(values, "--grid")))
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
        if (name, value) not in axis:
            axis.append((name, value))
    return axis


def measure_sweep(folder: RunFolder, settings: Settings, grid, workers: Workers, say) -> tuple:
    """Train and test the missing points of a sweep; write ``sweep.json``.

    Parameters
    ----------
    folder : RunFolder
        Folder of the sweep, locked.
    settings : Settings
    grid : sequence of str or None
        As in :func:`points_of`; None for the default of the kind of input.
    workers, say
        As in :func:`pipeline.results.study.study`.

    Returns
    -------
    summary : dict
        See :func:`summarise`.
    failed : str
        The failed points, in one line; empty if nothing failed.

    Raises
    ------
    UserError
        As in :func:`points_of`, or the recordings cannot be read or are too few.
    """
    recordings = recordings_of(settings, workers.processes, say)
    fraction = settings.split.validation_fraction or VALIDATION
    divided = settings.with_values({"split": {"validation_fraction": fraction}}, "sweep")
    base = choose_settings(divided, recordings)
    split, kind = kind_of(base.split.kind, recordings), kind_of_network(base)
    said = defaultdict(list)  # the points that each line is about
    points = points_of(divided, grid or kind.grid)
    cases, unused = [], set(points[0][0])
    for number, (changes, asked) in enumerate(points):
        lines = []
        of_point = choose_settings(asked, recordings, say=lines.append)
        own = kind_of_network(of_point)
        own.require_fit(recordings)
        origin = dataset_origin(of_point, recordings.source.sha256, split)
        unused -= own.bundle_origin(origin).settings.keys()
        for line in (*lines, *own.notes(recordings)):
            said[line].append(changes)
        for stage in STAGES:
            if stage in own.references or stage in TARGETS:
                name = f"point-{number}-{stage}"
                cases.append(Case(name, of_point, stage, base.seed, split, part="validation"))
    if unused:
        raise UserError(f"--grid: {min(unused)} has no effect on these networks; leave it out")
    for line, about in said.items():
        where = ", ".join(f"{k}={v}" for k, v in about[0].items() if all(c[k] == v for c in about))
        say(line if len(about) == len(points) else f"{line} ({where or 'some points'})")
    (folder.path / "rows").mkdir(exist_ok=True)  # from now on the folder is no run
    folder.save_settings(base, settings)
    rows, failed = study(cases, folder.path, recordings.source.sha256, workers, say)
    errors = {case.name.split("-")[1]: error for case, error in failed.items()}  # of each point
    complete = [row for row in rows if row["name"].split("-")[1] not in errors]
    summary = summarise([changes for changes, _ in points], complete)
    summary["failed"] = [
        {"changes": points[int(number)][0], "error": error} for number, error in errors.items()
    ]
    write_json(folder.path / "sweep.json", summary)
    return summary, f"{len(errors)} of {len(points)} points failed" if errors else ""


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


def summarise(changes, rows) -> dict:
    """Combine the points in one summary, the most accurate first.

    Parameters
    ----------
    changes : list of dict
        The changed settings of each point.
    rows : list of dict
        From :func:`pipeline.results.study.study`, those of failed points left out.
    """
    by_name = {row["name"]: row for row in rows}
    points = []
    for number, values in enumerate(changes):
        stages = {stage: by_name.get(f"point-{number}-{stage}") for stage in STAGES}
        chip, trained = stages.pop("fast"), next(filter(None, stages.values()), None)
        if chip is None:
            continue
        right = chip["right"]
        points.append(
            {
                "changes": values,
                "accuracy": chip["accuracy"],
                "accuracy_ci95": list(wilson_interval(sum(right), len(right))),
                "trained_accuracy": trained and trained["accuracy"],
                "n_samples": len(right),
                "simulated": chip["simulated"],
                **chip["costs"],
            }
        )
    costs = [(-p["accuracy"], p["operations"], p["cores"], p["steps"]) for p in points]
    for point, on_front in zip(points, pareto_front(costs) if points else (), strict=True):
        point["pareto"] = bool(on_front)
    points.sort(key=lambda p: (-p["accuracy"], p["operations"], p["steps"]))
    return {"schema": SCHEMA, "part": "validation", "names": list(changes[0]), "points": points}


def sweep_text(sweep: dict) -> str:
    """The points as a table, those of the Pareto front marked."""
    points, lines = sweep["points"], []
    for point in sweep["failed"]:
        changed = ", ".join(f"{k}={plain(v)}" for k, v in point["changes"].items())
        lines.append(f"failed: {changed}: {point['error']}")
    if not points:
        return "\n".join(lines)
    kind = "simulated validation samples" if points[0]["simulated"] else "validation samples"
    heads = ["accuracy", "95 % interval", "operations", "cores", "presented", "trained"]
    rows = [["", "#", *heads, *sweep["names"]]]
    for number, point in enumerate(points, 1):
        trained = point["trained_accuracy"]
        rows.append(
            [
                *("*" if point["pareto"] else "", str(number), f"{point['accuracy']:.3f}"),
                *("{:.3f} to {:.3f}".format(*point["accuracy_ci95"]), f"{point['per_cnn']:.2f} x"),
                *(str(point["cores"]), str(point["steps"])),
                "" if trained is None else f"{trained:.3f}",
                *(plain(point["changes"][name]) for name in sweep["names"]),
            ]
        )
    return "\n".join(
        [
            f"{len(points)} points, each on the same {points[0]['n_samples']} {kind}",
            *in_blocks(rows, left=2),
            "* on the Pareto front: no other point is at least as good in accuracy,",
            "operations, cores and steps and better in one of them",
            f"operations: synaptic, per inference, in multiples of the paper's CNN's {CNN_MACS:,}",
            "presented: steps per sample; trained: accuracy of the network before the chip",
            *lines,
        ]
    )
