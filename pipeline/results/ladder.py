"""The loss ladder: the stages from CNN to chip on the same samples, one row per stage."""

import hashlib
import itertools
import json

import numpy as np

from deploy.check.results import compare_results, read_result
from deploy.files import reporting_damage
from deploy.tables import SIGNIFICANCE, align_rows, list_names, p_text, star
from deploy.targets.registry import TARGETS
from deploy.terminal import WARNING
from pipeline.kinds import TRAINED_STAGES, NetworkKind, find_compared_stage
from pipeline.kinds.diagnosis import layers_text, least_faithful
from pipeline.progress import progress
from pipeline.run.artifacts import DELETE_IT, Artifact, Origin
from pipeline.run.folder import RunFolder
from pipeline.stages import OpenedRun, check_stages, convert

# Targets whose existing results are included, but which the ladder does not run.
BOARDS = tuple(name for name, target in TARGETS.items() if target.hardware)

# What may help against a loss at the first stage in which samples follow each other in streams.
STREAM_REMEDY = {
    "nengo": (
        ": here samples first follow each other in a stream and may disturb each other; try a "
        "longer gap (--set presentation.gap=...) or each sample from rest (--set "
        "presentation.stream_length=1)"
    )
}

# Loss in points above which the layers are listed.
MAX_LOSS_POINTS = 3.0


def ladder_stages(kind: NetworkKind) -> list:
    """Stages of the ladder of a kind, in order."""
    targets = [target.name for target in TARGETS.values() if target.in_ladder]
    return [*kind.reference_stages, *targets]


def measure_ladder(opened: OpenedRun, jobs: int = 1, asked=None) -> dict:
    """Make the missing artifacts of a run up to the emulator, and compare the stages.

    Parameters
    ----------
    opened : pipeline.stages.opening.OpenedRun
        Of a run, which is locked.
    jobs : int
        Number of processes for targets.
    asked : sequence of str, optional
        Stages of the ladder; default: :func:`ladder_stages`.

    Returns
    -------
    dict
        See :func:`ladder_json`.
    """
    run = opened.run
    bundle = convert(opened)
    asked = asked or [stage for stage in ladder_stages(opened.kind) if stage not in BOARDS]
    results = check_stages(opened, bundle, asked, jobs)
    # A board's result is included if it exists and belongs to this bundle.
    for board in map(run.check, BOARDS):
        if board.exists() and (result := read_result(board))["bundle"] == bundle.id:
            results.append(result)
    artifact = ladder_artifact(run, results)
    state = artifact.state()
    if state.is_current:
        with reporting_damage(artifact.record, DELETE_IT):
            ladder_text(state.record)  # an error if damaged
            if state.record["layers"]:
                layers_text(state.record["layers"])
        return state.record
    inputs = opened.step_inputs(bundle.spec.provenance["made_from"]["settings"])
    with progress("compare layers", len(bundle.checks)) as advance:
        layers = opened.kind.fidelity(inputs, bundle, advance)
    classes = opened.dataset.recordings.sensor.classes
    return artifact.write(ladder_json(results, layers, classes, opened.kind.remedy))


def ladder_artifact(run: RunFolder, results) -> Artifact:
    """The loss ladder of check results."""
    contents = {
        f"checks/{result['target']}": _hash_of([result["bundle"], result["samples"]])
        for result in results
    }
    return Artifact("ladder", run.ladder, Origin(contents=contents))


