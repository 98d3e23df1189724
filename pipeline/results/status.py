"""The state of each artifact of a run: current, missing, or outdated with the reason."""

import json
import math
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path

from deploy.check.results import read_result
from deploy.errors import UserError
from deploy.files import hash_file, read_arrays, read_json, reporting_damage
from deploy.tables import align_rows, format_count
from deploy.targets.registry import TARGETS
from deploy.terminal import WARNING, format_command
from pipeline.kinds.registry import find_kind
from pipeline.recordings.dataset import make_dataset_origin
from pipeline.recordings.splits import RANDOM
from pipeline.results.ladder import find_ladder_artifact, list_boards, list_stages
from pipeline.settings import INPUTS, Settings, read_settings
from pipeline.sources import find_hash_and_split
from pipeline.storage.artifacts import DELETE_IT, MISSING, OUTDATED, Change, State
from pipeline.storage.run_folder import RunFolder, require_run, run_around
from pipeline.workflow import find_bundle_artifact, find_dataset_artifact, make_check_artifact

# Width of the text in columns.
TEXT_WIDTH = 80


@dataclass(frozen=True)
class Status:
    """The state of an artifact, with its accuracy and duration.

    Attributes
    ----------
    state : State
    accuracy : float or None
        Accuracy on the test set, or on the samples of a check.
    seconds : float or None
        Time it took to make the artifact.
    epochs : int or None
        Number of epochs that a training with these settings has finished, if it is running or was
        interrupted.
    """

    state: State
    accuracy: float | None = None
    seconds: float | None = None
    epochs: int | None = None

    def to_json(self) -> dict:
        """The status as plain values; with ``epochs`` only if they are known."""
        values = {**self.state.to_json(), "accuracy": self.accuracy, "seconds": self.seconds}
        return values if self.epochs is None else {**values, "epochs": self.epochs}


def list_states(run: RunFolder, adapted: bool = False) -> list:
    """The state of each artifact of a run.

    Parameters
    ----------
    run : RunFolder
    adapted : bool
        Also the bundles that were adapted to people, which are no results of the run.

    Returns
    -------
    list of Status
        In the order of their dependencies: ``dataset``, the networks, ``threshold`` (on events),
        ``bundle``, ``checks/<stage>``, ``ladder``, ``adapted/<writer>``.

    Raises
    ------
    UserError
        The folder has no run, or is that of a benchmark, or a file of it is damaged.
    """
    require_run(run)
    settings = read_settings(run.experiment)
    dataset = _find_dataset_origin(run, settings)
    kind = find_kind(settings)
    states = [Status(find_dataset_artifact(run, dataset).find_state())]
    states += _list_states_of_steps(run, kind, dataset)
    bundle = find_bundle_artifact(run, kind, dataset).find_state()
    states.append(Status(bundle))
    states += _list_states_of_results(run, kind, dataset, bundle)
    networks = sorted(run.path.glob("adapted/*/network.json")) if adapted else []
    names = [f"adapted/{network.parent.name}" for network in networks]
    return states + [
        Status(find_bundle_artifact(run, kind, dataset, n).find_state()) for n in names
    ]


def list_targets_checked_alone() -> tuple:
    """Names of the targets of the check that the ladder does not run, with those of plugins."""
    return tuple(
        name for name, target in TARGETS.items() if target.needs_board or not target.is_in_ladder
    )


def find_outdated(statuses) -> dict:
    """The artifacts that are outdated, with the reasons.

    Parameters
    ----------
    statuses : list of Status

    Returns
    -------
    dict of str to str
        The reasons as one line, by the artifact's name.
    """
    states = [status.state for status in statuses]
    return {state.name: state.describe_reasons() for state in states if state.is_outdated}


