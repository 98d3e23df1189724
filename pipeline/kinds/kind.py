"""What the kinds have in common.

A *kind* is all that depends on the kind of network: the artifacts from which its bundle is made,
the deployed network, the reference stages of the ladder, and the settings that are chosen for the
recordings.  Nothing outside of this package asks what kind of network a run has.
"""

import csv
import importlib.metadata
import io
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from deploy import limits
from deploy.check.bundle import Bundle
from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import (
    open_regular,
    read_arrays,
    replacing,
    reporting_os_errors,
    sha256_of,
    write_arrays,
)
from deploy.network.responses import Responses
from deploy.network.spec import NetworkSpec
from deploy.terminal import WARNING
from models.architecture import parse
from pipeline.kinds.architectures import (
    architecture_for,
    chip_problems,
    is_for,
    suggest_sensor_size,
)
from pipeline.kinds.steps import Step, StepInputs
from pipeline.progress import progress
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.events import Recordings
from pipeline.run.artifacts import MISSING, Artifact, Origin, State
from pipeline.run.folder import DELETE_ITS_FOLDER
from pipeline.run.settings import Choice, Settings

# Maximum number of test samples for the learning curve.
MAX_CURVE_SAMPLES = 500

# Settings that change if another file is imported.
IMPORT_SETTINGS = ("nir.sha256", "cnn.model_sha256")

# Beginnings of the changes after which other samples are in the test set.
SPLIT_SETTINGS = ("seed", "split", "recordings", "data.", "skin.")


class Reference(NamedTuple):
    """A stage of the ladder before the bundle, with which those of the targets are compared.

    Attributes
    ----------
    title : str
    note : str
        What it is, in a few words.
    step : str
        Name of the step whose artifact predicts.
    logits : callable
        ``logits(stage, inputs, samples, advance)``: ndarray, shape (n_samples, steps, classes),
        with one step for a network without time.  ``inputs`` is a
        :class:`pipeline.kinds.steps.StepInputs`, ``samples`` a
        :class:`deploy.check.bundle.CheckSet`, and ``advance``, if it is not None, is called with
        the number of samples done since the last call.
    versions : callable
        Versions of the packages that compute it.
    respond : callable, optional
        ``respond(inputs, bundle, advance)``: the responses to the samples of a bundle, as
        :class:`deploy.network.responses.Responses`.  Default: computed from the logits.
    """

    title: str
    note: str
    step: str
    logits: Callable
    versions: Callable
    respond: Callable | None = None

    def respond_to(self, stage: str, inputs: StepInputs, bundle: Bundle, advance=None) -> Responses:
        """The responses of a stage to the samples of a bundle."""
        if self.respond is not None:
            return self.respond(inputs, bundle, advance)
        logits = self.logits(stage, inputs, bundle.checks, advance)
        return responses_of(logits, bundle.spec.presentation)


class Imported(NamedTuple):
    """A file of the user from which a step of a run is made.

    Attributes
    ----------
    file : str
    sha256 : str
        Of its content when it was imported.
    step : str
        Name of the step that reads it.
    remedy : str
        How a changed file is imported again.
    """

    file: str
    sha256: str
    step: str
    remedy: str

    def list_changes(self) -> Iterator[str]:
        """A warning if the file is another one now, such as a later version."""
        if Path(self.file).is_file() and not is_file(self.file, self.sha256):
            yield (
                f"{WARNING}{self.file}: has changed since it was imported; the run keeps the "
                f"earlier version; for this one {self.remedy}"
            )

    def split_notes(self, state: State, seed: int) -> Iterator[str]:
        """A line on the split that the network must have been trained on; a warning if it is new.

        Parameters
        ----------
        state : State
            Of the step that reads the file.
        seed : int
            Of the split.
        """
        changed = [change.what for change in state.because]
        if state.state == MISSING:
            yield (
                f"{self.step}: must have been trained on the training samples of this split only "
                f"(seed {seed}), otherwise the accuracies are too high"
            )
        again = [what for what in changed if what.startswith(SPLIT_SETTINGS)]
        if again and not set(changed) & set(IMPORT_SETTINGS):
            yield (
                f"{WARNING}{self.file}: was not trained on this split, so that test samples may be "
                "among those of its training; train it on this split, and give it again"
            )


