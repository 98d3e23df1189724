"""The work on a run: open it, train, convert, and check; what is current is not made again.

:func:`open_run` loads the recordings and chooses what the settings leave open; the others take what
it returns: :meth:`Opened.make` trains a network, :func:`convert` writes the bundle, and
:func:`check_stage` runs a network or target on its samples.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from deploy import __version__
from deploy.check.bundle import (
    FILES,
    Bundle,
    CheckSet,
    read_bundle,
    require_replaceable,
    require_room,
    write_bundle,
)
from deploy.check.results import read_result, result_of
from deploy.check.run import open_check, records_of, run_check, run_streams
from deploy.errors import UserError
from deploy.files import write_json
from deploy.network.blocks import find_rescaled_layers
from deploy.network.spec import NetworkSpec
from deploy.tables import list_names, plural
from deploy.targets.registry import TARGETS
from deploy.terminal import WARNING
from pipeline.jobs import Failure, run_jobs
from pipeline.kinds import NetworkKind, kind_of_network, new_run_text, prepare_dataset, split_text
from pipeline.kinds.image.kind import settings_of_model
from pipeline.kinds.kind import read_weights
from pipeline.kinds.nir.importing import refuse_early, settings_of_nir
from pipeline.kinds.steps import StepInputs
from pipeline.progress import hide_progress, progress
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.events import facts_of
from pipeline.recordings.source import reading_lines
from pipeline.recordings.splits import PUBLISHED, copies, find_classes_without_test
from pipeline.run.artifacts import DELETE_IT, Artifact, Library, Origin
from pipeline.run.folder import RunFolder, working_in
from pipeline.run.settings import SIMULATED, Settings, read_settings
from pipeline.sources import recordings_of
from pipeline.training.adaptation import with_rehearsal

__all__ = [
    "Opened",
    "check_stage",
    "check_stages",
    "convert",
    "open_run",
    "opened_in",
    "opened_run",
    "refuse_early",
    "settings_of_model",
    "settings_of_nir",
]


@dataclass(frozen=True)
class Opened:
    """Settings, recordings and folder of a run or experiment, opened once and passed on.

    Attributes
    ----------
    place : RunFolder or Library
        Has the artifacts.
    settings : Settings
        With all that was chosen for the recordings.
    dataset : Dataset
    kind : NetworkKind
        What depends on the kind of network.
    say : callable
        Called with a line about each stage.
    """

    place: RunFolder | Library
    settings: Settings
    dataset: Dataset
    kind: NetworkKind
    say: Callable = print

    @property
    def run(self) -> RunFolder:
        """The folder of a run; an experiment, whose place is a library, has none."""
        assert isinstance(self.place, RunFolder), "an experiment is not a run"
        return self.place

    def artifact(self, name: str) -> Artifact:
        """The artifact of one of the :attr:`pipeline.kinds.kind.NetworkKind.steps`."""
        return self.kind.artifact(name, self.place, self.dataset.origin)

    def step_inputs(self, names) -> StepInputs:
        """What is made from the named settings only; reading others is an error."""
        view = self.settings.only(names)
        dataset = self.dataset.restrict_to(view)
        return StepInputs(view, dataset, self.artifact, self.weights, self.say)

    def make(self, name: str) -> dict:
        """Make a step, unless it is current; return its record.

        A trained network's record has its ``accuracy`` on each set of the split, the number of
        ``epochs`` and the ``seconds`` of the training.
        """
        step = self.kind.step(name)
        artifact = self.artifact(name)
        imported = self.kind.imported
        state = artifact.state()
        if state.is_current:
            self.say(f"{name}: up to date ({artifact.folder})")
            return state.record
        state.announce(step.action, self.say)
        if imported is not None and imported.step == name:
            for line in imported.split_notes(state, self.settings.seed):
                self.say(line)
        inputs = self.step_inputs(artifact.origin.settings)
        record = artifact.write(step.make(inputs, artifact))
        for file in step.temporary:
            (artifact.folder / file).unlink(missing_ok=True)
        return record

    def make_all(self, name: str | None = None) -> dict:
        """Make a step and all that it is made from; return its record.

        Parameters
        ----------
        name : str, optional
            Default: the step from which the bundle is made.
        """
        for step in self.kind.steps_of(name or self.kind.deployed):
            record = self.make(step.name)
        return record

    def weights(self, name: str) -> dict:
        """The trained arrays of a step; see :func:`pipeline.kinds.kind.read_weights`."""
        return read_weights(self.artifact(name).folder, self.kind.shapes(name))

    def spec(self, provenance: dict | None = None) -> NetworkSpec:
        """The deployed network, made from the trained one."""
        origin = self.kind.bundle_origin(self.dataset.origin)
        return self.kind.spec(self.step_inputs(origin.settings), provenance or {})


def opened_in(place, settings: Settings, dataset: Dataset, say=print) -> Opened:
    """What an experiment opens: the settings are complete, the dataset is loaded.

    Parameters
    ----------
    place : RunFolder or Library
    settings : Settings
        All, or only those that an origin declares.
    dataset : Dataset
    say : callable
    """
    return Opened(place, settings, dataset, kind_of_network(settings), say)


def open_run(
    run: RunFolder, settings: Settings, jobs: int = 2, say=print, check: bool = True
) -> Opened:
    """Load the recordings of a run, choose what the settings leave open, and save both.

    Nothing is saved if the recordings, settings or a user's network are insufficient.

    Parameters
    ----------
    run : RunFolder
        Locked.
    settings : Settings
        What the user has set; values with their defaults are chosen for the recordings.
    jobs : int
        Number of processes for recordings that are not in the cache.
    say : callable
        Called with each note and warning.
    check : bool
        True if the samples of a check will be drawn; a training needs none.

    Raises
    ------
    UserError
        The source cannot be read, is too small for the split or the check, or cannot be presented;
        the check's samples are too large for a bundle; the bundle's folder has other files; or the
        user's network cannot be used.  All problems with the settings are reported together.
    """
    lines: list[str] = []
    recordings = recordings_of(settings, jobs, say)
    dataset = prepare_dataset(settings, recordings, check, lines.append)
    chosen = dataset.settings
    opened = opened_in(run, chosen, dataset, say)
    if check:
        _require_check_fits(opened)
    opened.kind.require_usable(opened.step_inputs(chosen.flat()))
    for line in _notes(opened, lines):
        say(line)
    run.save_settings(chosen)
    artifact = dataset_artifact(run, dataset.origin)
    if not artifact.state().is_current:
        parts = ("train", "validation", "test")
        sizes = {part: len(getattr(dataset.split, part)) for part in parts}
        artifact.write({**facts_of(recordings), **sizes, "split": dataset.split.kind})
    return opened


def _require_check_fits(opened):
    """Refuse a run whose bundle or check could not be written later."""
    settings = opened.settings
    sensor = opened.dataset.recordings.sensor
    require_replaceable(opened.run.bundle)
    shape = (sensor.rows, sensor.columns, opened.kind.channels)
    stimulus = settings.stimulus
    samples = settings.check.count_samples(len(opened.dataset.split.test))
    require_room(samples, stimulus.sample_shape(shape, settings.steps), stimulus)
    opened.kind.require_presentable(opened.dataset)


@contextlib.contextmanager
def opened_run(path, settings: Settings | dict | None = None, **more):
    """Lock a run's folder, new or not, for a block of statements, and open it.

    Parameters
    ----------
    path : path-like
        Folder of the run.
    settings : Settings or dict, optional
        A dict, nested as in :meth:`pipeline.run.settings.schema.Settings.with_values`, changes
        what was set for the run; settings replace it.
    **more
        As in :func:`open_run`.

    Yields
    ------
    Opened

    Raises
    ------
    UserError
        As :func:`open_run`; the folder has other files, or another process works in it.
    """
    with working_in(path) as run:
        if isinstance(settings, Settings):
            resolved = settings
        else:
            resolved = run.resolve_settings(None, {}).with_values(settings or {})
        yield open_run(run, resolved, **more)


def dataset_artifact(run: RunFolder, origin: Origin) -> Artifact:
    """The description of a run's recordings."""
    return Artifact("dataset", run.dataset, origin)


