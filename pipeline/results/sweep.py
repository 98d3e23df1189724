"""A sweep: every combination of some settings, tested on validation samples by the fast emulator.

A sweep selects settings, so it does not use the test set: networks are trained on the training
samples without a held-out validation set, and tested on that set.
"""

import functools
import itertools
import re
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.files import write_json
from deploy.tables import align_in_blocks, format_value
from pipeline.kinds.preparation import choose_settings, prepare_dataset
from pipeline.kinds.registry import find_kind
from pipeline.paper import CNN_MACS
from pipeline.results.study import Case, Workers, run_study
from pipeline.settings import Provenance, Settings, parse_assignments, set_nested
from pipeline.sources import load_named_recordings
from pipeline.storage.run_folder import RunFolder

SCHEMA = "stmnist-sweep/3"
# Share of the training samples held out for the evaluation, if the settings have none.
VALIDATION_FRACTION = 0.15

# The target that has the chip's integers and takes the least time.
SWEEP_TARGET = "fast"

# Settings that change which samples there are; points on different ones cannot be compared.
SAMPLE_SETTINGS = ("seed", "data", "split", "check")


def make_points(base: Settings, grid) -> list:
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
    _ = find_kind(base).trained_steps  # an error if the network is not trained here
    axes = [_read_axis(entry, base) for entry in grid]
    names = [axis[0][0] for axis in axes]
    if len(set(names)) < len(names):
        raise UserError("--grid: a setting is given twice; write all its values in one")
    points = []
    for combination in itertools.product(*axes):
        values: dict = {}
        for name, value in combination:
            set_nested(values, name, value, "--grid")
        points.append((dict(combination), base.with_values(values, "--grid")))
    return points


def _read_axis(entry, base):
    """[(name, value), ...] of a grid's entry."""
    name, equals, text = entry.partition("=")
    name = name.strip()
    pieces = [piece.strip() for piece in re.split(r",(?![^\[]*\])", text)]
    if not equals or not name or not all(pieces):
        raise UserError(f"--grid {entry!r}: expected section.name=value,value,...")
    if name.partition(".")[0] in SAMPLE_SETTINGS:
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


@dataclass(frozen=True)
class Point:
    """A combination of the grid's values.

    Attributes
    ----------
    changes : dict
        The changed settings by their dotted names.
    cases : dict of str to Case
        The case of each stage.
    network_settings : frozenset of str
        Settings that the network of this point depends on.
    notes : tuple of str
        What was chosen for the recordings, and what the user should know of them.
    """

    changes: dict
    cases: dict
    network_settings: frozenset
    notes: tuple


def measure_sweep(folder: RunFolder, settings: Settings, grid, workers: Workers, say) -> tuple:
    """Train and test the missing points of a sweep; write ``sweep.json``.

    Parameters
    ----------
    folder : RunFolder
        Folder of the sweep, locked.
    settings : Settings
    grid : sequence of str or None
        As in :func:`make_points`; None for the default of the kind of input.
    workers, say
        As in :func:`pipeline.results.study.run_study`.

    Returns
    -------
    summary : dict
        See :func:`summarise`.
    failed : str
        The failed points, in one line; empty if nothing failed.

    Raises
    ------
    UserError
        As in :func:`make_points`, or the recordings cannot be read or are too few.
    """
    recordings = load_named_recordings(settings, workers.processes, say)
    fraction = settings.split.validation_fraction or VALIDATION_FRACTION
    # A sweep needs validation samples, also where the user has set that there are none.
    held_out = {"split.validation_fraction": fraction}
    divided = settings.with_named_values(held_out, "sweep", Provenance.CHOSEN)
    base = choose_settings(divided, recordings)
    combinations = make_points(divided, grid or find_kind(base).grid)
    points = [
        _prepare_point(number, changes, point_settings, recordings)
        for number, (changes, point_settings) in enumerate(combinations)
    ]
    unused = set(points[0].changes).difference(*(point.network_settings for point in points))
    if unused:
        raise UserError(f"--grid: {min(unused)} has no effect on these networks; leave it out")
    for line in _join_notes(points):
        say(line)
    (folder.path / "rows").mkdir(exist_ok=True)  # from now on the folder is no run
    folder.save_settings(base)
    cases = [case for point in points for case in point.cases.values()]
    rows, failed = run_study(cases, folder.path, recordings.source.sha256, workers, say)
    summary = summarise(points, {row["name"]: row for row in rows}, failed)
    write_json(folder.path / "sweep.json", summary)
    n_failed = len(summary["failed"])
    return summary, f"{n_failed} of {len(points)} points failed" if n_failed else ""