class NetworkKind:
    """What depends on the kind of network; a subclass is a kind.

    Parameters
    ----------
    settings : Settings
    """

    # Name of the kind.
    name: ClassVar[str]
    # The :class:`Reference` stages of the ladder by their names, in order.
    references: ClassVar[dict] = {}
    # Name of the step from which the bundle is made.
    deployed: ClassVar[str]
    # The reference stage whose network becomes the bundle; later losses are caused by conversion.
    deployed_stage: ClassVar[str]
    # Settings of the deployed network that the bundle depends on, besides the presentation.
    placement: ClassVar[tuple] = ()
    # Section of the settings that has its architecture; empty if the network has its own.
    section: ClassVar[str] = ""
    # Channels of its input.
    channels: ClassVar[int]
    # What to try if the network is less accurate than ``counts``.
    remedy: ClassVar[str] = "the other --input, a wider architecture or more epochs"
    # Values of settings that a sweep tries unless the user names others.
    grid: ClassVar[tuple] = ()

    def __init__(self, settings: Settings):
        self.settings = settings

    @classmethod
    def describes(cls, settings: Settings) -> bool:
        """True if these settings are those of a network of this kind."""
        raise NotImplementedError

    @property
    def architecture(self) -> str:
        """The architecture of the network in the notation; empty if it has its own."""
        return getattr(self.settings, self.section).architecture if self.section else ""

    @property
    def reference_stages(self) -> tuple:
        """Names of the stages of :attr:`references` that the ladder of these settings has."""
        return tuple(self.references)

    @property
    def deployed_stages(self) -> tuple:
        """Names of the reference stages whose networks the bundle is made from."""
        return tuple(
            name for name, stage in self.references.items() if self.is_deployed(stage.step)
        )

    @property
    def steps(self) -> tuple:
        """The :class:`pipeline.kinds.steps.Step` of each artifact before the bundle, in order."""
        raise NotImplementedError

    @property
    def trained(self) -> tuple:
        """Names of the steps that ``stmnist train`` makes.

        Raises
        ------
        UserError
            The network was trained elsewhere.
        """
        raise NotImplementedError

    @property
    def recipe(self) -> str:
        """How the network was made, for the bundle's provenance: ``snn.recipe`` of images."""
        return self.name

    @property
    def is_trained_in_integers(self) -> bool:
        """True if the chip's integers are those of the trained network."""
        return True

    @property
    def imported(self) -> Imported | None:
        """The user's file that the network is read from, if there is one."""
        return None

    def step(self, name: str) -> Step:
        """The step with a name."""
        steps = {step.name: step for step in self.steps}
        if name not in steps:
            raise ValueError(f"no step {name!r}; the steps are {', '.join(steps)}")
        return steps[name]

    def origin(self, name: str, dataset: Origin) -> Origin:
        """The origin of a step, from that of the dataset."""
        step = self.step(name)
        uses = [self.origin(used, dataset) for used in step.uses] or [dataset]
        return Origin.of(self.settings, step.reads, uses)

    def steps_of(self, name: str) -> tuple:
        """A step and those that it is made from, directly or through others, in order."""
        names = [name]
        for each in names:
            names += self.step(each).uses
        return tuple(step for step in self.steps if step.name in names)

    def is_deployed(self, name: str) -> bool:
        """True if the bundle is made from a step, directly or through others."""
        return any(step.name == name for step in self.steps_of(self.deployed))

    def artifact(self, name: str, place, dataset: Origin) -> Artifact:
        """The artifact of a step, in a run's folder or in a library."""
        step = self.step(name)
        origin = self.origin(name, dataset)
        folder = place.folder(step.folder, origin)
        record, *files = (folder / file for file in step.files)
        return Artifact(name, record, origin, tuple(files))

    def bundle_origin(self, dataset: Origin) -> Origin:
        """The origin of the bundle."""
        reads = [*self.placement, "presentation", "check"]
        return Origin.of(self.settings, reads, [self.origin(self.deployed, dataset)])

    def shapes(self, name: str) -> dict:
        """The shapes of the arrays that a step has, by their names."""
        raise NotImplementedError

    def spec(self, inputs: StepInputs, provenance: dict) -> NetworkSpec:
        """The deployed network.

        Parameters
        ----------
        inputs : StepInputs
            With the settings that the bundle depends on, and the artifacts of the steps.
        provenance : dict
            Stored in the bundle.
        """
        raise NotImplementedError

    def fidelity(self, inputs: StepInputs, bundle: Bundle, advance=None) -> list | None:
        """Compare the firing rates on the chip with those of the trained network.

        Returns
        -------
        list of dict or None
            See :func:`pipeline.kinds.diagnosis.layers_json`; None without a network with rates.
        """
        return None

    def choices(self, recordings: Recordings, train: np.ndarray) -> list[Choice]:
        """Choose settings that the user has not set, for the recordings.

        Parameters
        ----------
        recordings : Recordings
        train : ndarray of int
            Indices of the training samples; none if there can be no split.

        Raises
        ------
        UserError
            The user's other settings do not fit what is chosen.
        """
        return []

    def require_fit(self, recordings: Recordings):
        """Refuse recordings of another sensor or with other classes than the network is for.

        Raises
        ------
        UserError
        """
        sensor = recordings.sensor
        classes = len(sensor.classes)
        if is_for(self.architecture, sensor, self.channels):
            return
        size = f"{sensor.rows}x{sensor.columns}x{self.channels}"
        parsed = parse(self.architecture)
        if self.imported is not None:
            has = "x".join(map(str, parsed.input_shape))
            remedy = suggest_sensor_size(parsed.input_shape[:2], (sensor.rows, sensor.columns))
            raise UserError(
                f"{self.imported.file}: is for an input of {has} and {parsed.outputs} classes; "
                f"recordings give {size} and {classes} classes: {remedy}train one for these "
                "recordings, or give those that it was trained on (--data) or their images "
                "(--set image.slices, image.aggregation)"
            )
        like = architecture_for(sensor, self.settings.on_events, channels=self.channels)
        raise UserError(
            f"{self.settings.data.source}: '{self.section}.architecture' must be for an input of "
            f"{size} and {classes} classes, such as {like}, not {self.architecture}"
        )

    def chip_problems(self) -> tuple:
        """Reasons why the network does not fit the cores of the chip, a line each.

        A user's network is examined when it is read.
        """
        usual = type(self)(Settings())
        if not self.section or (self.architecture, self.settings.deployment) == (
            usual.architecture,
            usual.settings.deployment,
        ):
            return ()
        return chip_problems(self.architecture, self.settings.on_events, self.settings.deployment)

    def require_presentable(self, dataset: Dataset):
        """Refuse samples that cannot be presented to the chip.

        Raises
        ------
        UserError
        """

    def require_usable(self, inputs: StepInputs):
        """Refuse a network of the user that cannot be used, before anything is written.

        Raises
        ------
        UserError
        """

    def notes(self, recordings: Recordings) -> list:
        """Lines for the user about the presentation of the recordings."""
        return []


