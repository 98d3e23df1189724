"""Determine the sensor of a set of recordings: rows, columns, positions, duration and classes.

Recordings in the published layout with a hundred taxels and digits as classes are treated as
ST-MNIST's: they have its ten classes and its two seconds, independently of their content.  For all
others the values are those found, unless the settings specify rows and columns.
"""

import math
import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from deploy.arithmetic import divide_up
from deploy.errors import UserError
from deploy.tables import format_count
from pipeline.recordings import times
from pipeline.recordings.events import DIGITS, GRID, N_TAXELS, UNIT_NAMES, Sensor, TaxelMap
from pipeline.recordings.formats.recording import MAX_DURATION_S, MAX_SIDE, UNITS
from pipeline.recordings.strays import find_strays
from pipeline.recordings.taxels import add_positions, find_size
from pipeline.recordings.times import GIVE_UNIT

# Number of rows and columns from which the extents of the events of train and test identify a
# sensor, and the factor between both extents above which the sensors differ.
MIN_SENSOR_SIDE = 6
MAX_SIZE_FACTOR = 2

GIVE_SIZE = "--set skin.rows=... --set skin.columns=..."

# What each layout of a file is called; see EventRecording.layout.
LAYOUT_NAMES = {
    "events": "a list of events",
    "numbered": "a spiketrain",
    "bins": "an array of counts",
}

# Value of ReadingOptions.rise that leaves the choice of the channel to the reader.
AUTOMATIC_RISE = -1


@dataclass(frozen=True)
class ReadingOptions:
    """Properties of files that the user specifies instead of having them detected.

    Attributes
    ----------
    rows, columns : int
        Size of the sensor, after :attr:`downsample`; 0 for as found.
    time_unit : str
        Unit in files of events, one of :data:`pipeline.recordings.formats.recording.UNITS`;
        empty: inferred.
    downsample : int
        Side of the square of pixels of a file of events that becomes one taxel.
    usual_unit : str
        Unit of similar recordings, such as those that a network was trained on, for files of
        events that do not have theirs, if :attr:`time_unit` is empty.
    bin_ms : float
        Width of a bin in arrays of counts, in milliseconds.
    rise : int
        Channel of rising pressure in arrays of counts; -1: 1 on ST-MNIST's grid, else 0.
    labelled : bool
        False if recordings need not be in folders of classes; the source may be one file then.
    """

    rows: int = 0
    columns: int = 0
    time_unit: str = ""
    downsample: int = 1
    usual_unit: str = ""
    bin_ms: float = 20.0
    rise: int = AUTOMATIC_RISE
    labelled: bool = True


AS_FOUND = ReadingOptions()


@dataclass(frozen=True)
class Interpretation:
    """Recordings of one sensor.

    Attributes
    ----------
    kept : list of int
        Indices of the recordings that fit.
    events : list of Events
        Their events.
    refused : dict of int to str
        Index of each recording that does not fit, and the reason.
    taxels : TaxelMap
    rows, columns : int
    time_unit : str
        Unit in which the times of files of events were read.
    duration_s : float
        Duration that the files state; 0 if they do not.
    bin_ms : float
        Width of a bin of arrays of counts; 0 for other files.
    rise : int
        Channel of rising pressure of arrays of counts.
    remarks : tuple of str
        What the user should know about how the files were read.
    doubts : tuple of (tuple of int, str)
        Indices of recordings that may be damaged, and what follows from them.
    """

    kept: list
    events: list
    refused: dict
    taxels: TaxelMap
    rows: int
    columns: int
    time_unit: str = ""
    duration_s: float = 0.0
    bin_ms: float = 0.0
    rise: int = 0
    remarks: tuple = ()
    doubts: tuple = ()

    def make_sensor(self, classes) -> Sensor:
        """The sensor, with ST-MNIST's classes and duration if the recordings are of its format."""
        is_full = len(self.taxels) == N_TAXELS and self.rows == self.columns == GRID
        is_numbered = not self.time_unit and not self.bin_ms
        if is_full and set(classes) <= set(DIGITS) and is_numbered:
            return Sensor(self.rows, self.columns)
        latest_ns = max((int(events.time_ns[-1]) for events in self.events), default=0)
        latest_ns = max(latest_ns, round(self.duration_s * 1e9))
        return Sensor(
            self.rows,
            self.columns,
            polarities=1 if all((events.polarity > 0).all() for events in self.events) else 2,
            duration_s=max(divide_up(latest_ns, 100_000_000), 1) / 10,  # up to the next tenth
            classes=tuple(sorted(classes, key=make_sort_key)),
        )