def _notes(opened, choices):
    """What the user should know of the recordings and of what was chosen for them."""
    run = opened.run
    kind = opened.kind
    if run.experiment.exists():
        was = kind_of_network(read_settings(run.experiment))
        if was.name != kind.name:
            yield (
                f"{WARNING}{run.path}: was a run of the kind {was.name!r}; its network and bundle "
                "are replaced (name another folder to keep both)"
            )
    elif opened.settings.data.source == SIMULATED:
        yield f"{run.path}: a new run, on simulated recordings (others: --data)"
    else:
        yield new_run_text(run.path, opened.dataset)
    if run.experiment.exists() and (text := split_text(opened.dataset)):
        yield f"{run.path}: {text}"
    yield from choices
    if kind.imported is not None:
        yield from kind.imported.list_changes()
    yield from _notes_on_recordings(opened)


# Test recordings below which a user is warned.
MIN_TEST_RECORDINGS = 10

# What is wrong with recordings that are in the source twice; see :func:`copies`.
COPY_TEXTS = (
    "test recordings that are also in training (their accuracy says little about others)",
    "recordings that are also in another class",
)


def _notes_on_recordings(opened):
    """Lines on what is not presented, on sets that are not independent, and on what is missing."""
    recordings = opened.dataset.recordings
    split = opened.dataset.split
    yield from opened.kind.notes(recordings)
    if split.kind == PUBLISHED or not recordings.source.simulated:
        for pairs, what in zip(copies(recordings, split), COPY_TEXTS, strict=True):
            if pairs:
                what = f"{what}: {len(pairs)}, such as {pairs[0][1]} ({pairs[0][0]})"
                yield f"{WARNING}{recordings.source.name}: {what}"
    n_test = len(split.test)
    samples = opened.settings.check.samples
    if split.kind == PUBLISHED and n_test < samples:
        yield (
            f"{recordings.source.name}: the test set has {n_test} recordings, fewer than the "
            f"{samples} of a check; the check uses all of them"
        )
    if n_test < MIN_TEST_RECORDINGS:
        few = plural(n_test, "recording")
        yield f"{WARNING}{recordings.source.name}: only {few} for the test; record more"
    if absent := find_classes_without_test(recordings, split):
        yield (
            f"{WARNING}{recordings.source.name}: the test set has no recordings of "
            f"{list_names(absent)}; no accuracy says anything about them"
        )
    classes = recordings.sensor.classes
    missing = sorted(set(range(len(classes))) - set(recordings.labels.tolist()))
    if missing:
        names = ", ".join(classes[label] for label in missing)
        problem = f"no recordings of {names}; their outputs learn nothing"
        yield f"{WARNING}{recordings.source.name}: {problem}"