def _hash_of(value):
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def ladder_rows(results) -> list:
    """Compare each result with the previous one, and none with ``counts``, the simplest baseline.

    Parameters
    ----------
    results : sequence of dict
        Check results of the same bundle, in the order of the stages.

    Returns
    -------
    list of dict
        The ladder's rows: ``stage``, ``accuracy``, ``accuracy_ci95`` (Wilson's interval);
        compared with the stage above, and None in the first row and below ``counts``: ``change`` of
        the accuracy, number of ``disagreements`` of the predictions, and ``mcnemar_p`` of the exact
        test.

    Raises
    ------
    UserError
        The results are of different bundles or samples.
    """
    rows = []
    for above, result in itertools.pairwise([None, *results]):
        is_first = above is None or above["target"] == "counts"
        against = None if is_first else compare_results(above, result)
        rows.append(
            {
                "stage": result["target"],
                "accuracy": result["accuracy"],
                "accuracy_ci95": list(result["accuracy_ci95"]),
                "change": against and 0.0 - against.accuracy_drop,
                "disagreements": against and len(against.disagreements),
                "mcnemar_p": against and against.p_value,
            }
        )
    return rows


def select_deployed_result(results) -> dict:
    """The result of the deployed network on the target that is nearest to the chip.

    Parameters
    ----------
    results : sequence of dict
        As in :func:`ladder_rows`.
    """
    return results[-1]


def confusion_matrix(labels, predictions, classes: int = 10) -> np.ndarray:
    """Count samples by label (row) and prediction (column).

    Parameters
    ----------
    labels, predictions : sequence of int
    classes : int

    Returns
    -------
    ndarray of int, shape (classes, classes)
    """
    matrix = np.zeros((classes, classes), int)
    np.add.at(matrix, (np.asarray(labels, int), np.asarray(predictions, int)), 1)
    return matrix


def ladder_json(results, layers=None, classes=None, remedy: str = "") -> dict:
    """The ladder as plain values.

    Parameters
    ----------
    results : sequence of dict
        As in :func:`ladder_rows`.
    layers : list of dict, optional
        From :func:`pipeline.kinds.diagnosis.layers_json`.
    classes : sequence of str, optional
        Class names in the order of the scores; default: numbers from 0.
    remedy : str
        What to try if the network is less accurate than ``counts``.
    """
    first = results[0]
    if classes is None:
        classes = map(str, range(len(first["samples"][0]["scores"])))
    classes = list(classes)
    presented = {sample["label"] for sample in first["samples"]}
    by_stage = {result["target"]: result for result in results}
    trained = next((result for result in results if result["target"] in TRAINED_STAGES), None)
    reference = by_stage[find_compared_stage(by_stage)]
    deployed = select_deployed_result(results)
    return {
        "schema": "stmnist-ladder/1",
        "bundle": first["bundle"],
        "simulated": first["simulated"],
        "n_samples": first["n_samples"],
        "classes": classes,
        "classes_without_samples": [
            name for label, name in enumerate(classes) if label not in presented
        ],
        "rows": ladder_rows(results),
        "last_against_trained_p": trained and compare_results(trained, deployed).p_value,
        "against_reference": _against(reference, deployed),
        "against_counts": _against(by_stage.get("counts"), deployed),
        "while_written": deployed.get("while_written"),
        "remedy": remedy,
        "layers": layers,
        "least_faithful_layer": layers and least_faithful(layers),
    }


def _against(other, deployed):
    """Comparison of the deployed network with another; None without that."""
    if other is None or other is deployed:
        return None
    compared = compare_results(other, deployed)
    return {"difference": 0.0 - compared.accuracy_drop, "mcnemar_p": compared.p_value}


def early_text(value: dict, row: dict) -> str:
    """Accuracy and time of early decisions, in one line.

    Parameters
    ----------
    value : dict
        ``while_written`` of a result.
    row : dict
        The ladder's row of that result.
    """
    early = value["by_itself"]
    if early["confidence"] >= 1:
        return f"{row['stage']}: decides at the end of each recording, not earlier"
    return (
        f"{row['stage']}: early decision at a confidence of {early['confidence']:.4f}, after "
        f"{early['share_of_writing_mean']:.0%} of the recording on average: "
        f"accuracy {early['accuracy']:.3f}, "
        + points_text(100 * (early["accuracy"] - row["accuracy"]))
    )