def make_sort_key(name: str):
    """Key that sorts names as people do: 2 before 10."""
    pieces = re.split(r"([0-9]+)", name)
    # The longer of two numbers is the larger one; int() refuses those of thousands of digits.
    numbers = [piece.lstrip("0") if piece[:1] in DIGITS else "" for piece in pieces]
    return [
        (piece[:1] in DIGITS, len(number), number, piece)
        for piece, number in zip(pieces, numbers, strict=True)
    ], name


def interpret(
    path, recordings, parts, lookup=None, positions=None, options=AS_FOUND
) -> Interpretation:
    """Determine the sensor of recordings that were read one by one.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
    parts : list of str
        ``"train"`` or ``"test"`` in a published split, or empty.
    lookup : TaxelMap, optional
        Places of the taxels in the image, from ``LUT.mat``.
    positions : dict of int to (float, float), optional
        Positions of the taxels on the sensor, from ``taxels.csv``.
    options : ReadingOptions

    Raises
    ------
    UserError
        Rows, columns or the unit of time cannot be determined, or differ between train and test.
    """
    layouts = [recording.layout for recording in recordings]
    usual = Counter(layouts).most_common(1)[0][0]
    interpret_layout = _interpret_places if usual == "events" else _interpret_numbers
    same = [index for index, layout in enumerate(layouts) if layout == usual]
    found = interpret_layout(
        path,
        [recordings[index] for index in same],
        [parts[index] for index in same],
        lookup,
        positions is not None,
        options,
    )
    others = {
        index: f"is {LAYOUT_NAMES[layout]}, unlike most others: {LAYOUT_NAMES[usual]}"
        for index, layout in enumerate(layouts)
        if layout != usual
    }
    refused = {same[index]: reason for index, reason in found.refused.items()}
    kept = [same[index] for index in found.kept]
    doubts = _renumber(found.doubts, same)
    found = replace(found, kept=kept, refused=refused | others, doubts=doubts)
    if positions is None:
        return found
    taxels = add_positions(path, found.taxels, found.rows, found.columns, positions)
    return replace(found, taxels=taxels)


def _renumber(doubts, numbers):
    """Doubts about some recordings, by the numbers of these recordings among all."""
    renumbered = []
    for indices, text in doubts:
        renumbered.append((tuple(numbers[index] for index in indices), text))
    return tuple(renumbered)


# Files in which the taxels are numbered: spiketrain matrices and arrays of counts.


def _interpret_numbers(path, recordings, parts, lookup, is_strip, options):
    has_bins = recordings[0].bins is not None
    n, refused = _find_number_of_taxels(path, recordings, parts, lookup)
    if has_bins:
        refused |= _find_other_shapes(recordings)
    kept = [index for index in range(len(recordings)) if index not in refused]
    if lookup is not None:
        rows, columns = find_size(path, lookup, options.rows, options.columns)
        taxels = lookup
    else:
        rows, columns = _arrange(path, n, has_bins, is_strip, options)
        taxels = TaxelMap.grid(rows, columns)
    found = Interpretation(kept, [], refused, taxels, rows, columns)
    fitting = [recordings[index] for index in kept]
    if has_bins:
        return _add_bins(path, found, fitting, options)
    return replace(found, events=[recording.to_numbered_events() for recording in fitting])


def _find_number_of_taxels(path, recordings, parts, lookup):
    """The number of taxels, and the recordings that have another one, each with the reason."""
    counts = {}
    for recording, part in zip(recordings, parts, strict=True):
        counts.setdefault(part, Counter())[recording.n_taxels] += 1
    usual = {part: count.most_common(1)[0][0] for part, count in counts.items()}
    if len(set(usual.values())) > 1:
        _refuse_parts(path, {part: f"{n} taxels" for part, n in usual.items()})
    if lookup is None:
        n = next(iter(usual.values()))
        which = "most have"
    else:
        n = len(lookup)
        which = "LUT.mat says"
    refused = {
        index: f"has {recording.n_taxels} taxels, not {n} as {which}"
        for index, recording in enumerate(recordings)
        if recording.n_taxels != n
    }
    return n, refused


