"""Adapt settings with default values to the user's recordings.

The defaults are the paper's: its network, 200 samples, two seconds.  If recordings of another
sensor need other values and the user has not set them, this module chooses them.  A value that the
user has set and that does not fit is an error; all errors are reported together before anything is
trained.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from deploy.errors import SeveralErrors, UserError
from models.architecture import NotationError, parse
from models.nir_graph import read_nir
from pipeline.data.altering import augmentation_for, is_handwriting
from pipeline.data.dataset import NO_SPLIT, TOO_SMALL
from pipeline.data.events import Recordings, Sensor
from pipeline.data.library import recordings_of
from pipeline.data.splits import PUBLISHED, WRITERS, kind_of, split_of, split_problem
from pipeline.data.statistics import reading_text, size_text
from pipeline.data.steps import EventTable
from pipeline.paper import CNN_MACS
from pipeline.roads.chip_fit import chip_problems
from pipeline.roads.given_networks import is_file
from pipeline.roads.nir_import import require_fit
from pipeline.settings import SIMULATED, Settings, check_fits
from pipeline.training.recipe import WIDE, dropout_for, hidden_for, reading_for

LARGEST_MAP = 14
"""Rows and columns of the first convolution's output on images, at most, on average."""

EVENT_MAP = 5
"""The same for a network on events, as in the first layer of the default network."""

FEWEST_STEPS, MOST_STEPS = 50, 400
"""Minimum and maximum number of steps of a presentation of events; longer recordings get longer
steps."""

OPERATIONS_AN_EVENT = 4
"""Synaptic operations that a network on events may take, in multiples of what its first layer takes
to receive the events: with many classes, the readout takes as many as the first layer."""


def fitted(
    settings: Settings,
    jobs: int = 1,
    say=None,
    recordings: Recordings | None = None,
    check: bool = True,
    rechoose: bool = True,
) -> Settings:
    """Adapt settings to the recordings that they name.

    These settings are chosen if they have their defaults: an architecture for the sensor and the
    classes, and for events the number and length of the steps and the budget of operations.

    Parameters
    ----------
    settings : Settings
    jobs : int
        Number of processes for recordings that are not in the cache.
    say : callable, optional
        Called with a message about each chosen setting.
    recordings : Recordings, optional
        The recordings that the settings name, if they were read already.
    check : bool
        True if samples of a check will be drawn.
    rechoose : bool
        False to keep an architecture that was chosen earlier, for other recordings.

    Returns
    -------
    Settings
        The same object if nothing was chosen, as for simulated recordings.

    Raises
    ------
    SeveralErrors
        With a line for each problem.
    """
    if settings.data.source == SIMULATED and recordings is None:
        if problems := chip_problems(settings):
            raise SeveralErrors(problems)
        return settings
    if recordings is None:
        recordings = recordings_of(settings, jobs, say)
    problems, changes, reading = [], {}, None
    if len(recordings.sensor.classes) < 2:  # there is no network to choose
        raise SeveralErrors([f"{settings.data.source}: {split_problem(recordings)}"])
    _architecture(settings, recordings, rechoose, changes, problems)
    if settings.on_events:
        _presentation(settings, recordings, changes)
        if settings.events.augment == "auto":
            changes.setdefault("events", {})["augment"] = augmentation_for(recordings)
        if not settings.nir.file and not is_handwriting(recordings):
            reading = _recipe(settings, recordings, changes)
    n_test = _test_samples(settings, recordings, problems)
    if check and 0 < n_test < settings.check.drawn(n_test):
        problems.append(
            f"{settings.check.samples} samples requested, the test split has {n_test}; {TOO_SMALL}"
        )
    if problem := split_problem(recordings, settings.split.kind):
        problems.append(problem)
    result = settings.with_values(changes, settings.data.source) if changes else settings
    problems += _unfit(result, recordings)
    if problems:
        source = settings.data.source
        named = tuple(filter(None, (source, settings.cnn.model, settings.nir.file)))
        raise SeveralErrors(
            line if line.startswith(named) else f"{source}: {line}" for line in problems
        )
    if say is not None:
        for line in chosen_text(settings, result, recordings):
            say(line)
        if reading is not None:
            say(reading.text(result.input.step))
    return result


