"""Check networks and targets on the samples of a bundle."""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import replace
from functools import partial

from deploy.check.bundle import Bundle
from deploy.check.results import CheckResult, read_result, write_result
from deploy.check.run import list_sample_records, open_check, run_streams
from deploy.check.summary import make_result
from deploy.errors import UserError
from deploy.targets.registry import TARGETS
from pipeline.jobs import Failure, run_jobs
from pipeline.kinds.kind import NetworkKind
from pipeline.progress import hide_inner_bars, progress
from pipeline.storage.artifacts import DELETE_IT, Artifact, Origin
from pipeline.storage.run_folder import RunFolder
from pipeline.workflow.conversion import convert
from pipeline.workflow.opening import OpenedRun
from pipeline.workflow.target_check import TargetCheck

# What the record of a check says of its samples if they are those in the bundle.
OWN_SAMPLES = "the bundle's"


def convert_and_check(opened: OpenedRun) -> Bundle:
    """Make the bundle, and the checks of the kind that belong to each new bundle."""
    bundle = convert(opened)
    for stage in opened.kind.deployed_stages:
        check_stage(opened, bundle, stage)
    return bundle


def check_stage(opened: OpenedRun, bundle: Bundle, stage: str) -> CheckResult:
    """The check result of a reference stage or target, made unless it is current.

    Parameters
    ----------
    opened : OpenedRun
    bundle : Bundle
        The run's bundle, or one with other samples of its recordings.
    stage : str
        One of the kind's reference stages, or a target.
    """
    artifact = _check_artifact_of(opened, bundle, stage)
    path = artifact.record
    state = artifact.find_state()
    if state.is_current:
        opened.say(f"{stage}: up to date ({path})")
        return read_result(path, DELETE_IT)
    state.announce("checking", opened.say)
    if stage in TARGETS:
        return TargetCheck(stage, opened.settings.seed).run(bundle, path)
    result = _check_reference(opened, bundle, stage)
    write_result(path, result)
    return result


def _check_reference(opened, bundle, stage) -> CheckResult:
    """The check result of a reference stage, whose network is trained if it is missing."""
    reference = opened.kind.references[stage]
    is_deployed = opened.kind.is_deployed(reference.step)
    if not is_deployed:
        opened.make(reference.step)
    origin = opened.find_artifact(reference.step).origin
    settings = bundle.spec.provenance.settings
    inputs = opened.make_step_inputs(settings.keys() | origin.settings.keys())
    begun = time.perf_counter()
    with progress(f"check {stage}", len(bundle.checks)) as advance:
        responses = reference.respond_to(stage, inputs, bundle, advance)
    seconds = time.perf_counter() - begun
    samples = list_sample_records(bundle.checks, responses)
    versions = reference.list_versions()
    result = make_result(bundle, stage, opened.settings.seed, samples, seconds, versions)
    return result if is_deployed else replace(result, network=origin.key)


def check_stages(opened: OpenedRun, bundle: Bundle, stages, jobs: int = 1) -> list:
    """Run :func:`check_stage` for several stages: targets in processes, networks in this process.

    A job of a process is one stream and not a whole target, so that no core is idle at the end.

    Parameters
    ----------
    opened, bundle
        As in :func:`check_stage`.
    stages : sequence of str
    jobs : int
        Number of processes.

    Returns
    -------
    list of CheckResult
        The results in the order of ``stages``.

    Raises
    ------
    UserError
        A target failed; the results of the others are saved.
    """
    artifacts = {stage: _check_artifact_of(opened, bundle, stage) for stage in stages}
    states = {stage: artifact.find_state() for stage, artifact in artifacts.items()}
    targets = [stage for stage in stages if stage in TARGETS and not states[stage].is_current]
    results = {}
    if jobs > 1 and any(TARGETS[name].is_slow for name in targets):
        for name in targets:
            states[name].announce("checking", opened.say)
        paths = {name: artifacts[name].record for name in targets}
        others = [stage for stage in stages if stage not in targets]
        results = _check_side_by_side(opened, bundle, paths, others, jobs)
    for stage in stages:
        if stage not in results:
            results[stage] = check_stage(opened, bundle, stage)
    return [results[stage] for stage in stages]


def _check_side_by_side(opened, bundle, paths, others, jobs) -> dict:
    """Results by name of targets in processes, and of the other stages in this process.

    The samples of the targets are counted.  Those of the other stages are not, because the time
    that these take is mostly that of a training.

    Parameters
    ----------
    paths : dict of str to Path
        File of each target's result.
    others : list of str
    """
    results = {}
    with progress("check", len(paths) * len(bundle.checks)) as advance:

        def check_others():
            for stage in others:
                advance(0, stage)
                with hide_inner_bars():
                    results[stage] = check_stage(opened, bundle, stage)

        seed = opened.settings.seed
        target_results = _run_targets(bundle, paths, seed, jobs, advance, check_others)
    return {**results, **target_results}


def _run_targets(bundle, paths, seed, jobs, advance, meanwhile):
    """Results of targets by name; each remaining stream is a job if any of the targets is slow."""
    checks = {}
    failures = {}
    with contextlib.ExitStack() as stack:
        for name, path in paths.items():
            report = partial(advance, note=name)
            checks[name] = stack.enter_context(open_check(bundle, name, path, seed, report))
        stream_jobs = []
        for check in checks.values():
            batches = [check.remaining_streams]
            if check.target.is_slow:
                batches = [[stream] for stream in check.remaining_streams]
            stream_jobs += [check.make_job(streams) for streams in batches if streams]
        for job, records in run_jobs(_run_all_streams, stream_jobs, jobs, meanwhile=meanwhile):
            if isinstance(records, Failure):
                failures.setdefault(job.target, records)
            else:
                for record in records:
                    checks[job.target].add_record(record)
        results = {name: checks[name].finish() for name in checks if name not in failures}
    for name, failure in failures.items():
        failure.raise_again(f"target {name}")
    return results


def _run_all_streams(job):
    return list(run_streams(job))


def _check_artifact_of(opened, bundle, stage):
    """The artifact of a check result.  A damaged result is an error, and it is not replaced."""
    stages = (*opened.kind.references, *TARGETS)
    if stage not in stages:
        raise UserError(f"no stage or target {stage!r}; they are {', '.join(stages)}")
    origin = opened.dataset.origin
    artifact = make_check_artifact(opened.run, stage, opened.kind, origin, bundle.id)
    if artifact.record.exists():
        read_result(artifact.record, DELETE_IT)
    return artifact


def make_check_artifact(
    run: RunFolder, stage: str, kind: NetworkKind, dataset_origin: Origin, bundle_id: str
) -> Artifact:
    """The check result of a stage as an artifact.

    It depends on the bundle by its id, since a bundle may have been copied to another machine.  The
    result of a network that the bundle is not made from also depends on that network.
    """
    contents = {"bundle": bundle_id, "target": stage, "samples": OWN_SAMPLES}
    if stage in kind.references and stage not in kind.deployed_stages:
        contents["network"] = kind.make_origin(kind.references[stage].step, dataset_origin).key
    origin = Origin({"seed": kind.settings.seed}, contents)
    return Artifact(
        f"checks/{stage}", run.find_check_file(stage), origin, made_from=_read_check_record
    )


def _read_check_record(result):
    names = ("bundle", "network", "target")
    contents = {name: result[name] for name in names if name in result}
    if "options" in result:  # those that differ from the defaults
        contents["options"] = json.dumps(result["options"], sort_keys=True)
    contents["samples"] = "others" if result.get("data") else OWN_SAMPLES
    return Origin({"seed": result.get("seed")}, contents).to_json()
