"""Check results of networks and targets, made unless they are current."""

from __future__ import annotations

import contextlib
from functools import partial

from deploy.check.bundle import Bundle
from deploy.check.results import read_result
from deploy.check.run import answered, open_check, run_check
from deploy.files import read_arrays, write_json
from deploy.targets.registry import TARGETS
from pipeline.artifacts import DELETE_IT, Artifact, Origin
from pipeline.jobs import Failure, run_jobs
from pipeline.progress import hidden, progress
from pipeline.roads.answers import reference_result
from pipeline.roads.origins import check_origin, recorded_in_check
from pipeline.run import DELETE_ITS_FOLDER, RunFolder
from pipeline.settings import Settings
from pipeline.stages.training import read_weights


def answer(
    run: RunFolder, settings: Settings, bundle: Bundle, stage: str, say=print, whole: bool = False
) -> dict:
    """Make the check result of a network or target, unless it is current, and return it.

    Parameters
    ----------
    run, settings
    bundle : Bundle
        The run's own bundle, or :func:`on_test_split` of it.
    stage : str
        One of :data:`pipeline.roads.answers.REFERENCES`, or a target.  Those that only the ladder
        needs were made before.
    say : callable
    whole : bool
        Use the samples of :func:`on_test_split`.
    """
    artifact = check_artifact(run, stage, check_origin(settings, bundle.id), whole)
    path, state = artifact.record, _state(artifact)
    if state.is_current:
        say(f"{stage}: up to date ({path})")
        return read_result(path, DELETE_IT)
    if (line := state.announcement("answering")) is not None:
        say(line)
    with progress(f"check {stage}", len(bundle.checks)) as advance:
        if stage in TARGETS:
            return run_check(bundle, stage, path, settings.seed, advance)
        # A result may depend on the settings that the bundle was made from.
        view = settings.only(bundle.spec.provenance["made_from"]["settings"])
        if stage == "counts":
            network = read_arrays(run.counts / "scores.npz", DELETE_ITS_FOLDER)
        elif stage == "nir":
            network = run.snn if view.network == "nir" else run.nir
        else:
            network = read_weights(run.cnn if stage == "cnn" else run.snn, view)
        result = reference_result(stage, view, network, bundle, advance)
        write_json(path, result)
        return result


def answer_all(
    run: RunFolder,
    settings: Settings,
    bundle: Bundle,
    asked,
    jobs: int = 1,
    say=print,
    whole: bool = False,
) -> list:
    """Run :func:`answer` for several stages: targets in processes, networks in this process.

    Processes share single streams, not targets, so that no core is idle during the last target.

    Parameters
    ----------
    run, settings, bundle, say, whole
        As in :func:`answer`.
    asked : sequence of str
    jobs : int
        Number of processes.

    Returns
    -------
    list of dict
        The results in the order of ``asked``.

    Raises
    ------
    UserError
        A target failed; the results of the others are saved.
    """
    origin = check_origin(settings, bundle.id)
    artifacts = {stage: check_artifact(run, stage, origin, whole) for stage in asked}
    states = {stage: _state(artifact) for stage, artifact in artifacts.items()}
    results = {}
    targets = [s for s in asked if s in TARGETS and not states[s].is_current]
    if jobs > 1 and any(TARGETS[name].slow for name in targets):
        here = [stage for stage in asked if stage not in targets]
        with progress("check", len(asked) * len(bundle.checks)) as advance:

            def answer_here():
                for stage in here:
                    with hidden():
                        results[stage] = answer(run, settings, bundle, stage, say, whole)
                    advance(len(bundle.checks), stage)

            for name in targets:
                if (line := states[name].announcement("answering")) is not None:
                    say(line)
            wanted = {name: artifacts[name].record for name in targets}
            results |= _shared(bundle, wanted, settings.seed, jobs, advance, answer_here, say)
    for stage in asked:
        if stage not in results:
            results[stage] = answer(run, settings, bundle, stage, say, whole)
    return [results[stage] for stage in asked]


def _shared(bundle, paths, seed, jobs, advance, meanwhile, say):
    """Results of targets by name; each remaining stream is a job if any of the targets is slow."""
    checks, failures = {}, {}
    with contextlib.ExitStack() as opened:
        for name, path in paths.items():
            report = partial(advance, note=name)
            checks[name] = opened.enter_context(open_check(bundle, name, path, seed, report))
        work = [job for check in checks.values() for job in _work(check)]
        for job, records in run_jobs(_answered, work, jobs, meanwhile=meanwhile):
            if isinstance(records, Failure):
                failures.setdefault(job.target, records)
            else:
                for record in records:
                    checks[job.target].take(record)
        results = {name: checks[name].finish() for name in checks if name not in failures}
    for name, failure in failures.items():
        failure.raise_again(f"target {name}")
    return results


def _work(check):
    parts = [[part] for part in check.left] if check.target.slow else [check.left]
    return [check.work(streams) for streams in parts if streams]


def _answered(work):
    return list(answered(work))


def _state(artifact):
    """The state of a check's result; one that is damaged is refused and not replaced."""
    if artifact.record.exists():
        read_result(artifact.record, DELETE_IT)
    return artifact.state()


def check_artifact(run: RunFolder, stage: str, origin: Origin, whole: bool = False) -> Artifact:
    """The result of a network or target on a bundle's samples, or on the whole test split."""
    name = f"checks/whole/{stage}" if whole else f"checks/{stage}"
    return Artifact(name, run.check(stage, whole), origin, made_from=recorded_in_check)