def convert(opened: Opened) -> Bundle:
    """Make all that the bundle is made from, and write it, unless it is current."""
    opened.make_all()
    run = opened.run
    say = opened.say
    artifact = bundle_artifact(run, opened.kind, opened.dataset.origin)
    state = artifact.state()
    origin = artifact.origin
    if state.is_current:
        say(f"bundle: up to date ({run.bundle})")
        return read_bundle(run.bundle)
    state.announce("writing", say)
    inputs = opened.step_inputs(origin.settings)
    seed = inputs.settings.seed
    dataset = inputs.dataset
    spec = opened.spec(_describe_source(opened, inputs, origin))
    spec = with_rehearsal(spec, dataset.inputs, dataset.labels, dataset.split.train, seed)
    bundle = write_bundle(run.bundle, spec, _choose_check_samples(inputs))
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")
    for name in find_rescaled_layers(spec.layers) if opened.kind.is_trained_in_integers else ():
        say(
            f"{WARNING}{name}: is divided among cores, whose weights NengoLoihi scales apart, so "
            "that integers differ a bit from training: see 'stmnist ladder', or use fewer neurons"
        )
    return bundle


def _describe_source(opened, inputs, origin) -> dict:
    """The provenance that is stored in a bundle."""
    recordings = inputs.dataset.recordings
    lost_lines = reading_lines(recordings.source.name, recordings)
    notes = (*lost_lines, *_notes_on_recordings(opened))
    return {
        "made_from": origin.to_json(),
        **inputs.dataset.provenance,
        "seed": inputs.settings.seed,
        "recipe": opened.kind.recipe,
        "package": __version__,
        "warnings": [note.removeprefix(WARNING) for note in notes if note.startswith(WARNING)],
    }