def chosen_text(before: Settings, after: Settings, recordings: Recordings) -> list:
    """The choices of :func:`fitted`, one line for each that changes the training."""
    lines, name = [], "events.architecture" if after.on_events else "cnn.architecture"
    architecture, sensor = after.flat()[name], recordings.sensor
    if architecture != before.flat()[name] and not after.nir.file:
        lines.append(
            f"{architecture}: chosen for {size_text(sensor)} and "
            f"{len(sensor.classes)} classes (another: --set {name}=...)"
        )
    if after.on_events and before.events.augment == "auto":
        lines.append(
            f"augmentation in {after.events.augment} "
            "(another: --set events.augment=time, space or none)"
        )
    if after.on_events and after.events.dropout != before.events.dropout:
        lines.append(
            f"dropout of {after.events.dropout:g}, for few recordings "
            "(another: --set events.dropout=...)"
        )
    if after.presentation != before.presentation:
        shown, longest = after.steps * after.input.step, _longest_ms(recordings)
        part = "as long as the recordings last"
        if longest >= shown:
            part = (
                f"the first {shown / 1000:g} s of recordings of up to {longest / 1000:.4g} s "
                "(more: a longer --set input.step=..., or --steps)"
            )
        lines.append(f"{after.steps} steps of {after.input.step:g} ms: {part}")
    return lines


def new_run_text(path, recordings: Recordings, settings: Settings) -> str:
    """The first message of a new run: source and properties of its recordings, and their split."""
    parts = [reading_text(recordings), split_text(recordings, settings)]
    text = ", ".join(filter(None, parts))
    return f"{path}: a new run, on {recordings.source.name}: {text}"


def split_text(recordings: Recordings, settings: Settings) -> str:
    """The kind of the split in a few words, unless it is the usual one."""
    kind, parts = kind_of(settings.split.kind, recordings), recordings.parts
    if kind == PUBLISHED:
        return f"published split: {parts.count('train')} train, {parts.count('test')} test"
    if kind == WRITERS:
        return "split by writers"
    return "random split instead of the published one" if recordings.is_split else ""


def architecture_for(sensor: Sensor, on_events: bool, hidden: int = 64) -> str:
    """An architecture for a sensor and its classes, in the paper's notation.

    These are the paper's layers if they fit.  For larger sensors the first convolution has a
    stride, and for sensors with too few rows or columns for a convolution there is a hidden dense
    layer.

    Parameters
    ----------
    sensor : Sensor
    on_events : bool
        For events, with a channel for each polarity.
    hidden : int
        Neurons of the hidden layer of a network on events.
    """
    rows, columns, classes = sensor.rows, sensor.columns, len(sensor.classes)
    side, smallest = math.sqrt(rows * columns), min(rows, columns)
    size, end = f"{rows}x{columns}{'x2' if on_events else ''}", f"{classes}o"
    if on_events:
        stride = max(3, math.floor(side / EVENT_MAP))
        first = f"24c{stride + 1}s{stride}"
        middle = [first, f"{hidden}"] if smallest > stride else [f"{hidden}"]
    elif side <= LARGEST_MAP + 3:
        middle = ["6c4", "24c3"] if smallest >= 6 else ["64"]
    else:
        stride = math.ceil((side - 4) / (LARGEST_MAP - 2))
        first = f"6c{stride + 2}s{stride}"
        middle = [first, "24c3"] if smallest >= stride + 2 + 2 * stride else ["64"]
    return "-".join([size, *middle, end])


def _architecture(settings, recordings, rechoose, changes, problems):
    """Choose an architecture if the user has not chosen one and the present one does not fit."""
    section = "events" if settings.on_events else "cnn"
    before = getattr(settings, section)
    is_default = before.architecture == getattr(Settings(), section).architecture
    is_given = settings.nir.file or (section == "cnn" and before.model)
    if is_given or not (is_default or (rechoose and _was_chosen(before, settings))):
        return
    sensor = recordings.sensor
    if _is_for(before.architecture, sensor, 2 if settings.on_events else 1):
        return
    hidden = 64
    if section == "events" and not is_handwriting(recordings):
        hidden = hidden_for(len(_training(settings, recordings)), len(sensor.classes))
    chosen = architecture_for(sensor, settings.on_events, hidden)
    changes[section] = {"architecture": chosen}
    if section == "events" and before.budget == Settings().events.budget:
        budget = OPERATIONS_AN_EVENT * _operations_of_input(chosen, recordings) / CNN_MACS
        if budget > before.budget:
            changes[section]["budget"] = float(min(round(budget, 1), 1000.0))
    rates, layers = settings.snn.max_rates, len(parse(chosen).spiking)
    if section == "cnn" and len(rates) > layers:  # the user's, since the default is one rate
        problems.append(
            f"'snn.max_rates' has {len(rates)} rates, and {chosen}, chosen for the recordings, has "
            f"{layers} layer{'' if layers == 1 else 's'} of neurons; give as many rates or one, or "
            "choose cnn.architecture"
        )
        changes["snn"] = {"max_rates": rates[:layers]}  # other problems can still be found