def describe_remedy(run, names) -> str:
    """Commands that make outdated artifacts again, in the order of their dependencies.

    Parameters
    ----------
    run : path-like
        The run's folder.
    names : iterable of str
        The artifacts' names, as in :func:`list_states`.
    """
    targets = [name for name in list_targets_checked_alone() if f"checks/{name}" in names]
    commands = [format_command("check", "run", run, "--target", target) for target in targets]
    adapted = {name for name in names if name.startswith("adapted/")}
    if set(names) - adapted - {f"checks/{target}" for target in targets}:
        commands.insert(0, format_command("ladder", run))
    if adapted:
        commands.append(format_command("adapt", run, "--data", "FILE"))
    return ", then ".join(commands)


def describe_outdated(path) -> str | None:
    """A line for the user if a bundle or check result belongs to a run and is outdated.

    Parameters
    ----------
    path : path-like
        A bundle's folder or the file of a check's result.

    Returns
    -------
    str or None
        None also if the path is not in a run, or its run cannot be read.
    """
    path = Path(path).absolute()
    around = run_around(path)
    if around is None:
        return None
    run = RunFolder(around)
    try:
        reasons = find_outdated(list_states(run, adapted=True))
    except UserError:
        return None
    name = path.relative_to(around).with_suffix("").as_posix()
    if name not in reasons:
        return None
    remedy = describe_remedy(around, reasons.keys() & {"bundle", name})
    return f"{WARNING}{path}: outdated, {reasons[name]}; {remedy} makes it again"


def format_status(run: RunFolder, statuses) -> str:
    """The states as a table."""
    rows = [["artifact", "state", "accuracy", "seconds"]]
    for status in statuses:
        accuracy = "" if status.accuracy is None else f"{status.accuracy:.3f}"
        seconds = "" if status.seconds is None else f"{status.seconds:.0f}"
        rows.append([status.state.name, status.state.condition, accuracy, seconds])
    lines = align_rows(rows, left=2)
    for status in statuses:
        if status.epochs is not None:
            lines += ["", *_describe_training(run, status)]
    reasons = find_outdated(statuses)
    if reasons:
        lines.append("")
        for reason in dict.fromkeys(reasons.values()):
            names = [name for name, because in reasons.items() if because == reason]
            lines += textwrap.wrap(
                f"outdated, because {reason}:", TEXT_WIDTH, break_on_hyphens=False
            )
            lines += textwrap.wrap(
                ", ".join(names),
                TEXT_WIDTH,
                break_on_hyphens=False,
                initial_indent="  ",
                subsequent_indent="  ",
            )
        remedy = f"{describe_remedy(run.path, reasons)} makes again what is outdated"
        lines += textwrap.wrap(remedy, TEXT_WIDTH, break_on_hyphens=False, break_long_words=False)
    return "\n".join(lines)


def _describe_training(run, status):
    """The text of the status about a training that has not ended."""
    n_epochs = format_count(status.epochs, "epoch")
    text = (
        f"{status.state.name}: a training has finished {n_epochs}; unless it is still running, "
        f"{format_command('train', run.path)} continues it"
    )
    return textwrap.wrap(text, TEXT_WIDTH, break_on_hyphens=False, break_long_words=False)


def _find_dataset_origin(run, settings):
    """The origin of the dataset with the current settings, or the stored one without recordings."""
    recorded = read_json(run.dataset, DELETE_IT).get("made_from") if run.dataset.exists() else None
    contents = recorded.get("contents") if isinstance(recorded, dict) else None
    contents = contents if isinstance(contents, dict) else {}
    try:
        content, kind = find_hash_and_split(settings)
    except UserError:
        if "recordings" not in contents:
            raise
        content = contents["recordings"]
        kind = contents.get("split", RANDOM)
    return make_dataset_origin(settings, content, kind)


def explain_unread(settings: Settings) -> str | None:
    """Why a run's recordings could not be compared with those that it was made from, or None."""
    try:
        find_hash_and_split(settings)
    except UserError as error:
        return f"the recordings are not compared with the run's: {error}"
    return None


