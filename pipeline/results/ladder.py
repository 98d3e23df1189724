"""The loss ladder: the accuracy of each stage, from the CNN to the chip, on the same samples."""

import hashlib
import itertools
import json
from dataclasses import replace

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.comparison import compare_results
from deploy.check.results import CheckResult, EarlyDecisions, read_result
from deploy.check.text import describe_absent_classes
from deploy.files import reporting_damage
from deploy.loading import dump_dataclass
from deploy.tables import SIGNIFICANCE, align_rows, format_p, mark_significance
from deploy.targets.registry import TARGETS, list_ladder_targets
from deploy.terminal import WARNING
from pipeline.kinds.diagnosis import find_least_faithful, format_layers
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.registry import find_compared_stage, list_trained_stages
from pipeline.progress import progress
from pipeline.results.ladder_result import AccuracyChange, LadderResult, LadderRow
from pipeline.storage.artifacts import DELETE_IT, Artifact, Origin
from pipeline.storage.run_folder import RunFolder
from pipeline.workflow import OpenedRun, check_stages, convert

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


def list_boards() -> list:
    """Targets whose existing results are included, but which the ladder does not run."""
    return [name for name, target in TARGETS.items() if target.needs_board]


def list_stages(kind: NetworkKind) -> list:
    """Stages of the ladder of a kind, in order."""
    return [*kind.reference_stages, *list_ladder_targets()]


def measure_ladder(opened: OpenedRun, jobs: int = 1, stages=None) -> LadderResult:
    """Make the missing artifacts of a run up to the emulator, and compare the stages.

    Parameters
    ----------
    opened : pipeline.workflow.opening.OpenedRun
        A run, which is locked.
    jobs : int
        Number of processes for targets.
    stages : sequence of str, optional
        Stages of the ladder; default: :func:`list_stages` without boards.

    Returns
    -------
    LadderResult
    """
    bundle = convert(opened)
    if not stages:
        stages = [stage for stage in list_stages(opened.kind) if stage not in list_boards()]
    results = check_stages(opened, bundle, stages, jobs)
    results += read_board_results(opened.run, bundle.id)
    artifact = find_ladder_artifact(opened.run, results)
    state = artifact.find_state()
    if state.is_current:
        with reporting_damage(artifact.record, DELETE_IT):
            ladder = LadderResult.from_dict(state.record)
            require_complete(ladder)
        return ladder
    layers = compare_layers(opened, bundle)
    classes = opened.dataset.recordings.sensor.classes
    ladder = make_ladder(results, layers, classes, opened.kind.remedy)
    return LadderResult.from_dict(artifact.write(ladder.to_dict()))


def read_board_results(run: RunFolder, bundle_id: str) -> list:
    """The existing check results of a bundle on boards."""
    files = [file for file in map(run.find_check_file, list_boards()) if file.exists()]
    return [result for result in map(read_result, files) if result.bundle_id == bundle_id]


def compare_layers(opened: OpenedRun, bundle: Bundle) -> list | None:
    """Compare firing rates with activations; see :meth:`NetworkKind.compare_layers`."""
    inputs = opened.make_step_inputs(bundle.spec.provenance.settings)
    with progress("compare layers", len(bundle.checks)) as advance:
        return opened.kind.compare_layers(inputs, bundle, advance)


def require_complete(ladder: LadderResult):
    """Raise an error if a stored ladder lacks values that its texts need."""
    format_ladder(ladder)
    if ladder.layers:
        format_layers(ladder.layers)


def find_ladder_artifact(run: RunFolder, results) -> Artifact:
    """The loss ladder as an artifact, which is made from check results."""
    contents = {f"checks/{result.target}": _hash_samples(result) for result in results}
    return Artifact("ladder", run.ladder, Origin(contents=contents))