def _find_other_shapes(recordings):
    """Arrays of counts with other numbers of channels or bins than most, with the reason."""
    usual = Counter(recording.bins for recording in recordings).most_common(1)[0][0]
    return {
        index: "has {} channels and {} bins, most others have {} and {}".format(
            *recording.bins, *usual
        )
        for index, recording in enumerate(recordings)
        if recording.bins != usual
    }


def _arrange(path, n, has_bins, is_strip, options):
    """Rows and columns of numbered taxels without a look-up table."""
    rows = options.rows
    columns = options.columns
    if not rows and not columns:
        side = math.isqrt(n)
        is_square = n == N_TAXELS if has_bins else side * side == n
        rows = side if is_square and not is_strip else 1
    rows = rows or max(n // columns, 1)
    columns = columns or max(n // rows, 1)
    if rows * columns != n:
        raise UserError(
            f"{path}: recordings of {n} taxels, not of {rows} rows of {columns}; give recordings "
            f"of that sensor, add LUT.mat, or give the numbers of rows and columns: {GIVE_SIZE}"
        )
    return rows, columns


def _add_bins(path, found, recordings, options):
    """The events of arrays of counts, after choosing the channel of rising pressure."""
    channels, n_bins = recordings[0].bins
    duration_s = n_bins * options.bin_ms / 1000
    if duration_s > MAX_DURATION_S:
        raise UserError(
            f"{path}: {n_bins} bins of {options.bin_ms:g} ms last {duration_s:.4g} s, more than "
            f"{MAX_DURATION_S:g} s; give the width of a bin in milliseconds: --set data.bin=..."
        )
    is_grid = found.rows == found.columns == GRID and len(found.taxels) == N_TAXELS
    rise = choose_rise(path, channels, is_grid, options)
    events = [make_events(recording, rise, options.bin_ms) for recording in recordings]
    remark = f"{n_bins} bins, read as {options.bin_ms:g} ms each (data.bin)"
    if channels == 2:
        remark += f"; channel {rise} is read as the rise of pressure (data.rise)"
    if is_grid:
        remark += (
            "; the bins of ST-MNIST-SPLIT are hundredths of each recording's columns, so they keep "
            "the order of the events and not their time"
        )
    return replace(
        found,
        events=events,
        duration_s=duration_s,
        bin_ms=options.bin_ms,
        rise=rise,
        remarks=(remark,),
    )


def choose_rise(path, channels: int, is_grid: bool, options: ReadingOptions) -> int:
    """The channel of rising pressure in arrays of counts: the user's, or 1 on ST-MNIST's grid.

    Raises
    ------
    UserError
        The user's is not a channel of the arrays.
    """
    if options.rise == AUTOMATIC_RISE:
        return 1 if is_grid and channels == 2 else 0
    if options.rise >= channels:
        raise UserError(
            f"{path}: data.rise is {options.rise}, and the arrays have one channel; use --set "
            "data.rise=0"
        )
    return options.rise


def make_events(recording, rise: int, bin_ms: float):
    """The events of an array of counts.

    Parameters
    ----------
    recording : EventRecording
        From :func:`pipeline.recordings.formats.bins.make_binned_recording`.
    rise : int
        Channel of rising pressure.
    bin_ms : float
        Width of a bin.
    """
    sign = 1 if rise == 0 else -1
    time_ns = np.rint(recording.time * bin_ms * 1e6).astype(np.int64)
    return replace(recording, polarity=sign * recording.polarity).to_events(1, time_ns)


# Files of events, with the column and row of each event.


def _interpret_places(path, recordings, parts, lookup, is_strip, options):
    side = options.downsample
    if side > 1:
        recordings = [replace(r, x=r.x // side, y=r.y // side) for r in recordings]
    unit = times.choose_unit(path, recordings, parts, options)
    refused, remarks = _find_other_sensors(path, recordings, parts, lookup, options)
    _refuse_other_times(recordings, unit, refused)
    kept = [index for index in range(len(recordings)) if index not in refused]
    fitting = [recordings[index] for index in kept]
    doubts = ()
    if lookup is not None:
        rows, columns = find_size(path, lookup, options.rows, options.columns)
        rows_in_files = 1
        taxels = lookup
    else:
        rows, columns = _find_size(fitting, side, options)
        doubts = _doubt_size(fitting, (rows, columns), options)
        if max(rows, columns) > MAX_SIDE and doubts:  # no sensor is as large as they make it
            refused |= {kept[i]: f"has {text}" for indices, text in doubts for i in indices}
            kept = [index for index in kept if index not in refused]
            fitting = [recordings[index] for index in kept]
            rows, columns = _find_size(fitting, side, options)
            doubts = _doubt_size(fitting, (rows, columns), options)
        _require_small(path, rows, columns, side)
        rows_in_files = rows
        taxels = TaxelMap.grid(rows, columns)
    from_first = times.is_clock([recording.time for recording in fitting], unit)
    events = [r.to_events(rows_in_files, times.to_ns(r.time, unit, from_first)) for r in fitting]
    return Interpretation(
        kept,
        events,
        refused,
        taxels,
        rows,
        columns,
        time_unit=unit,
        remarks=remarks,
        doubts=_renumber(doubts, kept),
    )


def _refuse_other_times(recordings, unit, refused):
    """Add recordings whose times are in another unit, or that last too long, to those refused."""
    for index in times.find_other_units([recording.time for recording in recordings]):
        refused.setdefault(
            index,
            f"is more than {times.MIN_UNIT_FACTOR} times longer or shorter than most recordings; "
            "if they are in another unit, convert them to that of the others",
        )
    for index, recording in enumerate(recordings):
        if (seconds := times.find_span(recording.time) * UNITS[unit]) > MAX_DURATION_S:
            refused.setdefault(
                index,
                f"lasts {seconds:.4g} s with its times as {UNIT_NAMES[unit]}, more than "
                f"{MAX_DURATION_S:g} s; if they are in another unit, give it ({GIVE_UNIT})",
            )


def _find_other_sensors(path, recordings, parts, lookup, options):
    """Recordings whose events cannot be from the same sensor as the others, and remarks."""
    extents = np.array([(int(r.y.max()) + 1, int(r.x.max()) + 1) for r in recordings])
    if lookup is not None:
        return _find_other_numbers(path, extents, lookup), ()
    refused = _find_outside(path, recordings, extents, options)
    sizes = Counter(r.size for r in recordings if r.size)
    remarks = _compare_parts(path, recordings, extents, parts, options)
    if len(sizes) > 1:
        usual = sizes.most_common(1)[0][0]
        for index, recording in enumerate(recordings):
            if recording.size and recording.size != usual:
                own, most = ("x".join(map(str, size)) for size in (recording.size, usual))
                refused.setdefault(index, f"is of a sensor of {own}, most others are of {most}")
    return refused, remarks


def _find_other_numbers(path, extents, lookup):
    """Recordings that have taxels that the look-up table does not have."""
    if extents[:, 0].max() > 1:
        raise UserError(
            f"{path}: LUT.mat is for sensors whose taxels are numbered by x, in one row; these "
            f"recordings have {extents[:, 0].max()} rows: remove LUT.mat"
        )
    return {
        int(index): f"has taxel {extents[index, 1] - 1}, LUT.mat has those from 0 to "
        f"{len(lookup) - 1}"
        for index in np.flatnonzero(extents[:, 1] > len(lookup))
    }


def _find_outside(path, recordings, extents, options):
    """Recordings with events outside the rows and columns that the user states."""
    limits = np.array([options.rows or np.inf, options.columns or np.inf])
    outside = (extents > limits).any(axis=1)
    stated = [str(n or "any") for n in (options.rows, options.columns)]
    if 2 * outside.sum() >= len(recordings):
        sizes = Counter(r.size for r in recordings if r.size)
        size = sizes.most_common(1)[0][0] if sizes else extents.max(axis=0)
        raise UserError(
            f"{path}: recordings of a sensor of {size[0]} x {size[1]} taxels, larger than the "
            f"{' x '.join(stated)} of skin.rows and skin.columns; give recordings of a sensor of "
            "that size"
        )
    reasons = {}
    for index in np.flatnonzero(outside).tolist():
        recording = recordings[index]
        first = int(np.argmax((recording.y >= limits[0]) | (recording.x >= limits[1])))
        reasons[index] = (
            f"has an event at x = {recording.x[first]}, y = {recording.y[first]}, outside the "
            f"sensor (skin.rows: {stated[0]}, skin.columns: {stated[1]}; x and y count from 0)"
        )
    return reasons


def _compare_parts(path, recordings, extents, parts, options):
    """Compare the sensors of train and test; remarks if the events of one reach less far.

    The size of the sensor is that of all recordings together, or the one that the user states: a
    small test set may have no events at the edge.  Files that state different sizes, and extents of
    which one is a multiple of the other in both directions, are of different sensors.
    """
    sizes = {}
    reached = {}
    for part in sorted(set(parts)):
        chosen = np.array([each == part for each in parts])
        stated = Counter(r.size for r, is_in in zip(recordings, chosen, strict=True) if is_in)
        stated.pop(None, None)
        reached[part] = extents[chosen].max(axis=0)
        sizes[part] = stated.most_common(1)[0][0] if stated else None
    texts = {part: f"{size[0]} x {size[1]} taxels" for part, size in reached.items()}
    if None not in sizes.values() and len(set(sizes.values())) > 1:
        texts = {part: f"{size[0]} x {size[1]} taxels" for part, size in sizes.items()}
        _refuse_parts(path, texts)
    smallest, largest = (how(list(reached.values()), axis=0) for how in (np.min, np.max))
    counted = largest > 1  # a sensor in one row has one extent
    is_multiple = (largest > MAX_SIZE_FACTOR * smallest)[counted].all() and counted.any()
    is_large = (smallest >= MIN_SENSOR_SIDE)[counted].all()
    if is_multiple and is_large and not (options.rows or options.columns):
        _refuse_parts(path, texts, f", or give the size if it is one sensor: {GIVE_SIZE}")
    if (largest > 1.25 * smallest).any():
        listed = ", ".join(f"those of {part} in {text}" for part, text in texts.items())
        size = f"{options.rows or largest[0]} x {options.columns or largest[1]} taxels"
        return (f"the events lie in different places: {listed}; the sensor is read as {size}",)
    return ()


def _refuse_parts(path, values, remedy=""):
    listed = ", ".join(f"{part} has {value}" for part, value in sorted(values.items())[::-1])
    raise UserError(
        f"{path}: train and test are of different sensors: {listed}; give recordings of one "
        f"sensor{remedy}"
    )


def _find_size(recordings, side, options):
    """Rows and columns of files of events."""
    size = []
    for axis, stated in ((0, options.rows), (1, options.columns)):
        reached = [int(places.max()) + 1 for places in _places_along(recordings, axis)]
        size.append(stated or max([1, *reached, _size_in_files(recordings, axis, side)]))
    return size


def _places_along(recordings, axis):
    """The rows (axis 0) or columns (axis 1) of the events of each recording."""
    return [(recording.y, recording.x)[axis] for recording in recordings]


def _size_in_files(recordings, axis, side):
    """Rows or columns of the sensor that the files state; 0 if they do not."""
    return max((divide_up(r.size[axis], side) for r in recordings if r.size), default=0)


def _doubt_size(recordings, size, options):
    """Recordings that alone make the sensor as large as it is read, and what the user can do.

    Returns
    -------
    tuple of (tuple of int, str)
    """
    doubts = []
    side = options.downsample
    axes = (
        ("y", "rows", "skin.rows", options.rows),
        ("x", "columns", "skin.columns", options.columns),
    )
    for axis, (letter, noun, setting, stated) in enumerate(axes):
        if stated:
            continue
        in_files = _size_in_files(recordings, axis, side)
        strays = find_strays(_places_along(recordings, axis), in_files)
        if strays is None:
            continue
        combined = " after data.downsample" if side > 1 else ""
        up_to = "" if strays.n_events == 1 else "up to "
        text = (
            f"{format_count(strays.n_events, 'event')} at {letter} = {up_to}{strays.highest}"
            f"{combined}, and all others have {letter} from 0 to {strays.size - 1}; the sensor is "
            f"read as {size[0]} rows x {size[1]} columns: correct this, or give the number of "
            f"{noun}, such as --set {setting}={strays.size}"
        )
        doubts.append((strays.recordings, text))
    return tuple(doubts)


def _require_small(path, rows, columns, side):
    """Refuse a sensor with more rows or columns than any has."""
    if max(rows, columns) > MAX_SIDE:
        needed = divide_up(max(rows, columns), MAX_SIDE) * side
        raise UserError(
            f"{path}: the sensor has {rows} rows and {columns} columns, more than {MAX_SIDE}; "
            f"combine squares of pixels: --set data.downsample={needed}"
        )
