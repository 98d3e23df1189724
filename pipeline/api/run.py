"""A run from Python: its stages as methods, and their results as objects."""

from __future__ import annotations

import contextlib
import difflib
import tempfile
from dataclasses import replace
from numbers import Integral
from os import PathLike
from pathlib import Path, PurePath

from deploy.check.bundle import Bundle, read_bundle
from deploy.check.energy import estimate_energy
from deploy.errors import UserError
from deploy.files import hash_file, read_json
from deploy.network.provenance import read_classes
from deploy.preflight.plan import make_plan
from deploy.targets.registry import TARGETS
from deploy.terminal import WARNING, format_command, remark
from pipeline import workflow
from pipeline.api.results import (
    CheckResult,
    ChipPlan,
    Energy,
    Ladder,
    Predictions,
    RunsComparison,
    Training,
)
from pipeline.kinds.preparation import prepare_dataset
from pipeline.kinds.registry import has_networks
from pipeline.progress import hide_progress
from pipeline.recordings.arrays import name_in_errors
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.recordings import Recordings
from pipeline.results import compare, other_recordings
from pipeline.results.check_on_others import OtherRecordings, check_on_others
from pipeline.results.ladder import measure_ladder
from pipeline.results.report import write_report
from pipeline.results.report.samples import replay_samples
from pipeline.settings import (
    SIMULATED,
    Settings,
    merge_values,
    read_settings,
    set_nested,
    suggest_name,
)
from pipeline.sources import load_named_recordings
from pipeline.storage.run_folder import RunFolder, lock_run, require_run_or_new_folder
from pipeline.workflow.target_check import TargetCheck

# Source of the settings in the messages of errors.
ORIGIN = "Run"

# Arguments of Run that are not settings.
ARGUMENTS = ("data", "input", "jobs", "quiet")

# File next to the folder of a run for recordings that were given in memory.
RECORDINGS_ENDING = ".recordings.zip"


