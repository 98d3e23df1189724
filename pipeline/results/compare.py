"""Compare runs: different settings, accuracy of each stage, and costs of an inference."""

import itertools
import string
import textwrap
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from deploy.check.bundle import read_bundle
from deploy.check.intervals import compute_fisher_p, compute_mcnemar_p
from deploy.check.results import read_result
from deploy.errors import UserError
from deploy.network.provenance import read_classes
from deploy.network.spec import NetworkSpec
from deploy.preflight.plan import make_plan
from deploy.tables import (
    SIGNIFICANCE,
    align_rows,
    format_count,
    format_p,
    format_value,
    mark_significance,
)
from deploy.targets.registry import TARGETS, rank_targets_by_spikes
from deploy.terminal import escape_control, format_command
from pipeline.kinds.registry import find_kind, list_references
from pipeline.paper import CNN_MACS
from pipeline.recordings.sensor import is_st_mnist_sensor
from pipeline.results.status import describe_remedy, find_outdated, list_states
from pipeline.settings import IMPORTED, SIMULATED, Settings, read_settings
from pipeline.storage.artifacts import DELETE_IT
from pipeline.storage.run_folder import RunFolder, require_run
from pipeline.workflow import list_network_settings

SCHEMA = "stmnist-runs/1"

# Short names of runs in the text, by their order.
LETTERS = string.ascii_uppercase

# Width of the text in columns.
TEXT_WIDTH = 80


def list_all_stages() -> tuple:
    """All stages that a result may have, in the order of the ladder."""
    return (*list_references(), *TARGETS)


@dataclass(frozen=True)
class ComparedRun:
    """The compared data of a run.

    Attributes
    ----------
    name : str
        The path as the user wrote it.
    settings : Settings
    spec : NetworkSpec
        Network of its bundle.
    cores, chips : int
        Cores and chips that the network needs; see :func:`deploy.preflight.plan.make_plan`.
    results : dict of str to dict
        Check results of the bundle, by stage.
    stale : tuple of str
        Stages whose results belong to an earlier bundle, and are left out.
    outdated : dict of str to str
        Outdated artifacts, with the reasons.
    """

    name: str
    settings: Settings
    spec: NetworkSpec
    cores: int
    chips: int
    results: dict
    stale: tuple = ()
    outdated: dict = field(default_factory=dict)


def read_runs(paths) -> list:
    """Read the compared data of runs.

    Parameters
    ----------
    paths : sequence of path-like
        Folders of at least two runs.

    Returns
    -------
    list of ComparedRun

    Raises
    ------
    UserError
        There are fewer than two runs, or a folder without a run, bundle or results.
    """
    paths = [Path(path) for path in paths]
    if not 2 <= len(paths) <= len(LETTERS):
        raise UserError(f"{format_count(len(paths), 'run')} named; give from two to {len(LETTERS)}")
    return [_read_run(path) for path in paths]


def _read_run(path):
    folder = RunFolder(path)
    require_run(folder)
    if not folder.bundle.is_dir():
        raise UserError(f"{path}: has no bundle; make it with {format_command('convert', path)}")
    bundle = read_bundle(folder.bundle)
    files = {stage: folder.find_check_file(stage) for stage in list_all_stages()}
    every = {stage: read_result(f, DELETE_IT) for stage, f in files.items() if f.exists()}
    results = {stage: result for stage, result in every.items() if result.bundle_id == bundle.id}
    stale = [stage for stage in every if stage not in results]
    if not results:
        old = " of its bundle, only of an earlier one" if stale else ""
        raise UserError(
            f"{path}: no check results{old}; make them with {format_command('ladder', path)}"
        )
    plan = make_plan(bundle.spec)
    return ComparedRun(
        name=str(path),
        settings=read_settings(folder.experiment),
        spec=bundle.spec,
        cores=len(plan.cores),
        chips=plan.chips,
        results=results,
        stale=tuple(stale),
        outdated=find_outdated(list_states(folder)),
    )