def losing_stages(ladder: dict) -> list:
    """Find the stages that lose more than :data:`MAX_LOSS_POINTS` points, as (from, to, points).

    Stages from the trained network on (the rate-based network, or the one trained on events) are
    compared with the stage above, and the last one also with the trained network.  Losses that are
    not significant (McNemar's test, p of :data:`SIGNIFICANCE` or more) do not count.
    """
    stages = [row["stage"] for row in ladder["rows"]]
    trained = next((index for index, name in enumerate(stages) if name in TRAINED_STAGES), None)
    if trained is None:
        return []
    rows = ladder["rows"][trained:]
    pairs = [(a, b, b["mcnemar_p"]) for a, b in itertools.pairwise(rows)]
    if len(rows) > 2:
        pairs.append((rows[0], rows[-1], ladder.get("last_against_trained_p", 0.0)))
    drops = [
        (a["stage"], b["stage"], 100 * (a["accuracy"] - b["accuracy"]))
        for a, b, p_value in pairs
        if p_value < SIGNIFICANCE
    ]
    return [(a, b, points) for a, b, points in drops if points > MAX_LOSS_POINTS + 1e-9]


def ladder_text(ladder: dict) -> str:
    """The ladder, from :func:`ladder_json`, as a table; with the layers if a stage loses much."""
    what = "simulated samples" if ladder["simulated"] else "samples"
    table = [["stage", "accuracy", "95 % interval", "change", "disagree", "McNemar p", ""]]
    table += [_cells(row) for row in ladder["rows"]]
    by_stage = {row["stage"]: row for row in ladder["rows"]}
    last = ladder["rows"][-1]
    first = by_stage[find_compared_stage(by_stage)]
    lines = [
        f"Loss ladder, {ladder['n_samples']} {what}, the same for each stage",
        *align_rows(table),
    ]
    compared = {first["stage"]: ladder["against_reference"]}
    compared["counts"] = simplest = ladder["against_counts"]
    for stage, against in compared.items():
        if against is not None:
            change = points_text(100 * against["difference"])
            p_value = p_text(against["mcnemar_p"])
            lines.append(f"from {stage} to {last['stage']}: {change}, p {p_value}")
    if any(cells[-1] for cells in table):
        lines.append(f"*: p below {SIGNIFICANCE:g}, uncorrected for several tests")
    for stage in (row["stage"] for row in ladder["rows"]):
        if stage in TARGETS and TARGETS[stage].note:
            lines.append(f"{stage}: {TARGETS[stage].note}")
    if ladder.get("while_written"):
        lines.append(early_text(ladder["while_written"], last))
    if absent := ladder.get("classes_without_samples"):
        lines.append(
            f"{WARNING}no samples of {list_names(absent)}; no accuracy says anything about them"
        )
    losing = losing_stages(ladder)
    for a, b, points in losing:
        lines.append(f"{WARNING}{b} is {points:.1f} points below {a}{STREAM_REMEDY.get(b, '')}")
    if losing and ladder["layers"]:
        lines += ["", layers_text(ladder["layers"])]
    if simplest and simplest["difference"] < 0 and simplest["mcnemar_p"] < SIGNIFICANCE:
        lines.append(
            f"{WARNING}{last['stage']} is less accurate than the logistic regression on event "
            f"counts; try {ladder.get('remedy') or 'more epochs'}"
        )
    return "\n".join(lines)


def _cells(row: dict) -> list:
    """The cells of a stage in the table."""
    low, high = row["accuracy_ci95"]
    cells = [row["stage"], f"{row['accuracy']:.3f}", f"{low:.3f} to {high:.3f}"]
    if row["change"] is None:
        return [*cells, "", "", "", ""]
    return [
        *cells,
        f"{round(row['change'], 3) + 0.0:+.3f}",  # no change is +0.000
        str(row["disagreements"]),
        p_text(row["mcnemar_p"]),
        star(row["mcnemar_p"]),
    ]


def points_text(points: float) -> str:
    """Format a difference of accuracies in points; a loss is negative."""
    return f"{round(points, 1) + 0.0:+.1f} points"
