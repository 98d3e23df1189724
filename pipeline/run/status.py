"""The state of each artifact of a run: current, missing, or outdated with the reason."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from pathlib import Path

from deploy.check.results import read_result
from deploy.errors import UserError
from deploy.files import read_json, sha256_of, understood
from deploy.tables import aligned
from deploy.targets.registry import TARGETS
from deploy.terminal import WARNING
from pipeline.artifacts import DELETE_IT, MISSING, OUTDATED, Change, Origin, State
from pipeline.inputs.dataset import ARRAYS, SPLIT_READS, dataset_origin
from pipeline.inputs.library import content_of
from pipeline.run.folder import RunFolder
from pipeline.run.ladder import ladder_artifact, ladder_stages
from pipeline.run.origins import (
    bundle_origin,
    check_origin,
    cnn_origin,
    events_origin,
    ladder_origin,
    nir_origin,
    rates_origin,
    threshold_origin,
)
from pipeline.run.places import refuse_other_folders
from pipeline.run.stages.answering import check_artifact
from pipeline.run.stages.training import (
    cnn_artifact,
    events_artifact,
    nir_artifact,
    rates_artifact,
    threshold_artifact,
)
from pipeline.settings import Settings, read_settings

WIDTH = 80
"""Width of the text in columns."""


@dataclass(frozen=True)
class Status:
    """The state of an artifact, with its accuracy and duration.

    Attributes
    ----------
    state : State
    accuracy : float or None
        Accuracy on the test split, or on the samples of a check.
    seconds : float or None
        Time it took to make the artifact.
    """

    state: State
    accuracy: float | None = None
    seconds: float | None = None

    def to_json(self) -> dict:
        """The status as plain values."""
        return {**self.state.to_json(), "accuracy": self.accuracy, "seconds": self.seconds}


def status_of(run: RunFolder, settings: Settings | None = None) -> list:
    """The state of each artifact of a run.

    Parameters
    ----------
    run : RunFolder
    settings : Settings, optional
        Default: the run's own.

    Returns
    -------
    list of Status
        In the order of their dependencies: ``dataset``, the networks, ``threshold`` (on events),
        ``bundle``, ``checks/<stage>``, ``ladder``.

    Raises
    ------
    UserError
        The folder has no run, or a file of it is damaged.
    """
    if not run.experiment.is_file():
        refuse_other_folders(run.path)
        raise UserError(
            f"{run.path}: not the folder of a run, since it has no {run.experiment.name}; make one "
            f"with 'stmnist ladder {run.path}'"
        )
    settings = settings or read_settings(run.experiment)
    dataset = _dataset_origin(run, settings)
    found = [Status(run.artifacts["dataset"].state(dataset))]
    found += _networks(run, settings, dataset)
    bundle = run.artifacts["bundle"].state(bundle_origin(settings, dataset))
    found.append(Status(bundle))
    for whole in (False, True):
        found += _answers(run, settings, bundle, whole)
    return found


def outdated(found) -> dict:
    """The artifacts that are outdated, with the reasons.

    Parameters
    ----------
    found : list of Status

    Returns
    -------
    dict of str to str
        The reasons as one line, by the artifact's name.
    """
    return {s.state.name: s.state.reasons() for s in found if s.state.state == OUTDATED}


def outdated_note(path) -> str | None:
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
    for folder in list(path.parents)[:3]:
        run = RunFolder(folder)
        if run.experiment.is_file():
            break
    else:
        return None
    try:
        reasons = outdated(status_of(run))
    except UserError:
        return None
    name = path.relative_to(run.path).with_suffix("").as_posix()
    if name not in reasons:
        return None
    remedy = f"'stmnist ladder {run.path}' makes it again"
    return f"{WARNING}{path}: outdated, {reasons[name]}; {remedy}"


def status_text(run: RunFolder, found) -> str:
    """The states as a table."""
    rows = [["artifact", "state", "accuracy", "seconds"]]
    for status in found:
        accuracy = "" if status.accuracy is None else f"{status.accuracy:.3f}"
        seconds = "" if status.seconds is None else f"{status.seconds:.0f}"
        rows.append([status.state.name, status.state.state, accuracy, seconds])
    lines = aligned(rows, left=2)
    reasons = outdated(found)
    if reasons:
        lines.append("")
        for reason in dict.fromkeys(reasons.values()):
            names = [name for name, because in reasons.items() if because == reason]
            lines += textwrap.wrap(f"outdated, because {reason}:", WIDTH, break_on_hyphens=False)
            indent = {"initial_indent": "  ", "subsequent_indent": "  "}
            lines += textwrap.wrap(", ".join(names), WIDTH, break_on_hyphens=False, **indent)
        lines.append(f"'stmnist ladder {run.path}' makes again what is outdated")
    return "\n".join(lines)


def _dataset_origin(run, settings):
    """The origin of the dataset with the current settings, or the stored one without recordings."""
    recorded = read_json(run.dataset, DELETE_IT).get("made_from") if run.dataset.exists() else None
    contents = recorded.get("contents") if isinstance(recorded, dict) else None
    contents = contents if isinstance(contents, dict) else {}
    if ARRAYS in contents:
        return Origin.of(settings, SPLIT_READS, contents={ARRAYS: contents[ARRAYS]})
    try:
        content = content_of(settings)
    except UserError:
        if "recordings" not in contents:
            raise
        content = contents["recordings"]
    return dataset_origin(settings, content)


def _networks(run, settings, dataset):
    graph = []
    if settings.nir.file:
        origin = nir_origin(settings, dataset)
        graph = [_status(nir_artifact(run, settings, origin), origin)]
    if settings.network == "nir":
        return graph
    if settings.on_events:
        events = events_origin(settings, dataset)
        network = _status(events_artifact(run, events), events)
        origin = threshold_origin(settings, events)
        threshold = _status(threshold_artifact(run, origin), origin)
        follows = _follows(threshold.state, network.state)
        return [*graph, network, Status(follows, threshold.accuracy)]
    cnn = cnn_origin(settings, dataset)
    rates = rates_origin(settings, cnn)
    return [_status(cnn_artifact(run, cnn), cnn), _status(rates_artifact(run, rates), rates)]


def _status(artifact, origin):
    """The state of a trained network, with accuracy and duration from its record."""
    state = artifact.state(origin)
    with understood(artifact.record, DELETE_IT):
        accuracy = state.record.get("accuracy", {}).get("test")
        return Status(state, _number(accuracy), _number(state.record.get("seconds")))


def _number(value):
    """A finite number, or None."""
    if value is None or (type(value) in (int, float) and math.isfinite(value)):
        return value
    raise ValueError(f"{str(value)[:40]!r} is no number")


def _answers(run, settings, bundle, whole):
    """Checks and ladder, of the bundle's samples or of the whole test split."""
    expected = ladder_stages(settings.network, whole)
    found, results = [], {}
    for stage in dict.fromkeys([*expected, *TARGETS]):
        artifact = check_artifact(run, stage, whole)
        if not artifact.record.exists():
            # Not every run needs every target or the whole test split: a result that was never
            # requested is not reported as missing.
            if not whole and stage in expected and not _is_board(stage):
                found.append(Status(State(artifact.name, MISSING)))
            continue
        results[stage] = result = read_result(artifact.record, DELETE_IT)
        state = _follows(_compared(artifact, settings, run, bundle), bundle)
        found.append(Status(state, result["accuracy"], result["wall_seconds"]))
    return [*found, *_ladder(run, results, found, whole)]


def _compared(artifact, settings, run, bundle):
    if bundle.state == MISSING:
        return State(artifact.name, OUTDATED, (Change("there is no bundle"),))
    bundle_id = sha256_of(run.bundle / "MANIFEST.json")
    return artifact.state(check_origin(settings, bundle_id))


def _ladder(run, results, checks, whole):
    artifact = ladder_artifact(run, whole)
    if not artifact.record.exists():
        return [] if whole else [Status(State(artifact.name, MISSING))]
    record = read_json(artifact.record, DELETE_IT)
    with understood(artifact.record, DELETE_IT):
        stages = [str(row["stage"]) for row in record["rows"]]
    there = [results[stage] for stage in stages if stage in results]
    state = artifact.state(ladder_origin(there))
    for check in checks:
        if check.state.name.rsplit("/", 1)[-1] in stages:
            state = _follows(state, check.state)
    return [Status(state)]


def _is_board(stage):
    return stage in TARGETS and TARGETS[stage].hardware


def _follows(state, used):
    """Mark what is made from an outdated artifact as outdated, for the same reasons."""
    if state.state == MISSING or used.state != OUTDATED:
        return state
    return State(state.name, OUTDATED, used.because, state.record)