def compare_runs(runs) -> dict:
    """Compare runs.

    Parameters
    ----------
    runs : sequence of ComparedRun
        At least two.

    Returns
    -------
    dict
        Ready for JSON: ``runs``, each with its ``name`` and the costs of an inference (see
        :func:`compute_inference`); the ``settings`` that differ, each with its ``name`` and
        ``values`` in the order of the runs (None of a run that does not read it); the ``stages`` of
        at least two runs, each with ``accuracies`` and ``differences`` from the first run in the
        order of the runs (see :func:`compare_accuracies`), None for a run without it.
    """
    runs_with = Counter(stage for run in runs for stage in run.results)
    shared = [stage for stage in list_all_stages() if runs_with[stage] > 1]
    return {
        "schema": SCHEMA,
        "runs": [
            {
                "name": run.name,
                **compute_inference(run),
                "results_of_an_earlier_bundle": list(run.stale),
                "outdated": run.outdated,
            }
            for run in runs
        ],
        "settings": _find_different_settings(runs),
        "stages": [_compare_stage(stage, runs) for stage in shared],
    }


def _find_different_settings(runs):
    """Settings that at least two runs read and that differ; None for runs that do not read them."""
    by_run = [list_network_settings(run.spec) for run in runs]
    names = dict.fromkeys(name for settings in by_run for name in settings)
    different = []
    contents = {run.spec.provenance.source_sha256 for run in runs}
    sources = [run.settings.data.source for run in runs]
    if len(contents) > 1 and {*sources} != {SIMULATED}:  # not the same ones in another place
        different.append({"name": "data.source", "values": sources})
    imported = [find_kind(run.settings).imported for run in runs]
    hashes = {None if network is None else network.sha256 for network in imported}
    if len(hashes) > 1:
        files = ["training" if network is None else network.file for network in imported]
        different.append({"name": "network from", "values": files})
    for name in (name for name in names if name not in IMPORTED.values()):
        values = [settings.get(name) for settings in by_run]
        if len({repr(value) for value in values if value is not None}) > 1:
            different.append({"name": name, "values": values})
    return different


def compute_inference(run: ComparedRun) -> dict:
    """Costs of an inference of a run's network, as plain values.

    Operations and times are those of the stage named by ``counted_on``, or None without a
    result; ``operations_per_mac`` is relative to the paper's CNN, and None for other classes than
    digits.  Networks on events with early decisions also have ``writing``: the mean share of the
    writing until the decision, and its accuracy.
    """
    spec = run.spec
    stages_with_counts = (
        stage
        for stage in rank_targets_by_spikes()
        if stage in run.results and run.results[stage].synaptic_operations
    )
    stage = next(stages_with_counts, None)
    result = None if stage is None else run.results[stage]
    operations = None
    if result is not None:
        operations = sum(result.synaptic_operations.values()) / result.n_samples
    rows, columns, _ = spec.input_shape
    of_digits = is_st_mnist_sensor(rows, columns, read_classes(spec))
    per_mac = operations / CNN_MACS if operations is not None and of_digits else None
    return {
        "input": run.settings.input.kind,
        "architecture": spec.architecture,
        "input_shape": list(spec.input_shape),
        "simulated": spec.provenance.simulated,
        "classes": list(read_classes(spec)),
        "neurons": sum(layer.size for layer in spec.layers if layer.neurons is not None),
        "cores": run.cores,
        "chips": run.chips,
        "counted_on": stage,
        "synaptic_operations": operations,
        "operations_per_mac": per_mac,
        "steps": spec.presentation.steps,
        "step_ms": 1000 * spec.stimulus.step_seconds,
        "writing": _describe_early_decisions(result),
    }


def _describe_early_decisions(result):
    """Time and accuracy of early decisions; None if the network decides at the end."""
    early = None if result is None else result.early_decisions
    if early is None:
        return None
    return {
        "share": early.share_of_writing_mean,
        "accuracy": early.accuracy,
        "accuracy_ci95": early.accuracy_ci95,
    }


