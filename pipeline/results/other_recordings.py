"""A network's results on recordings that were not used in its training, such as other people's."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle, CheckSet
from deploy.check.intervals import compute_wilson_interval
from deploy.check.results import CheckResult, PresentedRecordings, SubsetAccuracy
from deploy.errors import UserError
from deploy.network.decision import compute_probabilities
from deploy.network.provenance import read_classes, read_training_hashes
from deploy.tables import list_names
from deploy.targets.registry import run_target
from deploy.terminal import WARNING, remark
from pipeline.paper import CHECK_SAMPLES
from pipeline.progress import progress
from pipeline.recordings.arrays import UNLABELLED
from pipeline.recordings.dataset import (
    describe_cut_recordings,
    make_inputs_for,
    require_sensor_fits,
)
from pipeline.recordings.formats.recording import UNIT_NAMES, UNITS
from pipeline.recordings.interpretation.options import ReadingOptions
from pipeline.recordings.interpretation.times import MIN_DURATION_S
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.splits import draw_check_samples
from pipeline.results.check_on_others import OtherRecordings
from pipeline.results.ladder import count_confusions
from pipeline.settings import Image, Settings, read_settings
from pipeline.sources import load_recordings
from pipeline.storage.run_folder import find_checks_folder, run_around

# Name of the folder in a run's results.
FOLDER = "other"

# A line on the probabilities of a network without a confidence estimator.
SOFTMAX_NOTE = (
    "the probabilities are the softmax of the outputs, which is usually too high: this network has "
    "no confidence estimator (networks on events have one, from about 1,250 recordings on)"
)

# Share of a sensor's rows and columns that its recordings have events in, at least.
MIN_REACHED_SHARE = 0.8

# From this number on, the recordings of a sensor reach most of its rows and columns.  Of fewer,
# the rectangle with all events is at least this share of the sensor.
MANY_RECORDINGS = 10
MIN_REACHED_AREA = 0.25


def find_settings_around(bundle: Bundle, skip_bad: bool = False, time_unit: str = "") -> Settings:
    """The settings of the run that a bundle is in, or the defaults if it is in none.

    Parameters
    ----------
    bundle : Bundle
    skip_bad : bool
        True to leave out files that cannot be read, whatever the run's setting is.
    time_unit : str
        Unit of the times in files of events; empty: the files' own, or that of the training.  The
        run's setting is about the recordings of the training, and no other files have it.

    Raises
    ------
    UserError
        The run's settings cannot be read, or the unit is not one.
    """
    if time_unit and time_unit not in UNITS:
        raise UserError(f"time unit {time_unit!r}: choose one of {', '.join(UNITS)}")
    run = run_around(bundle.path)
    settings = Settings() if run is None else read_settings(run / "experiment.toml")
    data = replace(
        settings.data,
        skip_bad=skip_bad or settings.data.skip_bad,
        time_unit=time_unit,
    )
    return replace(settings, data=data)


def read_recordings_for(
    bundle: Bundle, source: str, settings: Settings, jobs: int = 1, warn=None, labelled: bool = True
) -> Recordings:
    """Recordings for a bundle's network, with labels in the order of its outputs.

    Parameters
    ----------
    bundle : Bundle
    source : str
        Path of a zip or folder.
    settings : Settings
        From :func:`find_settings_around`, for reading files.
    jobs : int
        Number of processes.
    warn : callable, optional
        Called with a line for each file that was left out.
    labelled : bool
        False if the names of the folders need not be classes of the network, or if there are none;
        the label is -1 then.

    Raises
    ------
    UserError
        The recordings cannot be read, or are from another sensor or of other classes.
    """
    rows, columns = bundle.spec.input_shape[:2]
    data = settings.data
    recorded = bundle.spec.provenance.entries
    # Files without a unit have that of the training, also if a person writes much faster.
    usual_unit = bundle.spec.provenance.time_unit
    downsample = recorded.get("downsample", data.downsample)  # of a bundle without its run too
    reading = ReadingOptions(
        rows,
        columns,
        time_unit=data.time_unit,
        downsample=downsample,
        usual_unit=usual_unit if usual_unit in UNITS else "",
        bin_ms=recorded.get("bin_ms", data.bin_ms),
        rise=recorded.get("rise", data.rise),
        labelled=labelled,
    )
    recordings = load_recordings(
        source, skip_bad=data.skip_bad, jobs=jobs, warn=warn, reading=reading
    )
    sensor = recordings.sensor
    classes = read_classes(bundle.spec)
    taxels = recordings.taxels
    # The size that was requested may be larger than a look-up table's, of a smaller sensor.
    actual = replace(
        sensor,
        rows=settings.skin.rows or int(taxels.row.max()) + 1,
        columns=settings.skin.columns or int(taxels.column.max()) + 1,
    )
    require_sensor_fits(bundle.spec, replace(recordings, sensor=actual))
    present = [sensor.classes[label] for label in np.unique(recordings.labels)]
    unknown = [name for name in present if name not in classes]
    if labelled and sensor.classes == (UNLABELLED,):
        raise UserError(f"{source}: the recordings have no labels; classify them with predict")
    if unknown and labelled:
        raise UserError(
            f"{source}: has classes that the network of {bundle.path} does not have: "
            f"{list_names(unknown)}; its classes are {list_names(classes)}"
        )
    number = {name: index for index, name in enumerate(classes)}
    labels = np.array([number.get(name, -1) for name in sensor.classes])[recordings.labels]
    return replace(recordings, labels=labels, sensor=replace(sensor, classes=classes))


def read_others(
    bundle: Bundle, others: OtherRecordings, settings: Settings, warn, labelled: bool = True
) -> Recordings:
    """As :func:`read_recordings_for`, under the name that the user gave the recordings."""
    recordings = read_recordings_for(
        bundle, str(others.data), settings, others.jobs, warn, labelled
    )
    if not others.name:
        return recordings
    # The unit of recordings in memory is known, also if it is not that of the training's files.
    return replace(recordings, source=replace(recordings.source, name=others.name, time_unit=""))


@dataclass(frozen=True)
class Prediction:
    """The prediction for a recording.

    Attributes
    ----------
    recording : str
        Its id: its folder, if there is one, and its name.
    label : str
        Name of the predicted class.
    probability : float or None
        Estimated probability that the class is right, or the softmax of the outputs if the network
        has no confidence estimator; None where no spike has reached the readout.
    class_probabilities : dict of str to float, or None
        Probability of each class by its name, with the sum 1; that of ``label`` is
        ``probability``, unless this is below 1 / n_classes.  None where it is None.
    """

    recording: str
    label: str
    probability: float | None
    class_probabilities: dict[str, float] | None = None


def predict_recordings(
    bundle: Bundle, others: OtherRecordings, target: str = "fast", warn=remark
) -> list:
    """Classify recordings, with or without labels, each with the network at rest before it.

    Parameters
    ----------
    bundle : Bundle
    others : OtherRecordings
        A zip or folder with recordings of the network's sensor, also without folders or in folders
        of any names; or one recording.
    target : str
        See :data:`deploy.targets.registry.TARGETS`.
    warn : callable
        Called with each warning; default: printed on standard error.

    Returns
    -------
    list of Prediction

    Raises
    ------
    UserError
        The recordings cannot be read, or are from another sensor.
    """
    settings = find_settings_around(bundle, others.skip_bad, others.time_unit)
    recordings = read_others(bundle, others, settings, warn, labelled=False)
    for line in list_warnings(bundle, recordings):
        warn(line)
    if bundle.spec.estimator is None and bundle.spec.layers[-1].neurons is None:
        warn(SOFTMAX_NOTE)
    spec = bundle.spec.with_presentation(stream_length=1)
    names = recordings.sensor.classes
    inputs = make_inputs_for(spec, recordings, settings.image)
    with progress("classify", len(recordings), "recordings") as advance:
        responses = run_target(spec, inputs, target, bundle.seed, advance)
    probabilities = responses.probabilities
    if probabilities is None:
        probabilities = np.full(len(recordings), np.nan)
    by_class = compute_probabilities(responses.scores, np.nan_to_num(probabilities))
    rows = zip(recordings.ids, responses.predictions, probabilities, by_class, strict=True)
    return [
        Prediction(recording, names[number], None)
        if np.isnan(probability)
        else Prediction(
            recording,
            names[number],
            float(probability),
            dict(zip(names, shares.tolist(), strict=True)),
        )
        for recording, number, probability, shares in rows
    ]


def find_trained_on(bundle: Bundle, recordings: Recordings) -> np.ndarray:
    """The recordings that were used to make a network, which are recognised by their content.

    A bundle has hashes of the recordings that it was trained on or fitted to.

    Returns
    -------
    ndarray of bool, shape (n_samples,)
    """
    return np.isin(recordings.hashes, list(read_training_hashes(bundle.spec)))


def list_warnings(bundle: Bundle, recordings: Recordings):
    """Yield lines on recordings that the network was made with, or that it does not see whole."""
    start = f"{WARNING}{recordings.source.name}: "
    if number := int(find_trained_on(bundle, recordings).sum()):
        yield (
            f"{start}{number} of {len(recordings)} recordings were used to make the network; its "
            "accuracy on them says little about others"
        )
    yield from (start + line for line in _describe_limits(bundle.spec, recordings))


def _describe_limits(spec, recordings):
    """Lines on what the network does not see, or never saw in its training."""
    events = recordings.events
    taxels = recordings.taxels
    units = [recordings.source.time_unit, spec.provenance.time_unit]
    if all(units) and units[0] != units[1]:
        read_unit, usual_unit = (UNIT_NAMES[unit] for unit in units)
        yield (
            f"times are read as {read_unit}, those of the training as {usual_unit}; if that is "
            "wrong, give the unit with --time-unit"
        )
    elif units[0] and (typical_s := _measure_typical_duration_s(recordings)) < MIN_DURATION_S:
        yield (
            f"recordings last typically {1000 * typical_s:.2g} ms with times as "
            f"{UNIT_NAMES[units[0]]}; if that is another unit, give it with --time-unit"
        )
    rows, columns = spec.input_shape[:2]
    reached = [int(axis[events.taxel].max(initial=0)) + 1 for axis in (taxels.row, taxels.column)]
    if _is_of_smaller_sensor(reached, (rows, columns), len(recordings)):
        yield (
            f"the events are in {reached[0]} of {rows} rows and {reached[1]} of {columns} columns; "
            "if these are recordings of a smaller sensor, the network is not for them"
        )
    has_off = bool((events.polarity < 0).any())
    if has_off != (spec.provenance.polarities == 2):
        yield f"there are {'' if has_off else 'no '}OFF events, unlike in those of the training"
    if not spec.stimulus.is_static:
        step_ms = 1000 * spec.stimulus.step_seconds
        steps = spec.presentation.steps
        if line := describe_cut_recordings(recordings.table, step_ms, steps):
            yield line


def _is_of_smaller_sensor(reached, size, n_recordings):
    """True if the rows and columns with events are so few that the sensor may be smaller.

    A few recordings, such as of a short touch, do not reach all taxels of their own sensor.
    """
    shares = [part / whole for part, whole in zip(reached, size, strict=True)]
    if n_recordings < MANY_RECORDINGS:
        return shares[0] * shares[1] < MIN_REACHED_AREA
    return min(shares) < MIN_REACHED_SHARE


def _measure_typical_duration_s(recordings):
    """Median duration of the recordings with events, in seconds."""
    time_ns = recordings.events.time_ns
    offsets = recordings.offsets
    has_events = np.diff(offsets) > 0
    if not has_events.any():
        return math.inf
    return (
        float(np.median(time_ns[offsets[1:][has_events] - 1] - time_ns[offsets[:-1][has_events]]))
        * 1e-9
    )


def replace_check_samples(
    bundle: Bundle, recordings: Recordings, n_samples: int | None, seed: int, image: Image
) -> tuple:
    """A bundle with other recordings as the samples of its check, and the indices of these.

    Parameters
    ----------
    bundle : Bundle
    recordings : Recordings
        From :func:`read_recordings_for`.
    n_samples : int or None
        Number of samples drawn at random; 0 for all, None for 200 at most.
    seed : int
        Seed of the draw.
    image : Image
        Conversion of events to images, if the bundle does not have it.

    Raises
    ------
    UserError
        There are fewer recordings, or they cannot be presented to the network.
    """
    n = len(recordings)
    count = min(CHECK_SAMPLES, n) if n_samples is None else n_samples or n
    try:
        chosen = draw_check_samples(np.arange(n), count, seed)
    except ValueError as error:
        raise UserError(
            f"{recordings.source.name}: {count} samples requested, only {n} exist; "
            "ask for fewer (--samples)"
        ) from error
    spec = bundle.spec
    drawn = recordings.subset(chosen)
    inputs = make_inputs_for(spec, drawn, image)
    if problem := spec.stimulus.find_problem(inputs, spec.input_shape, spec.presentation.steps):
        raise UserError(f"{recordings.source.name}: {problem}")
    return replace(bundle, checks=CheckSet(inputs, drawn.labels, drawn.ids, seed)), chosen


def add_accuracies(
    result: CheckResult, bundle: Bundle, recordings: Recordings, chosen: np.ndarray
) -> CheckResult:
    """A check result with the accuracies of the classes and writers of other recordings.

    Parameters
    ----------
    result : CheckResult
    bundle : Bundle
    recordings : Recordings
    chosen : ndarray of int
        Indices of the presented samples, in the order of the result's samples.
    """
    classes = recordings.sensor.classes
    source = recordings.source
    labels = np.array([sample.label for sample in result.samples])
    predictions = np.array([sample.prediction for sample in result.samples])
    right = labels == predictions
    return replace(
        result,
        simulated=source.simulated,
        data=PresentedRecordings(
            source=source.name,
            sha256=source.sha256,
            recordings=len(recordings),
            trained_on=int(find_trained_on(bundle, recordings)[chosen].sum()),
            warnings=list(_describe_limits(bundle.spec, recordings)),
        ),
        classes=list(classes),
        confusion=count_confusions(labels, predictions, len(classes)).tolist(),
        per_class=[
            _measure_accuracy(right[labels == index], class_name=name)
            for index, name in enumerate(classes)
            if (labels == index).any()
        ],
        per_writer=_measure_accuracy_of_writers(right, recordings.writers[chosen]),
    )


def _measure_accuracy_of_writers(right, writers):
    """The accuracy of each writer; None if a writer is unknown."""
    if not (writers >= 0).all():
        return None
    return [
        _measure_accuracy(right[writers == writer], writer=int(writer))
        for writer in np.unique(writers)
    ]


def _measure_accuracy(right, class_name=None, writer=None) -> SubsetAccuracy:
    """The accuracy of some samples, given which predictions are right."""
    n = len(right)
    n_right = int(right.sum())
    interval = list(compute_wilson_interval(n_right, n))
    return SubsetAccuracy(n, n_right / n, interval, class_name, writer)


def find_result_path(bundle: Bundle, recordings: Recordings, n_samples: int, target: str) -> Path:
    """The file of such a result: next to the bundle, one for each set of recordings."""
    name = "".join(c if c.isalnum() or c in "-_." else "-" for c in recordings.source.name)[:60]
    file = f"{name}-{recordings.source.sha256[:8]}-{n_samples}-{target}.json"
    return find_checks_folder(bundle.path) / FOLDER / file
