"""Open a run or an experiment: load its recordings, and choose what its settings leave open."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

from deploy.check.bundle import require_replaceable, require_room
from deploy.network.spec import NetworkSpec
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.preparation import prepare_dataset
from pipeline.kinds.records import read_weights
from pipeline.kinds.registry import find_kind
from pipeline.kinds.steps import StepInputs
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.recordings import list_facts
from pipeline.recordings.splits import PARTS
from pipeline.settings import Settings
from pipeline.sources import load_named_recordings
from pipeline.storage.artifacts import Artifact, Library, Origin
from pipeline.storage.run_folder import RunFolder, lock_run
from pipeline.workflow.notes import list_notes, list_replacements


@dataclass(frozen=True)
class OpenedRun:
    """Settings, recordings and folder of a run or experiment, opened once and passed on.

    Attributes
    ----------
    store : RunFolder or Library
        The store of the artifacts.
    settings : Settings
        With all that was chosen for the recordings.
    dataset : Dataset
    kind : NetworkKind
        What depends on the kind of network.
    say : callable
        Called with a line about each stage.
    """

    store: RunFolder | Library
    settings: Settings
    dataset: Dataset
    kind: NetworkKind
    say: Callable = print

    @property
    def run(self) -> RunFolder:
        """The folder of a run; an experiment, whose store is a library, has none."""
        assert isinstance(self.store, RunFolder), "an experiment is not a run"
        return self.store

    def find_artifact(self, name: str) -> Artifact:
        """The artifact of one of the :attr:`pipeline.kinds.kind.NetworkKind.steps`."""
        return self.kind.find_artifact(name, self.store, self.dataset.origin)

    def make_step_inputs(self, names) -> StepInputs:
        """The inputs of a step, with the named settings only; a step that reads another fails."""
        view = self.settings.select(names)
        dataset = self.dataset.restrict_to(view)
        return StepInputs(view, dataset, self.find_artifact, self.read_weights, self.say)

    def make(self, name: str) -> dict:
        """Make a step, unless it is current; return its record.

        A trained network's record has its ``accuracy`` on each set of the split, the number of
        ``epochs`` and the ``seconds`` of the training.
        """
        step = self.kind.find_step(name)
        artifact = self.find_artifact(name)
        imported = self.kind.imported
        state = artifact.find_state()
        if state.is_current:
            self.say(f"{name}: up to date ({artifact.folder})")
            return state.record
        state.announce(step.action, self.say)
        if imported is not None and imported.step == name:
            for line in imported.list_split_notes(state, self.settings.seed):
                self.say(line)
        inputs = self.make_step_inputs(artifact.origin.settings)
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
        requested = name or self.kind.deployed_step
        records = {step.name: self.make(step.name) for step in self.kind.list_steps_to(requested)}
        return records[requested]

    def read_weights(self, name: str) -> dict:
        """The trained arrays of a step; see :func:`pipeline.kinds.records.read_weights`."""
        return read_weights(self.find_artifact(name).folder, self.kind.list_shapes(name))

    def make_spec(self, provenance: dict | None = None) -> NetworkSpec:
        """The deployed network, made from the trained one."""
        origin = self.kind.make_bundle_origin(self.dataset.origin)
        return self.kind.make_spec(self.make_step_inputs(origin.settings), provenance or {})


def open_experiment(store, settings: Settings, dataset: Dataset, say=print) -> OpenedRun:
    """Open an experiment, whose settings are complete and whose dataset is loaded.

    Parameters
    ----------
    store : RunFolder or Library
    settings : Settings
        All, or only those that an origin declares.
    dataset : Dataset
    say : callable
    """
    return OpenedRun(store, settings, dataset, find_kind(settings), say)


def open_run(
    run: RunFolder,
    settings: Settings,
    jobs: int = 2,
    say=print,
    needs_check: bool = True,
    warns: bool = True,
) -> OpenedRun:
    """Load the recordings of a run, choose what the settings leave open, and save both.

    Nothing is saved if the recordings, settings or a user's network are insufficient.

    Parameters
    ----------
    run : RunFolder
        The run, which is locked.
    settings : Settings
        What the user has set; values with their defaults are chosen for the recordings.
    jobs : int
        Number of processes for recordings that are not in the cache.
    say : callable
        Called with each note and warning.
    needs_check : bool
        True if the samples of a check will be drawn; training needs none.
    warns : bool
        True to warn that networks of other recordings or of another kind will be replaced.

    Raises
    ------
    UserError
        The source cannot be read, is too small for the split or the check, or cannot be presented;
        the check's samples are too large for a bundle; the bundle's folder has other files; or the
        user's network cannot be used.  All problems with the settings are reported together.
    """
    lines: list[str] = []
    recordings = load_named_recordings(settings, jobs, say)
    dataset = prepare_dataset(settings, recordings, needs_check, lines.append)
    chosen = dataset.settings
    opened = open_experiment(run, chosen, dataset, say)
    if needs_check:
        _require_check_fits(opened)
    opened.kind.require_usable(opened.make_step_inputs(chosen.flatten()))
    if warns:
        for line in list_replacements(opened):
            say(line)
    for line in list_notes(opened, lines):
        say(line)
    run.save_settings(chosen)
    artifact = find_dataset_artifact(run, dataset.origin)
    if not artifact.find_state().is_current:
        sizes = {part: len(dataset.split.get_indices(part)) for part in PARTS}
        artifact.write({**list_facts(recordings), **sizes, "split": dataset.split.kind})
    return opened


def _require_check_fits(opened):
    """Refuse a run whose bundle or check could not be written later."""
    settings = opened.settings
    sensor = opened.dataset.recordings.sensor
    require_replaceable(opened.run.bundle)
    shape = (sensor.rows, sensor.columns, opened.kind.channels)
    stimulus = settings.stimulus
    samples = settings.check.count_samples(len(opened.dataset.split.test))
    require_room(samples, stimulus.find_sample_shape(shape, settings.steps), stimulus)
    opened.kind.require_presentable(opened.dataset)


@contextlib.contextmanager
def open_locked_run(path, settings: Settings | dict | None = None, **more):
    """Lock a run's folder, new or not, for a block of statements, and open it.

    Parameters
    ----------
    path : path-like
        Folder of the run.
    settings : Settings or dict, optional
        A dict, nested as in :meth:`pipeline.settings.schema.Settings.with_values`, changes
        what was set for the run; settings replace it.
    **more
        As in :func:`open_run`.

    Yields
    ------
    OpenedRun

    Raises
    ------
    UserError
        As :func:`open_run`; the folder has other files, or another process works in it.
    """
    with lock_run(path) as run:
        if isinstance(settings, Settings):
            resolved = settings
        else:
            resolved = run.resolve_settings(None, {}).with_values(settings or {})
        yield open_run(run, resolved, **more)


def find_dataset_artifact(run: RunFolder, origin: Origin) -> Artifact:
    """The description of a run's recordings."""
    return Artifact("dataset", run.dataset, origin)