def _compare_stage(stage, runs):
    first, *others = runs
    return {
        "stage": stage,
        "accuracies": [_select_accuracy(run.results.get(stage)) for run in runs],
        "differences": [None, *(compare_accuracies(first, run, stage) for run in others)],
    }


def _select_accuracy(result):
    """The accuracy of a check result with its interval; None without a result."""
    if result is None:
        return None
    return {
        "n_samples": result.n_samples,
        "accuracy": result.accuracy,
        "accuracy_ci95": result.accuracy_ci95,
    }


def compare_accuracies(a: ComparedRun, b: ComparedRun, stage: str) -> dict | None:
    """Difference in accuracy of a stage between two runs, B's minus A's.

    The comparison is paired if both have the same samples: the same ids and labels, in any order,
    of the same recordings as far as the bundles record it (``source_sha256``).  The source matters
    because ids are unique only within it: every simulation has a ``0/0000``.

    Returns
    -------
    dict
        ``difference`` of the accuracies, B's minus A's; ``paired``; ``only_a`` and ``only_b``, the
        numbers of samples that only A or only B got right (None if not paired); ``p`` of McNemar's
        exact test if paired, else of Fisher's.  None if a run does not have the stage.
    """
    if stage not in a.results or stage not in b.results:
        return None
    first = a.results[stage]
    second = b.results[stage]
    sources = [run.spec.provenance.source_sha256 for run in (a, b)]
    same_source = None in sources or sources[0] == sources[1]
    paired = same_source and _map_labels(first) == _map_labels(second)
    value = {"difference": second.accuracy - first.accuracy, "paired": paired}
    if not paired:
        counts = (
            first.n_right,
            first.n_samples,
            second.n_right,
            second.n_samples,
        )
        return {**value, "only_a": None, "only_b": None, "p": compute_fisher_p(*counts)}
    right_a = _map_right(first)
    right_b = _map_right(second)
    pairs = [(right, right_b[sample]) for sample, right in right_a.items()]
    return {
        **value,
        "only_a": sum(in_a and not in_b for in_a, in_b in pairs),
        "only_b": sum(in_b and not in_a for in_a, in_b in pairs),
        "p": compute_mcnemar_p(*zip(*pairs, strict=True)),
    }


def _map_labels(result) -> dict:
    return {sample.id: sample.label for sample in result.samples}


def _map_right(result) -> dict:
    """By the id of each sample, True if its prediction is right."""
    return {sample.id: sample.is_right for sample in result.samples}


def format_runs(compared: dict) -> str:
    """Format a comparison as tables in which a letter stands for each run.

    Parameters
    ----------
    compared : dict
        From :func:`compare_runs`.
    """
    runs = compared["runs"]
    letters = LETTERS[: len(runs)]
    lines = [f"{a}  {escape_control(run['name'])}" for a, run in zip(letters, runs, strict=True)]
    lines += ["", *_format_settings(compared, letters)]
    lines += ["", *_format_accuracies(compared, letters)]
    lines += ["", *_format_inferences(runs, letters)]
    for letter, run in zip(letters, runs, strict=True):
        notes = []
        if stale := run["results_of_an_earlier_bundle"]:
            notes.append(f"left out, of an earlier bundle: {', '.join(stale)}")
        if run["outdated"]:
            reasons = "; ".join(dict.fromkeys("; ".join(run["outdated"].values()).split("; ")))
            notes.append(
                f"OUTDATED, these results were made with other settings: {reasons}; "
                f"{describe_remedy(run['name'], run['outdated'])} makes them again"
            )
        for note in notes:
            note = escape_control(f"{letter}: {note}")
            lines += ["", *textwrap.wrap(note, TEXT_WIDTH, break_on_hyphens=False)]
    return "\n".join(lines)


def _format_settings(compared, letters):
    if not compared["settings"]:
        return ["no setting differs"]
    rows = [["setting that differs", *letters]]
    for setting in compared["settings"]:
        rows.append([setting["name"], *map(format_value, setting["values"])])
    return _wrap_table(rows)