def _list_states_of_steps(run, kind, dataset):
    """The states of a kind's steps, with accuracies and durations from their records."""
    statuses = {}
    predicting = {kind.references[stage].step for stage in kind.reference_stages}
    for step in kind.steps:
        if step.name not in predicting and not kind.is_deployed(step.name):
            continue
        artifact = kind.find_artifact(step.name, run, dataset)
        state = artifact.find_state()
        if _is_of_other_samples(state):
            state = State(state.name, MISSING)
        with reporting_damage(artifact.record, DELETE_IT):
            accuracy = _require_number(state.record.get("accuracy", {}).get("test"))
            seconds = _require_number(state.record.get("seconds"))
        for used in step.uses:
            state = _mark_as_outdated(state, statuses[used].state)
        if step.measures and accuracy is not None:
            measured = statuses[step.measures]
            statuses[step.measures] = replace(measured, accuracy=accuracy)
            accuracy = seconds = None  # both are the network's
        epochs = None if state.is_current else _count_finished_epochs(step, artifact)
        statuses[step.name] = Status(state, accuracy, seconds, epochs)
    return list(statuses.values())


def _is_of_other_samples(state):
    """True if a network on frames of events is where one on images would be, or conversely."""
    for change in state.because:
        if change.name == "input.kind":
            before, now = (INPUTS.get(json.loads(text)) for text in (change.before, change.now))
            return before != now
    return False


def _count_finished_epochs(step, artifact):
    """Epochs of a training that has not ended, from its checkpoint; None without one."""
    for file in step.temporary:
        path = artifact.folder / file
        if not path.exists():
            continue
        arrays = read_arrays(path, DELETE_IT)
        with reporting_damage(path, DELETE_IT):
            if str(arrays["key"]) == artifact.origin.key:
                return len(json.loads(str(arrays["history"])))
    return None


def _require_number(value):
    """A finite number, or None."""
    if value is None or (type(value) in (int, float) and math.isfinite(value)):
        return value
    raise ValueError(f"{str(value)[:40]!r} is not a number")


def _list_states_of_results(run, kind, dataset, bundle):
    """Checks and ladder, of the bundle's samples."""
    expected = list_stages(kind)
    there = not bundle.is_missing
    bundle_id = hash_file(run.bundle / "MANIFEST.json") if there else ""
    statuses = []
    results = {}
    for stage in dict.fromkeys([*expected, *TARGETS]):
        artifact = make_check_artifact(run, stage, kind, dataset, bundle_id)
        if not artifact.record.exists():
            # Not every run needs every target: a result that was never
            # requested is not reported as missing.
            if stage in expected and stage not in list_boards():
                statuses.append(Status(State(artifact.name, MISSING)))
            continue
        results[stage] = result = read_result(artifact.record, DELETE_IT)
        no_bundle = State(artifact.name, OUTDATED, (Change("there is no bundle"),))
        state = _mark_as_outdated(artifact.find_state(), bundle) if there else no_bundle
        statuses.append(Status(state, result.accuracy, result.wall_seconds))
    return [*statuses, *_find_state_of_ladder(run, results, statuses)]


def _find_state_of_ladder(run, results, checks):
    file = find_ladder_artifact(run, ()).record
    if not file.exists():
        return [Status(State("ladder", MISSING))]
    record = read_json(file, DELETE_IT)
    with reporting_damage(file, DELETE_IT):
        stages = [str(row["stage"]) for row in record["rows"]]
    compared = [results[stage] for stage in stages if stage in results]
    state = find_ladder_artifact(run, compared).find_state()
    for check in checks:
        if check.state.name.rsplit("/", 1)[-1] in stages:
            state = _mark_as_outdated(state, check.state)
    return [Status(state)]


def _mark_as_outdated(state, used):
    """Mark what is made from an outdated artifact as outdated, for the same reasons."""
    if state.is_missing or not used.is_outdated:
        return state
    return State(state.name, OUTDATED, used.because, state.record)