def _prepare_point(number, changes, settings, recordings) -> Point:
    """Choose the settings of a point, and list its cases."""
    notes: list = []
    dataset = prepare_dataset(settings, recordings, say=notes.append)
    resolved = dataset.settings
    network = find_kind(resolved)
    stages = (network.deployed_stage, SWEEP_TARGET)
    cases = {
        stage: Case(
            name=f"point-{number}-{stage}",
            settings=resolved,
            stage=stage,
            seed=resolved.seed,
            split=dataset.split.kind,
            part="validation",
        )
        for stage in stages
    }
    network_settings = frozenset(network.make_bundle_origin(dataset.origin).settings)
    return Point(changes, cases, network_settings, (*notes, *network.list_notes(recordings)))


def _join_notes(points):
    """Each note once, with the settings that its points have in common unless it is about all."""
    about = defaultdict(list)
    for point in points:
        for note in point.notes:
            about[note].append(point.changes)
    for note, changes in about.items():
        if len(changes) == len(points):
            yield note
            continue
        shared = dict(changes[0])
        for others in changes[1:]:
            shared = {name: value for name, value in shared.items() if others[name] == value}
        text = ", ".join(f"{name}={value}" for name, value in shared.items())
        yield f"{note} ({text or 'some points'})"


def find_pareto_front(costs) -> np.ndarray:
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


def summarise(points, rows: dict, failed: dict) -> dict:
    """Combine the points in one summary, the most accurate first.

    Parameters
    ----------
    points : sequence of Point
    rows : dict of str to dict
        Rows of :func:`pipeline.results.study.run_study` by their names.
    failed : dict of Case to str
        The errors of the cases that failed; their points are not among the others.
    """
    measured = []
    errors = []
    for point in points:
        problems = [failed[case] for case in point.cases.values() if case in failed]
        if problems:
            errors.append({"changes": point.changes, "error": problems[-1]})
            continue
        by_stage = {
            stage: rows[case.name] for stage, case in point.cases.items() if case.name in rows
        }
        if SWEEP_TARGET in by_stage:
            measured.append(_summarise_point(point.changes, by_stage))
    costs = [(-p["accuracy"], p["operations"], p["cores"], p["steps"]) for p in measured]
    for entry, on_front in zip(measured, find_pareto_front(costs) if measured else (), strict=True):
        entry["pareto"] = bool(on_front)
    measured.sort(key=lambda p: (-p["accuracy"], p["operations"], p["steps"]))
    return {
        "schema": SCHEMA,
        "part": "validation",
        "names": list(points[0].changes),
        "points": measured,
        "failed": errors,
    }


def _summarise_point(changes, by_stage) -> dict:
    """The entry of a point in the summary, from the rows of its stages."""
    chip = by_stage[SWEEP_TARGET]
    accuracies = [row["accuracy"] for stage, row in by_stage.items() if stage != SWEEP_TARGET]
    right = chip["right"]
    return {
        "changes": changes,
        "accuracy": chip["accuracy"],
        "accuracy_ci95": list(compute_wilson_interval(sum(right), len(right))),
        "trained_accuracy": accuracies[0] if accuracies else None,
        "n_samples": len(right),
        "simulated": chip["simulated"],
        **chip["costs"],
    }


def format_sweep(sweep: dict) -> str:
    """The points as a table, those of the Pareto front marked."""
    points = sweep["points"]
    lines = []
    for point in sweep["failed"]:
        changed = ", ".join(f"{k}={format_value(v)}" for k, v in point["changes"].items())
        lines.append(f"failed: {changed}: {point['error']}")
    if not points:
        return "\n".join(lines)
    samples = "simulated validation samples" if points[0]["simulated"] else "validation samples"
    heads = ["accuracy", "95 % interval", "operations", "cores", "presented", "trained"]
    rows = [["", "#", *heads, *sweep["names"]]]
    for number, point in enumerate(points, 1):
        trained = point["trained_accuracy"]
        low, high = point["accuracy_ci95"]
        rows.append(
            [
                "*" if point["pareto"] else "",
                str(number),
                f"{point['accuracy']:.3f}",
                f"{low:.3f} to {high:.3f}",
                f"{point['per_cnn']:.2f} x",
                str(point["cores"]),
                str(point["steps"]),
                "" if trained is None else f"{trained:.3f}",
                *(format_value(point["changes"][name]) for name in sweep["names"]),
            ]
        )
    return "\n".join(
        [
            f"{len(points)} points, each on the same {points[0]['n_samples']} {samples}",
            *align_in_blocks(rows, left=2),
            "* on the Pareto front: no other point is at least as good in accuracy,",
            "operations, cores and steps and better in one of them",
            f"operations: synaptic, per inference, in multiples of the paper's CNN's {CNN_MACS:,}",
            "presented: steps per sample; trained: accuracy of the network before the chip",
            *lines,
        ]
    )