def _format_accuracies(compared, letters):
    if not compared["stages"]:
        return ["no stage has results in two of the runs; 'stmnist ladder RUN' makes them"]
    rows = [["stage", "", "accuracy", "95 % interval", f"vs {letters[0]}", "won", "lost", "p"]]
    differences = []
    for stage in compared["stages"]:
        rows += _make_stage_rows(stage, letters)
        differences += [value for value in stage["differences"] if value is not None]
    lines = [
        f"accuracy on {_describe_samples(compared, letters)}",
        *align_rows(rows, left=2),
        "won, lost: samples that only this run, or only A, got right; p: McNemar's test",
    ]
    if any(cells[-1].endswith("*") for cells in rows):
        lines.append(f"*: p below {SIGNIFICANCE:g}, uncorrected for several tests")
    if not all(value["paired"] for value in differences):
        lines.append("unpaired: the samples or their sources differ; p is Fisher's exact test")
    return lines


def _make_stage_rows(stage, letters):
    """A row for each run with a result of the stage, the first with the stage's name."""
    name = stage["stage"]
    rows = []
    for letter, accuracy, value in zip(
        letters, stage["accuracies"], stage["differences"], strict=True
    ):
        if accuracy is None:
            continue
        low, high = accuracy["accuracy_ci95"]
        cells = [name, letter, f"{accuracy['accuracy']:.3f}", f"{low:.3f} to {high:.3f}"]
        rows.append([*cells, *_make_difference_cells(value)])
        name = ""
    return rows


def _describe_samples(compared, letters):
    """How many samples there are, in the order of the runs, and which are simulated."""
    counts: dict = {}
    for stage in compared["stages"]:
        counts |= {accuracy["n_samples"]: None for accuracy in stage["accuracies"] if accuracy}
    numbers = " and ".join(map(str, counts))
    simulated = [a for a, run in zip(letters, compared["runs"], strict=True) if run["simulated"]]
    if not simulated:
        return f"{numbers} samples"
    if len(simulated) == len(letters):
        return f"{numbers} simulated samples"
    return f"{numbers} samples; those of {', '.join(simulated)} are simulated"


def _make_difference_cells(value):
    if value is None:
        return [""] * 4
    counts = [str(value["only_b"]), str(value["only_a"])] if value["paired"] else ["unpaired", ""]
    change = round(value["difference"], 3) + 0.0
    p = value["p"]
    return [f"{change:+.3f}", *counts, format_p(p) + mark_significance(p)]


def _format_inferences(runs, letters):
    def make_row(head, name, form="{}", costs=runs):
        values = [None if cost is None else cost[name] for cost in costs]
        return [head, *("" if value is None else form.format(value) for value in values)]

    early = [run["writing"] for run in runs]
    rows = [
        ["an inference", *letters],
        make_row("input", "input"),
        make_row("architecture", "architecture"),
        make_row("neurons", "neurons"),
        make_row("cores", "cores"),
        make_row("chips", "chips"),
        make_row("counted on", "counted_on"),
        make_row("synaptic operations", "synaptic_operations", "{:,.0f}"),
        make_row("times the CNN's", "operations_per_mac", "{:.2f}"),
        make_row("steps of presentation", "steps"),
        make_row("early decision after", "share", "{:.0%} of recording", early),
        make_row("its accuracy", "accuracy", "{:.3f}", early),
    ]
    lines = _wrap_table([cells for cells in rows if any(cells[1:])])
    if any(run["operations_per_mac"] is not None for run in runs):
        lines.append(f"times the CNN's: the paper's CNN has {CNN_MACS:,} multiply-accumulates")
    return lines


def _wrap_table(rows):
    """A table whose cells are wrapped if their columns would be too wide."""
    first = max(len(row[0]) for row in rows)
    n = len(rows[0]) - 1
    room = max((TEXT_WIDTH - first) // n - 2, 8)
    folded = []
    for head, *cells in rows:
        columns = [textwrap.wrap(cell, room) or [""] for cell in cells]
        for index, line in enumerate(itertools.zip_longest(*columns, fillvalue="")):
            folded.append(["" if index else head, *line])
    return align_rows(folded)