def responses_of(logits: np.ndarray, presentation) -> Responses:
    """Compute scores and decisions from logits.

    Parameters
    ----------
    logits : ndarray, shape (n_samples, steps, classes)
        Logits at each step; one step for a network without time.
    presentation : pipeline.run.settings.schema.PresentationSettings
        In networks with time, the score at a step is the mean from ``readout_start`` to it.
    """
    start = presentation.readout_start if logits.shape[1] > 1 else 0
    window = logits[:, start:]
    scores = np.cumsum(window, axis=1) / np.arange(1, window.shape[1] + 1)[:, None]
    decisions = np.full(logits.shape[:2], -1)
    decisions[:, start:] = np.argmax(scores, axis=2)
    return Responses(scores[:, -1], decisions, {}, {})


def time_training(name: str, epochs: int, function, *arguments, **more) -> tuple:
    """Run a training with a progress bar; return the network and the seconds that it took."""
    with progress(f"train {name}", epochs) as advance:
        begun = time.perf_counter()
        trained = function(*arguments, advance=advance, **more)
        return trained, time.perf_counter() - begun


def select_curve_samples(dataset: Dataset):
    """Samples for the learning curve: validation samples or, without these, some test samples.

    No result depends on them.
    """
    if (validation := dataset.subset("validation")) is not None:
        return validation
    index = dataset.split.test
    index = index[:: max(1, -(-len(index) // MAX_CURVE_SAMPLES))]
    return (dataset.inputs[index], dataset.labels[index]) if len(index) else None


def write_network(folder: Path, trained, on_test: bool):
    """Write weights and history; delete the records first, because they mark them as complete.

    Parameters
    ----------
    folder : Path
    trained : pipeline.training.networks.Trained or pipeline.training.events.TrainedOnEvents
    on_test : bool
        True if the learning curve is that of test samples, not of held-out training samples.
    """
    for record in ("metrics.json", "training.json"):
        (folder / record).unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    history = trained.history
    if on_test:
        history = [_name_test_columns(row) for row in history]
    write_history(folder / "history.csv", history)


def _name_test_columns(row):
    """A row of a history whose validation samples are those of the test set."""
    return {name.replace("val_", "test_"): value for name, value in row.items()}


def write_history(path, history: list):
    """Write the history of a training.

    Parameters
    ----------
    path : path-like
    history : list of dict
        One dict per epoch, all with the same keys.  If it is empty, as for a network that was not
        trained here, an existing file is deleted.
    """
    if not history:
        Path(path).unlink(missing_ok=True)
        return
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, fieldnames=list(history[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(history)


def read_history(path) -> list:
    """Read the file of :func:`write_history`; all values are floats.

    Raises
    ------
    UserError
        The file cannot be read, or is not a table of numbers with an accuracy and at least one row.
    """
    try:
        with (
            reporting_os_errors(path, "cannot read", DELETE_ITS_FOLDER),
            open_regular(path, "r", newline="", encoding="utf-8") as file,
        ):
            text = file.read(limits.SETTINGS_BYTES * 16)
        table = csv.DictReader(io.StringIO(text, newline=""), strict=True)
        rows = [dict(zip(row, map(float, row.values()), strict=True)) for row in table]
    except (ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path}: not a learning curve ({error}); {DELETE_ITS_FOLDER}") from error
    finite = all(math.isfinite(value) for row in rows for value in row.values())
    if not (rows and finite and {"epoch", "accuracy"} <= set(rows[0])):
        raise UserError(f"{path}: not a learning curve, or one with gaps; {DELETE_ITS_FOLDER}")
    return rows


def read_weights(folder: Path, shapes: dict) -> dict:
    """The trained arrays in a network's folder.

    Parameters
    ----------
    folder : Path
    shapes : dict of str to tuple of int
        The shape of each array.

    Raises
    ------
    UserError
        The arrays are missing, damaged, or of other shapes.
    """
    path = folder / "weights.npz"
    weights = read_arrays(path, DELETE_ITS_FOLDER)
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(
            f"{path}: not the weights of the architecture in the settings; {DELETE_ITS_FOLDER}"
        )
    return weights


def training_versions() -> dict:
    """Versions of the packages that trained networks need."""
    names = ("tensorflow", "nengo-dl")
    return {name.replace("-", "_"): importlib.metadata.version(name) for name in names}


# Samples whose outputs are in memory at a time.
SAMPLES_AT_ONCE = 2000


def metrics_of(trained, dataset: Dataset, seconds: float, versions: dict) -> dict:
    """The record of a network: its accuracy on each set of the split.

    Parameters
    ----------
    trained
        With ``logits`` and ``history``.
    dataset : Dataset
    seconds : float
        Time of the training.
    versions : dict
    """
    inputs = dataset.inputs
    predicted = []
    for start in range(0, len(inputs), SAMPLES_AT_ONCE):
        logits = trained.logits(inputs[start : start + SAMPLES_AT_ONCE])
        predicted.append(np.argmax(logits, axis=1))
    right = np.concatenate(predicted) == dataset.labels
    return {
        **accuracies(right, dataset),
        "epochs": len(trained.history),
        "seconds": seconds,
        "versions": versions,
    }


def accuracies(right, dataset: Dataset) -> dict:
    """Accuracy on each set of the split, and the interval of the last one.

    Parameters
    ----------
    right : ndarray of bool, shape (n_samples,)
        Whether the prediction of each sample of the dataset is right.
    dataset : Dataset
    """
    indices = {name: getattr(dataset.split, name) for name in ("train", "validation", "test")}
    accuracy = {name: float(right[index].mean()) for name, index in indices.items() if len(index)}
    subset = list(accuracy)[-1]  # the validation samples if there is no test set, as in a sweep
    n_samples = len(indices[subset])
    n_right = int(right[indices[subset]].sum())
    return {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": accuracy,
        f"{subset}_accuracy_ci95": list(wilson_interval(n_right, n_samples)),
        f"n_{subset}": n_samples,
    }


def accuracy_text(name: str, metrics: dict) -> str:
    """A line about the accuracy of a network."""
    subset = list(metrics["accuracy"])[-1]
    return (
        f"{name}: {subset} accuracy {metrics['accuracy'][subset]:.3f} on {metrics[f'n_{subset}']} "
        f"samples, {metrics['seconds']:.0f} s"
    )


def is_file(path, sha256: str) -> bool:
    """True if a file can be read and has this SHA-256."""
    try:
        return sha256_of(Path(path)) == sha256
    except (OSError, UserError):
        return False


def find_imported_file(file, sha256: str, copy: Path) -> Path:
    """The file of a network that was imported: the user's, or the run's copy if that has changed.

    The user's file is also returned if the copy is damaged or missing; then neither has the hash.
    """
    return next((path for path in (Path(file), copy) if is_file(path, sha256)), Path(file))