class Run:
    """A run: a folder with a network, its recordings and its results.

    Each method makes what is missing or outdated, and returns the rest as it is, like the command
    of the same name.  The folder is locked while a method runs.

    Parameters
    ----------
    path : path-like
        Folder of the run, new or existing; an existing run keeps its settings.
    data : path-like or Recordings, optional
        Recordings: a zip or folder; default: those of the run, or simulated ones.  Recordings in
        memory are written next to the folder.
    input : str, optional
        ``"image"``, ``"slices"`` or ``"events"``; default: as the run, or images.
    jobs : int
        Number of processes, at least 1.
    quiet : bool
        True to print neither lines nor progress; :attr:`notes` has the lines in any case.
    **settings
        Other settings by their names: ``seed=1, **{"events.epochs": 40}``.

    Attributes
    ----------
    path : Path
    notes : list of str
        What the last method has said: choices, warnings, what is up to date.  Each method begins a
        new list, to which the attributes (`dataset`, `bundle`) add their lines.  Choices and
        warnings on the recordings are in the notes of each method, and printed by the first only.

    Raises
    ------
    UserError
        A setting, its value or the number of processes is not valid, or the folder is no run;
        nothing is written.

    Examples
    --------
    >>> run = Run("runs/mine", data="recordings.zip", input="events", **{"events.epochs": 40})
    >>> run.ladder()
    Ladder(counts 0.842, trained 0.900, nengo 0.900, simreal 0.900, emulator 0.900)
    >>> run.check("fast").accuracy
    0.9
    """

    def __init__(self, path, data=None, input=None, jobs=2, quiet=False, **settings):
        self.path = Path(path)
        self.notes = []
        self._printed = set()
        _refuse_misspelt_arguments(settings)
        is_in_memory = isinstance(data, Recordings)
        if is_in_memory:
            _refuse_unit_of_files(settings)
        self._jobs = _require_jobs(jobs)
        self._quiet = quiet
        self._input = input
        self._folder = RunFolder(self.path)
        require_run_or_new_folder(self.path)
        changes = {}
        if data is not None:
            set_nested(changes, "data.source", self._name_source(data), ORIGIN)
        if input is not None:
            set_nested(changes, "input.kind", input, ORIGIN)
        for name, value in settings.items():
            set_nested(changes, name, value, ORIGIN)
        before = self._folder.resolve_settings(None, {})
        if is_in_memory and before.data.time_unit:
            set_nested(changes, "data.time_unit", "", ORIGIN)  # the run's unit was of other files
        self._user_settings = before.with_values(changes, ORIGIN)
        self._changes = changes
        if is_in_memory:
            data.write(self._name_source(data))
        if line := self._suggest_run():
            self._say(line)
        if line := self._describe_changes():
            self._say(
                f"{WARNING}{self.path}: {line}: the next methods make its networks, bundle and "
                "checks again if they depend on this; to keep the present ones, give another path"
            )

    def __repr__(self):
        settings = self._user_settings
        source = settings.data.source
        source = source if source == SIMULATED else PurePath(source).name
        is_new = "" if self._folder.experiment.exists() else "new, "
        return f"Run({str(self.path)!r}: {is_new}{settings.input.kind}, {source})"

    @property
    def settings(self) -> Settings:
        """All settings, with those that were chosen for the recordings once it is open."""
        if self._folder.experiment.exists():
            return read_settings(self._folder.experiment)
        return self._user_settings

    @property
    def dataset(self) -> Dataset:
        """The recordings, their split, and the inputs of the network."""
        with self._hide_progress_if_quiet():
            recordings = load_named_recordings(self._user_settings, self._jobs, self._say_once)
            return prepare_dataset(self._user_settings, recordings, needs_check=False)

    @property
    def recordings(self) -> Recordings:
        """The recordings of all sets of the split."""
        return self.dataset.recordings

    @property
    def bundle(self) -> Bundle:
        """The network as it is deployed, which :meth:`convert` makes."""
        if not self._folder.bundle.is_dir():
            raise UserError(
                f"{self.path}: has no bundle yet; make it with run.convert(), or "
                f"{format_command('convert', self.path)}"
            )
        if line := self._describe_changes():
            self._say(
                f"{WARNING}{self.path}: {line}: its bundle is the former one; run.convert() makes "
                "that of the present settings"
            )
        return read_bundle(self._folder.bundle)

    def _suggest_run(self):
        """The run next to a new one that may be meant, in a line; empty without one.

        A new run without recordings may be a misspelt one.
        """
        if self._folder.experiment.exists() or self._user_settings.data.source != SIMULATED:
            return ""
        runs = [each.parent.name for each in self.path.parent.glob("*/experiment.toml")]
        near = difflib.get_close_matches(self.path.name, runs, n=1)
        if not near:
            return ""
        return (
            f"{self.path}: a new run, on simulated digits (did you mean the run "
            f"{self.path.with_name(near[0])}?)"
        )

    def _describe_changes(self):
        """The settings that differ from those of the networks of the run, in a line."""
        folder = self._folder
        if not folder.experiment.exists():
            return ""
        stored = read_settings(folder.experiment)
        if not folder.bundle.exists() and not has_networks(stored, self.path):
            return ""
        before = stored.flatten()
        now = self._user_settings.flatten()
        changes = [
            f"{name} from {before[name]!r} to {now[name]!r}"
            for name in _list_names(self._changes)
            if before[name] != now[name]
        ]
        if not changes and self._has_other_recordings():
            changes = ["the recordings in memory"]
        return f"changed {', '.join(changes)}" if changes else ""

    def _has_other_recordings(self):
        """True if recordings in memory differ from those that the run was made on."""
        source = Path(self._user_settings.data.source)
        if not source.name.endswith(RECORDINGS_ENDING) or not self._folder.dataset.exists():
            return False
        recorded = read_json(self._folder.dataset, "").get("sha256")
        return source.is_file() and recorded != hash_file(source)

    def train(self) -> Training:
        """Train the networks; on images the CNN, on events the spiking network."""
        with self._open(needs_check=False) as opened:
            records: dict = {}
            for name in opened.kind.trained_steps:
                network = opened.kind.find_step(name).measures or name
                records[network] = {**records.get(network, {}), **opened.make(name)}
            return Training(records)

    def convert(
        self,
        model=None,
        nir=None,
        step: float | None = None,
        retrain: bool = False,
        strict: bool = False,
    ) -> Bundle:
        """Train the spiking network, or import one, and write the bundle.

        Parameters
        ----------
        model : path-like, optional
            A Keras model (.keras or .h5) that replaces the CNN; only one you trust.  It gets the
            images of an existing run.
        nir : path-like, optional
            A NIR graph that replaces all training.
        step : float, optional
            With ``nir``: milliseconds of the recording in a step of the network.
        retrain : bool
            With ``model``: train it further with rate-LIF neurons.
        strict : bool
            With ``nir``: refuse a graph that was trained with another reset than the chip's.
        """
        imported = workflow.ImportRequest(
            model=model, nir=nir, step_ms=step, retrain=retrain, strict=strict
        )
        changes = imported.make_settings(self._user_settings, self._input, self._folder)
        changes = merge_values(changes, self._changes)  # what the user has set wins
        self._user_settings = self._user_settings.with_values(changes, ORIGIN)
        with self._open(validate=imported.require_convertible) as opened:
            return workflow.convert_and_check(opened)

    def ladder(self, stages=None) -> Ladder:
        """Test each stage on the way to the chip on the same samples.

        Parameters
        ----------
        stages : sequence of str, optional
            Stages; default: all up to the emulator.
        """
        if isinstance(stages, str):
            stages = [stages]
        with self._open() as opened:
            return Ladder(measure_ladder(opened, self._jobs, stages))

    def check(self, target: str = "fast", data=None, samples: int | None = None) -> CheckResult:
        """Test the network on a target, or one of its stages before.

        Parameters
        ----------
        target : str
            Such as ``"fast"``, ``"nengo"``, ``"emulator"``, ``"rate-lif"`` or ``"trained"``.
        data : path-like or Recordings, optional
            Other recordings of the same sensor and classes; default: the bundle's samples.
        samples : int, optional
            With ``data``: number of recordings that are drawn at random; 0 for all, default 200.
            The bundle's own samples are as many as the setting ``check.samples`` says.
        """
        _require_samples(samples, data)
        if data is not None:
            return self._check_on_others(target, data, samples)
        with self._open() as opened:
            if target not in opened.kind.references and target not in TARGETS:
                names = ", ".join((*opened.kind.references, *TARGETS))
                raise UserError(f"{ORIGIN}: no stage or target {target!r}; they are {names}")
            result = workflow.check_stage(opened, workflow.convert(opened), target)
            return CheckResult(result, opened.dataset.recordings.sensor.classes)

    def predict(self, recordings, target: str = "fast") -> Predictions:
        """Classify recordings, with or without labels, each with the network at rest before it.

        Parameters
        ----------
        recordings : path-like or Recordings
            A zip or folder, also without folders of classes, or one file.  Those in memory are
            named by their ``ids``.
        target : str
        """
        with self._collect_notes(), self._put_on_disk(recordings) as path:
            others = OtherRecordings(str(path), jobs=self._jobs, name=_get_name(recordings))
            predictions = other_recordings.predict_recordings(
                self.bundle, others, target, self._say
            )
        if isinstance(recordings, Recordings):  # whose files have their numbers as names
            numbered = {int(PurePath(each.recording).name): each for each in predictions}
            predictions = [
                replace(numbered[number], recording=recordings.ids[number])
                for number in sorted(numbered)
            ]
        return Predictions(predictions, read_classes(self.bundle.spec))

    def plan(self) -> ChipPlan:
        """The resources of the chip that the network needs."""
        with self._collect_notes():
            return ChipPlan(make_plan(self.bundle.spec))

    def energy(self, target: str = "fast") -> Energy:
        """An estimate of the energy of an inference, from the spikes on a target."""
        result = self.check(target)
        return Energy(estimate_energy(self.bundle.spec, result.to_dict()))

    def report(self, path=None) -> Path:
        """Write the results as one HTML file; default: ``report.html`` in the run's folder."""
        with self._collect_notes():
            return write_report(self.path, path)

    def replay(self, numbers) -> dict:
        """Run samples of the check again, and return every spike.

        Parameters
        ----------
        numbers : int or sequence of int
            Numbers of samples of the check, from 0.

        Returns
        -------
        dict of int to pipeline.results.report.samples.Replay
        """
        numbers = [numbers] if isinstance(numbers, Integral) else list(numbers)
        with self._collect_notes():
            bundle = self.bundle
            n_samples = len(bundle.checks.labels)
            for number in numbers:
                if not 0 <= number < n_samples:
                    raise UserError(
                        f"{ORIGIN}: no sample {number}; those of the check are 0 to {n_samples - 1}"
                    )
            return replay_samples(bundle, numbers)

    @contextlib.contextmanager
    def _open(self, needs_check=True, validate=None):
        with self._collect_notes(), lock_run(self.path) as folder:
            if validate is not None:
                validate(self._user_settings)
            opened = workflow.open_run(
                folder,
                self._user_settings,
                self._jobs,
                self._say_once,
                needs_check,
                warns=not self._describe_changes(),
            )
            yield replace(opened, say=self._say)

    @contextlib.contextmanager
    def _collect_notes(self):
        """The work of one method: its notes alone, and no progress if the run is quiet."""
        self.notes = []
        with self._hide_progress_if_quiet():
            yield

    def _hide_progress_if_quiet(self):
        return hide_progress() if self._quiet else contextlib.nullcontext()

    def _say(self, line):
        self.notes.append(line)
        if not self._quiet:
            remark(line)

    def _say_once(self, line):
        """As :meth:`_say`, but a line that an earlier method has printed is not printed again."""
        self.notes.append(line)
        if not self._quiet and line not in self._printed:
            remark(line)
        self._printed.add(line)

    def _name_source(self, data):
        if isinstance(data, Recordings):
            return str(self.path.with_name(self.path.name + RECORDINGS_ENDING))
        return str(_require_path(data))

    @contextlib.contextmanager
    def _put_on_disk(self, recordings):
        """The path of recordings, which are written to a temporary file if they are in memory."""
        if not isinstance(recordings, Recordings):
            yield _require_path(recordings)
            return
        name = recordings.source.name
        with tempfile.TemporaryDirectory() as folder:
            path = recordings.write(Path(folder) / f"{PurePath(name).stem}.zip")
            with name_in_errors(name, Path(path.name)), name_in_errors(name, path):
                yield path

    def _check_on_others(self, target, data, samples):
        """The check on other recordings, as ``stmnist check run --data``."""
        with self._collect_notes(), self._put_on_disk(data) as path:
            bundle = self.bundle
            check = TargetCheck(target, bundle.seed)
            others = OtherRecordings(str(path), samples, jobs=self._jobs, name=_get_name(data))
            result, _ = check_on_others(bundle, others, check, self._say)
        return CheckResult(result, read_classes(bundle.spec))