def _hash_samples(result):
    samples = [dump_dataclass(sample) for sample in result.samples]
    text = json.dumps([result.bundle_id, samples], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def make_rows(results) -> list:
    """Compare each result with that of the stage above.

    The row below ``counts`` has no comparison, since no later stage is derived from it.

    Parameters
    ----------
    results : sequence of CheckResult
        Results of the same bundle, in the order of the stages.

    Returns
    -------
    list of LadderRow

    Raises
    ------
    UserError
        The results are of different bundles or samples.
    """
    rows = []
    for above, result in itertools.pairwise([None, *results]):
        row = LadderRow(
            stage=result.target,
            accuracy=result.accuracy,
            accuracy_ci95=tuple(result.accuracy_ci95),
        )
        if above is not None and above.target != "counts":
            compared = compare_results(above, result)
            row = replace(
                row,
                change=compared.accuracy_change,
                disagreements=len(compared.disagreements),
                mcnemar_p=compared.p_value,
            )
        rows.append(row)
    return rows


def select_deployed_result(results) -> CheckResult:
    """The result of the deployed network on the target that is nearest to the chip.

    Parameters
    ----------
    results : sequence of CheckResult
        As in :func:`make_rows`.
    """
    return results[-1]


def count_confusions(labels, predictions, n_classes: int = 10) -> np.ndarray:
    """Count samples by label (row) and prediction (column).

    Parameters
    ----------
    labels, predictions : sequence of int
    n_classes : int

    Returns
    -------
    ndarray of int, shape (classes, classes)
    """
    matrix = np.zeros((n_classes, n_classes), int)
    np.add.at(matrix, (np.asarray(labels, int), np.asarray(predictions, int)), 1)
    return matrix


def make_ladder(results, layers=None, classes=None, remedy: str = "") -> LadderResult:
    """The ladder of some check results.

    Parameters
    ----------
    results : sequence of CheckResult
        As in :func:`make_rows`.
    layers : list of dict, optional
        From :func:`pipeline.kinds.diagnosis.compare_rates`.
    classes : sequence of str, optional
        Class names in the order of the scores; default: numbers from 0.
    remedy : str
        What to try if the network is less accurate than ``counts``.
    """
    first = results[0]
    if classes is None:
        classes = map(str, range(len(first.samples[0].scores)))
    classes = list(classes)
    by_stage = {result.target: result for result in results}
    reference = by_stage[find_compared_stage(by_stage)]
    deployed = select_deployed_result(results)
    return LadderResult(
        bundle=first.bundle_id,
        simulated=first.simulated,
        n_samples=first.n_samples,
        classes=classes,
        classes_without_samples=_find_classes_without_samples(classes, first),
        rows=make_rows(results),
        last_against_trained_p=_test_against_trained(results),
        against_reference=_compare_with_deployed(reference, deployed),
        against_counts=_compare_with_deployed(by_stage.get("counts"), deployed),
        while_written=deployed.while_written,
        remedy=remedy,
        layers=layers,
        least_faithful_layer=find_least_faithful(layers) if layers else None,
    )


def _find_classes_without_samples(classes, result):
    presented = {sample.label for sample in result.samples}
    return [name for label, name in enumerate(classes) if label not in presented]


def _test_against_trained(results):
    """The p-value of the deployed network against the trained one; None without a trained one."""
    for result in results:
        if result.target in list_trained_stages():
            return compare_results(result, select_deployed_result(results)).p_value
    return None


def _compare_with_deployed(other, deployed):
    """The change of accuracy from another stage to the deployed network; None if they are one."""
    if other is None or other is deployed:
        return None
    compared = compare_results(other, deployed)
    return AccuracyChange(compared.accuracy_change, compared.p_value)


def describe_early_decisions(early: EarlyDecisions, row: LadderRow) -> str:
    """Accuracy and time of early decisions, in one line.

    Parameters
    ----------
    early : EarlyDecisions
    row : LadderRow
        The row of the result that they are from.
    """
    if not early.are_possible:
        return f"{row.stage}: decides at the end of each recording, not earlier"
    return (
        f"{row.stage}: early decision at a confidence of {early.confidence:.4f}, after "
        f"{early.share_of_writing_mean:.0%} of the recording on average: "
        f"accuracy {early.accuracy:.3f}, " + format_points(100 * (early.accuracy - row.accuracy))
    )


def find_losing_stages(ladder: LadderResult) -> list:
    """Find the stages that lose more than :data:`MAX_LOSS_POINTS` points, as (from, to, points).

    Stages from the trained network on (the rate-based network, or the one trained on events) are
    compared with the stage above, and the last one also with the trained network.  Losses that are
    not significant (McNemar's test, p of :data:`SIGNIFICANCE` or more) do not count.
    """
    stages = [row.stage for row in ladder.rows]
    trained = next(
        (index for index, name in enumerate(stages) if name in list_trained_stages()), None
    )
    if trained is None:
        return []
    rows = ladder.rows[trained:]
    pairs = [(a, b, b.mcnemar_p) for a, b in itertools.pairwise(rows)]
    if len(rows) > 2:
        pairs.append((rows[0], rows[-1], ladder.last_against_trained_p))
    drops = [
        (a.stage, b.stage, 100 * (a.accuracy - b.accuracy))
        for a, b, p_value in pairs
        if p_value is not None and p_value < SIGNIFICANCE
    ]
    # A loss of exactly the maximum is not above it, whatever the rounding.
    return [(a, b, points) for a, b, points in drops if points > MAX_LOSS_POINTS + 1e-9]


def format_ladder(ladder: LadderResult) -> str:
    """The ladder as a table; with the layers if a stage loses much."""
    return "\n".join(
        [
            *_format_table(ladder),
            *_describe_changes(ladder),
            *_describe_notes(ladder),
            *_describe_losses(ladder),
            *_compare_with_baseline(ladder),
        ]
    )


def _format_table(ladder):
    samples = "simulated samples" if ladder.simulated else "samples"
    headings = ["stage", "accuracy", "95 % interval", "change", "disagree", "McNemar p", ""]
    return [
        f"Loss ladder, {ladder.n_samples} {samples}, the same for each stage",
        *align_rows([headings, *map(_make_cells, ladder.rows)]),
    ]


def _describe_changes(ladder):
    """Lines about the change from a reference to the last stage, one for each reference."""
    stages = [row.stage for row in ladder.rows]
    changes = {
        find_compared_stage(stages): ladder.against_reference,
        "counts": ladder.against_counts,
    }
    return [
        f"from {stage} to {stages[-1]}: {format_points(100 * change.difference)}, "
        f"p {format_p(change.mcnemar_p)}"
        for stage, change in changes.items()
        if change is not None
    ]


def _describe_notes(ladder):
    """Lines about what the table means, and what it says nothing about."""
    rows = ladder.rows
    lines = []
    if any(_is_significant(row) for row in rows):
        lines.append(f"*: p below {SIGNIFICANCE:g}, uncorrected for several tests")
    for stage in (row.stage for row in rows):
        if stage in TARGETS and TARGETS[stage].note:
            lines.append(f"{stage}: {TARGETS[stage].note}")
    if ladder.while_written and ladder.while_written.early:
        lines.append(describe_early_decisions(ladder.while_written.early, rows[-1]))
    if ladder.classes_without_samples:
        lines.append(describe_absent_classes(ladder.classes_without_samples))
    return lines


def _describe_losses(ladder):
    """A warning for each stage that loses much, followed by the layers."""
    lines = [
        f"{WARNING}{stage} is {points:.1f} points below {above}{STREAM_REMEDY.get(stage, '')}"
        for above, stage, points in find_losing_stages(ladder)
    ]
    if lines and ladder.layers:
        lines += ["", format_layers(ladder.layers)]
    return lines


def _compare_with_baseline(ladder):
    """A warning if the deployed network is less accurate than ``counts``, the simplest baseline."""
    change = ladder.against_counts
    if not change or change.difference >= 0 or change.mcnemar_p >= SIGNIFICANCE:
        return []
    return [
        f"{WARNING}{ladder.rows[-1].stage} is less accurate than the logistic regression on "
        f"event counts; try {ladder.remedy or 'more epochs'}"
    ]


def _is_significant(row):
    return row.mcnemar_p is not None and row.mcnemar_p < SIGNIFICANCE


def _make_cells(row: LadderRow) -> list:
    """The cells of a stage in the table."""
    low, high = row.accuracy_ci95
    cells = [row.stage, f"{row.accuracy:.3f}", f"{low:.3f} to {high:.3f}"]
    if row.change is None or row.mcnemar_p is None:
        return [*cells, "", "", "", ""]
    return [
        *cells,
        f"{round(row.change, 3) + 0.0:+.3f}",  # no change is +0.000
        str(row.disagreements),
        format_p(row.mcnemar_p),
        mark_significance(row.mcnemar_p),
    ]


def format_points(points: float) -> str:
    """Format a difference of accuracies in points; a loss is negative."""
    return f"{round(points, 1) + 0.0:+.1f} points"