def _choose_check_samples(inputs) -> CheckSet:
    """The samples of a bundle's check."""
    dataset = inputs.dataset
    seed = inputs.settings.seed
    number = inputs.settings.check.count_samples(len(dataset.split.test))
    chosen = dataset.split.check_samples(number, seed)
    recordings = dataset.recordings.subset(chosen)
    return CheckSet(dataset.inputs[chosen], recordings.labels, recordings.ids, seed)


def bundle_artifact(run: RunFolder, kind: NetworkKind, dataset: Origin, name="bundle") -> Artifact:
    """The bundle of a run, or one that was adapted from it, such as ``"adapted/7"``."""
    network, *others = (run.path / name / file for file in (*FILES, "MANIFEST.json"))
    origin = kind.bundle_origin(dataset)
    return Artifact(name, network, origin, tuple(others), _read_bundle_record)


def _read_bundle_record(network):
    provenance = network.get("provenance")
    return provenance.get("made_from") if isinstance(provenance, dict) else None


def settings_read(spec: NetworkSpec) -> dict:
    """The settings that a bundle's network was made with, by their dotted names.

    Settings that have no effect on it are not among them.
    """
    settings = spec.provenance["made_from"]["settings"]
    # A run whose steps are the default, 0, may have as many as one with a number.
    steps = settings.get("presentation.steps") or spec.presentation.steps
    return {**settings, "presentation.steps": steps}


def check_stage(opened: Opened, bundle: Bundle, stage: str) -> dict:
    """The check result of a reference stage or target, made unless it is current.

    Parameters
    ----------
    opened : Opened
        Of a run.
    bundle : Bundle
        The run's own bundle, or that with other recordings of it.
    stage : str
        One of the kind's reference stages, or a target.
    """
    artifact = _check_artifact_of(opened, bundle, stage)
    path = artifact.record
    state = artifact.state()
    if state.is_current:
        opened.say(f"{stage}: up to date ({path})")
        return read_result(path, DELETE_IT)
    state.announce("answering", opened.say)
    if stage in TARGETS:
        with progress(f"check {stage}", len(bundle.checks)) as advance:
            return run_check(bundle, stage, path, opened.settings.seed, advance)
    result = _check_reference(opened, bundle, stage)
    write_json(path, result)
    return result


def _check_reference(opened, bundle, stage) -> dict:
    """The check result of a reference stage, whose network is trained if it is missing."""
    reference = opened.kind.references[stage]
    extra = {"versions": reference.versions()}
    is_deployed = opened.kind.is_deployed(reference.step)
    if not is_deployed:
        opened.make(reference.step)
    origin = opened.artifact(reference.step).origin
    if not is_deployed:
        extra["network"] = origin.key
    made_from = bundle.spec.provenance["made_from"]
    inputs = opened.step_inputs(made_from["settings"].keys() | origin.settings.keys())
    begun = time.perf_counter()
    with progress(f"check {stage}", len(bundle.checks)) as advance:
        responses = reference.respond_to(stage, inputs, bundle, advance)
    seconds = time.perf_counter() - begun
    samples = records_of(bundle.checks, responses)
    return result_of(bundle, stage, opened.settings.seed, samples, seconds, extra)