def _was_chosen(section, settings):
    """True if an architecture is what is chosen for its own size and number of classes."""
    parsed = parse(section.architecture)
    rows, columns, _ = parsed.input_shape
    classes = tuple(map(str, range(parsed.outputs)))
    sensor = Sensor(rows=rows, columns=columns, classes=classes)
    return section.architecture in [
        architecture_for(sensor, settings.on_events, hidden) for hidden in (64, WIDE)
    ]


def _is_for(architecture, sensor, channels) -> bool:
    """True if an architecture has the sensor's input size and as many outputs as classes."""
    parsed, shape = parse(architecture), (sensor.rows, sensor.columns, channels)
    return parsed.input_shape == shape and parsed.outputs == len(sensor.classes)


def _operations_of_input(architecture, recordings):
    """Synaptic operations of the first layer that a recording's events cause, on average."""
    parsed = parse(architecture)
    fan_out = np.mean(parsed.layers[0].fan_out(parsed.input_shape))
    return len(recordings.events) / max(len(recordings), 1) * float(fan_out)


def _presentation(settings, recordings, changes):
    """Present events for as long as the recordings last, with a suitable length of steps."""
    default = Settings()
    if settings.presentation.steps or recordings.sensor.duration_s == Sensor().duration_s:
        return  # as long as the published recordings: the default fits
    longest, step = _longest_ms(recordings), settings.input.step
    if replace(settings.input, kind=default.input.kind) == default.input:
        # The user has not chosen the length of a step.
        while longest >= step * MOST_STEPS:
            step *= 2
    steps = min(max(math.floor(longest / step) + 1, FEWEST_STEPS), MOST_STEPS)
    changes["presentation"] = {"steps": steps}
    if step != settings.input.step:
        changes["input"] = {"step": step, "refractory": step}


def _recipe(settings, recordings, changes):
    """Choose how a network for other recordings than handwriting reads and learns them."""
    default, train = Settings(), _training(settings, recordings)
    events = changes.setdefault("events", {})
    if settings.events.dropout == default.events.dropout:
        events["dropout"] = dropout_for(len(train), default.events.dropout)
    shown = settings.with_values(changes, settings.data.source)
    if settings.events.parts:
        return None
    table, step = EventTable.of(recordings), shown.input.step
    reading = reading_for(table, recordings.labels, train, step, shown.steps)
    if settings.input.refractory == default.input.refractory:
        changes["input"] = {"step": step, "refractory": reading.rest * step}
    else:
        reading = reading._replace(rest=shown.input.rest, lost=table.lost(step, shown.input.rest))
    events |= {"parts": reading.parts, "part": shown.steps * step / reading.parts}
    return reading


def _training(settings, recordings):
    """Indices of the training samples; none if there can be no split."""
    shares = settings.split
    fractions = shares.test_fraction, shares.validation_fraction
    try:
        return split_of(recordings, settings.seed, *fractions, shares.kind).train
    except ValueError:
        return np.empty(0, int)


def _longest_ms(recordings):
    """Time of the last event of all recordings in milliseconds."""
    return float(EventTable.of(recordings).duration_ms.max(initial=0))


def _test_samples(settings, recordings, problems):
    """Number of samples in the test split; 0, with a problem, if there can be no split."""
    shares = settings.split
    try:
        fractions = shares.test_fraction, shares.validation_fraction
        split = split_of(recordings, settings.seed, *fractions, shares.kind)
    except ValueError as error:
        problems.append(f"{error}; {NO_SPLIT}")
        return 0
    return len(split.test)


def _unfit(settings, recordings):
    """Reasons why the network does not fit the recordings or the chip."""
    sensor, source = recordings.sensor, settings.data.source
    try:
        check_fits(settings, sensor.rows, sensor.columns, len(sensor.classes), source)
        # A file that has changed is not the run's network; the run's copy is compared when it is
        # read again.
        if settings.nir.file and is_file(settings.nir.file, settings.nir.sha256):
            shape = sensor.rows, sensor.columns, 2 if settings.on_events else 1
            require_fit(read_nir(settings.nir.file), shape, len(sensor.classes), settings.nir.file)
    except (UserError, NotationError) as error:
        return [str(error)]
    return chip_problems(settings)