def _get_name(recordings) -> str:
    """The name of recordings in memory; empty for a path, whose name they have."""
    return recordings.source.name if isinstance(recordings, Recordings) else ""


def _list_names(changes, section=""):
    """Yield the dotted names of nested settings."""
    for name, value in changes.items():
        if isinstance(value, dict):
            yield from _list_names(value, f"{section}{name}.")
        else:
            yield f"{section}{name}"


def _refuse_misspelt_arguments(settings):
    """Refuse a name that is no setting and is similar to an argument of :class:`Run`."""
    known = Settings().flatten()
    for name in settings:
        suggestion = "" if name in known else suggest_name(name, ARGUMENTS)
        if suggestion:
            raise UserError(f"{ORIGIN}: {name!r} is unknown{suggestion}")


def _refuse_unit_of_files(settings):
    """Refuse a unit for recordings in memory, which have theirs."""
    if settings.get("data.time_unit"):
        raise UserError(
            f"{ORIGIN}: recordings in memory have their unit; give it as time_unit to "
            "Recordings.from_arrays or Recordings.read, and leave out data.time_unit"
        )


def _require_samples(samples, data):
    """Refuse a number of samples that is none, or for which there are no other recordings."""
    if samples is None:
        return
    if not isinstance(samples, Integral) or isinstance(samples, bool) or samples < 0:
        raise UserError(f"{ORIGIN}: {samples} samples; give a whole number from 0, which means all")
    if data is None:
        raise UserError(
            f"{ORIGIN}: samples={samples} is for other recordings, which data= names; the number "
            "of the bundle's own samples is the setting check.samples"
        )


def _require_jobs(jobs):
    """A number of processes as it is; a user's mistake otherwise."""
    if not isinstance(jobs, Integral) or isinstance(jobs, bool) or jobs < 1:
        raise UserError(f"{ORIGIN}: jobs {jobs!r} is not a number of processes; give 1 or more")
    return int(jobs)


def _require_path(recordings):
    """A path as it is; anything else cannot be recordings."""
    if not isinstance(recordings, (str, PathLike)):
        kind = type(recordings).__name__
        raise TypeError(
            f"recordings are a path or Recordings, not {kind}; Recordings.from_arrays makes them "
            "from arrays"
        )
    return recordings


def compare_runs(*runs) -> RunsComparison:
    """Compare runs: settings, accuracy of each stage, operations, cores.

    Parameters
    ----------
    *runs : Run or path-like
        Two or more; every run is compared with the first one.

    Examples
    --------
    >>> print(compare_runs("runs/image", "runs/events"))
    """
    paths = [run.path if isinstance(run, Run) else run for run in runs]
    return RunsComparison(compare.compare_runs(compare.read_runs(paths)))