def check_stages(opened: Opened, bundle: Bundle, stages, jobs: int = 1) -> list:
    """Run :func:`check_stage` for several stages: targets in processes, networks in this process.

    Processes share single streams, not targets, so that no core is idle during the last target.

    Parameters
    ----------
    opened, bundle
        As in :func:`check_stage`.
    stages : sequence of str
    jobs : int
        Number of processes.

    Returns
    -------
    list of dict
        The results in the order of ``stages``.

    Raises
    ------
    UserError
        A target failed; the results of the others are saved.
    """
    artifacts = {stage: _check_artifact_of(opened, bundle, stage) for stage in stages}
    states = {stage: artifact.state() for stage, artifact in artifacts.items()}
    targets = [stage for stage in stages if stage in TARGETS and not states[stage].is_current]
    results = {}
    if jobs > 1 and any(TARGETS[name].slow for name in targets):
        for name in targets:
            states[name].announce("answering", opened.say)
        paths = {name: artifacts[name].record for name in targets}
        others = [stage for stage in stages if stage not in targets]
        results = _check_side_by_side(opened, bundle, paths, others, jobs)
    for stage in stages:
        if stage not in results:
            results[stage] = check_stage(opened, bundle, stage)
    return [results[stage] for stage in stages]


def _check_side_by_side(opened, bundle, paths, others, jobs) -> dict:
    """Results by name of targets in processes, and of the other stages in this process.

    Parameters
    ----------
    paths : dict of str to Path
        File of each target's result.
    others : list of str
    """
    results = {}
    n_stages = len(paths) + len(others)
    with progress("check", n_stages * len(bundle.checks)) as advance:

        def check_others():
            for stage in others:
                with hide_progress():
                    results[stage] = check_stage(opened, bundle, stage)
                advance(len(bundle.checks), stage)

        seed = opened.settings.seed
        of_targets = _run_targets(bundle, paths, seed, jobs, advance, check_others)
    return {**results, **of_targets}


def _run_targets(bundle, paths, seed, jobs, advance, meanwhile):
    """Results of targets by name; each remaining stream is a job if any of the targets is slow."""
    checks = {}
    failures = {}
    with contextlib.ExitStack() as stack:
        for name, path in paths.items():
            report = partial(advance, note=name)
            checks[name] = stack.enter_context(open_check(bundle, name, path, seed, report))
        work = []
        for check in checks.values():
            jobs_of_check = (
                [[stream] for stream in check.left] if check.target.slow else [check.left]
            )
            work += [check.work(streams) for streams in jobs_of_check if streams]
        for job, records in run_jobs(_run_all_streams, work, jobs, meanwhile=meanwhile):
            if isinstance(records, Failure):
                failures.setdefault(job.target, records)
            else:
                for record in records:
                    checks[job.target].take(record)
        results = {name: checks[name].finish() for name in checks if name not in failures}
    for name, failure in failures.items():
        failure.raise_again(f"target {name}")
    return results


def _run_all_streams(work):
    return list(run_streams(work))


def _check_artifact_of(opened, bundle, stage):
    """The artifact of a check's result; one that is damaged is refused and not replaced."""
    stages = (*opened.kind.references, *TARGETS)
    if stage not in stages:
        raise UserError(f"no stage or target {stage!r}; they are {', '.join(stages)}")
    origin = opened.dataset.origin
    artifact = check_artifact(opened.place, stage, opened.kind, origin, bundle.id)
    if artifact.record.exists():
        read_result(artifact.record, DELETE_IT)
    return artifact


# The samples of a check on those of the bundle.
OWN_SAMPLES = "the bundle's"


def check_artifact(
    run: RunFolder, stage: str, kind: NetworkKind, dataset: Origin, bundle_id: str
) -> Artifact:
    """The result of a stage on a bundle's samples.

    It depends on the bundle, which may have been copied to another machine; the result of a network
    from which the bundle is not made depends on that network too.
    """
    contents = {"bundle": bundle_id, "target": stage, "samples": OWN_SAMPLES}
    if stage in kind.references and stage not in kind.deployed_stages:
        contents["network"] = kind.origin(kind.references[stage].step, dataset).key
    origin = Origin({"seed": kind.settings.seed}, contents)
    return Artifact(f"checks/{stage}", run.check(stage), origin, made_from=_read_check_record)


def _read_check_record(result):
    names = ("bundle", "network", "target")
    contents = {name: result[name] for name in names if name in result}
    contents["samples"] = "others" if result.get("data") else OWN_SAMPLES
    return Origin({"seed": result.get("seed")}, contents).to_json()
