"""Determine the sensor of a set of recordings: rows, columns, positions, duration and classes.

Recordings in the published layout with a hundred taxels and digits as classes are treated as
ST-MNIST's: they have its ten classes and its two seconds, independently of their content.  For all
others the values are those found, unless the settings specify rows and columns.
"""

import csv
import io
import math
import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.events import DIGITS, GRID, N_TAXELS, UNIT_NAMES, Sensor, TaxelMap
from pipeline.recordings.formats.recording import (
    MAX_DURATION_S,
    MAX_SIDE,
    UNITS,
    BadRecording,
    EventRecording,
)

# Minimum duration of a recording of a gesture or a saccade, in seconds; a unit with which most
# recordings would be shorter is excluded.
SHORTEST_S = 0.02

# Factor between durations above which their units differ; units differ by a factor of 1,000.
MIXED = 100

# Number of rows or columns below which the largest coordinates do not identify a sensor.
SMALLEST_SENSOR = 6

GIVE_UNIT = "--set data.time_unit=..."
GIVE_SIZE = "--set skin.rows=... --set skin.columns=..."


@dataclass(frozen=True)
class Reading:
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
        Unit of similar recordings, for files of events that do not have theirs, if
        :attr:`time_unit` is empty and the recordings have a usual duration in it.
    """

    rows: int = 0
    columns: int = 0
    time_unit: str = ""
    downsample: int = 1
    usual_unit: str = ""


AS_FOUND = Reading()


@dataclass(frozen=True)
class Settled:
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
    """

    kept: list
    events: list
    refused: dict
    taxels: TaxelMap
    rows: int
    columns: int
    time_unit: str = ""

    def sensor(self, classes) -> Sensor:
        """The sensor, with ST-MNIST's classes and duration if the recordings are of its format."""
        is_full = len(self.taxels) == N_TAXELS and self.rows == self.columns == GRID
        if is_full and set(classes) <= set(DIGITS) and not self.time_unit:
            return Sensor(self.rows, self.columns)
        latest_ns = max((int(events.time_ns[-1]) for events in self.events), default=0)
        return Sensor(
            self.rows,
            self.columns,
            polarities=1 if all((events.polarity > 0).all() for events in self.events) else 2,
            duration_s=max(-(-latest_ns // 100_000_000), 1) / 10,  # up to the next tenth
            classes=tuple(sorted(classes, key=class_order)),
        )


def class_order(name: str):
    """Key that sorts names as people do: 2 before 10."""
    pieces = re.split(r"([0-9]+)", name)
    # The longer of two numbers is the larger one; int() refuses those of thousands of digits.
    numbers = [piece.lstrip("0") if piece[:1] in DIGITS else "" for piece in pieces]
    return [
        (piece[:1] in DIGITS, len(number), number, piece)
        for piece, number in zip(pieces, numbers, strict=True)
    ], name


def settle(path, recordings, parts, lookup=None, positions=None, reading=AS_FOUND) -> Settled:
    """Determine the sensor of recordings that were read one by one.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of MatRecording or EventRecording
        All of the same kind.
    parts : list of str
        Part of the published split of each, or empty.
    lookup : TaxelMap, optional
        Places of the taxels in the image, from ``LUT.mat``.
    positions : dict of int to (float, float), optional
        Positions of the taxels on the sensor, from ``taxels.csv``.
    reading : Reading

    Raises
    ------
    UserError
        Rows, columns or the unit of time cannot be determined, or differ between the parts.
    """
    is_camera = any(isinstance(recording, EventRecording) for recording in recordings)
    settled = (_of_files_of_events if is_camera else _of_matrices)(
        path, recordings, parts, lookup, positions is not None, reading
    )
    _require_equal_polarities(path, settled, parts)
    if positions is None:
        return settled
    return replace(settled, taxels=_with_positions(path, settled, positions))


# Files in the published layout, with a row for each taxel.


def _of_matrices(path, recordings, parts, lookup, is_strip, reading):
    rows, columns = reading.rows, reading.columns
    counts = {
        part: Counter(r.n_taxels for r, p in zip(recordings, parts, strict=True) if p == part)
        for part in sorted(set(parts))
    }
    usual = {part: count.most_common(1)[0][0] for part, count in counts.items()}
    if len(set(usual.values())) > 1:
        _refuse_parts(path, "sensors", {part: f"{n} taxels" for part, n in usual.items()})
    n = len(lookup) if lookup is not None else next(iter(usual.values()), N_TAXELS)
    which = "LUT.mat says" if lookup is not None else "most have"
    refused = {
        index: f"has {recording.n_taxels + 1} rows, not {n + 1} as {which}"
        for index, recording in enumerate(recordings)
        if recording.n_taxels != n
    }
    kept = [index for index in range(len(recordings)) if index not in refused]
    events = [recordings[index].events for index in kept]
    if lookup is not None:
        needed = int(lookup.row.max()) + 1, int(lookup.column.max()) + 1
        rows, columns = rows or needed[0], columns or needed[1]
        if rows < needed[0] or columns < needed[1]:
            raise UserError(
                f"{path}: recordings of a sensor of {needed[0]} x {needed[1]} taxels (LUT.mat), "
                f"larger than {rows} x {columns}; give recordings of a sensor of that size"
            )
        return Settled(kept, events, refused, lookup, rows, columns)
    if not rows and not columns:
        side = math.isqrt(n)
        rows = side if side * side == n and not is_strip else 1
    rows = rows or max(n // columns, 1)
    columns = columns or max(n // rows, 1)
    if rows * columns != n:
        raise UserError(
            f"{path}: recordings of {n} taxels, not of {rows} rows of {columns}; give recordings "
            f"of that sensor, add LUT.mat, or give the numbers of rows and columns: {GIVE_SIZE}"
        )
    return Settled(kept, events, refused, TaxelMap.grid(rows, columns), rows, columns)


# Files of events, with the column and row of each event.


def _of_files_of_events(path, recordings, parts, lookup, is_strip, reading):
    side = reading.downsample
    if side > 1:
        recordings = [replace(r, x=r.x // side, y=r.y // side) for r in recordings]
    unit = _unit_of(path, recordings, parts, reading)
    refused = _of_other_sensors(path, recordings, parts, reading)
    for index in _of_other_units([recording.time for recording in recordings]):
        refused.setdefault(
            index,
            f"has times more than {MIXED} times as long or as short as most have; if they are in "
            "another unit, convert them to that of the others",
        )
    for index, recording in enumerate(recordings):
        if (seconds := _span(recording.time) * UNITS[unit]) > MAX_DURATION_S:
            refused.setdefault(
                index,
                f"lasts {seconds:.4g} s with its times as {UNIT_NAMES[unit]}, more than "
                f"{MAX_DURATION_S:g} s; if they are in another unit, give it ({GIVE_UNIT})",
            )
    kept = [index for index in range(len(recordings)) if index not in refused]
    fitting = [recordings[index] for index in kept]
    rows, columns = _size_of(path, fitting, side, reading)
    is_clock = _is_a_clock([recording.time for recording in fitting], unit)
    events = [r.events(rows, to_ns(r.time, unit, is_clock)) for r in fitting]
    return Settled(kept, events, refused, TaxelMap.grid(rows, columns), rows, columns, unit)


def _unit_of(path, recordings, parts, reading):
    """The unit of time: the user's, the files', or inferred."""
    if reading.time_unit:
        return reading.time_unit
    units = {
        part: {r.unit for r, p in zip(recordings, parts, strict=True) if p == part and r.unit}
        for part in sorted(set(parts))
    }
    stated = set.union(set(), *units.values())
    if len(stated) > 1:
        names = [UNIT_NAMES[unit] for unit in UNITS if unit in stated]
        raise UserError(f"{path}: files with times in {' and in '.join(names)}; use one unit")
    spans = {}
    for recording, part in zip(recordings, parts, strict=True):
        spans.setdefault(part, []).append(_span(recording.time))
    typical = {part: float(np.median(spans[part])) for part in sorted(spans)}
    if len(typical) > 1 and max(typical.values()) > MIXED * min(typical.values()) > 0:
        texts = {part: f"times of typically {span:.4g}" for part, span in typical.items()}
        _refuse_parts(path, "units of time", texts)
    unit = next(iter(stated), "")
    if not unit and (usual := reading.usual_unit):
        usual_s = np.median(np.concatenate(list(spans.values()))) * UNITS[usual]
        unit = usual if SHORTEST_S <= usual_s <= MAX_DURATION_S else ""
    unit = unit or recognised([recording.time for recording in recordings])
    if not unit:
        raise UserError(
            f"{path}: no unit of time fits recordings of up to {MAX_DURATION_S:g} s; give the unit "
            f"({GIVE_UNIT})"
        )
    return unit


def _of_other_sensors(path, recordings, parts, reading):
    """Recordings whose events cannot be from the same sensor as the others, with the reason."""
    extents = np.array([(int(r.y.max()) + 1, int(r.x.max()) + 1) for r in recordings])
    outside = (extents > np.array([reading.rows or np.inf, reading.columns or np.inf])).any(axis=1)
    sizes = Counter(r.size for r in recordings if r.size)
    if 2 * outside.sum() >= len(recordings):
        size = sizes.most_common(1)[0][0] if sizes else extents.max(axis=0)
        of_what = " x ".join(str(n or "any") for n in (reading.rows, reading.columns))
        raise UserError(
            f"{path}: recordings of a sensor of {size[0]} x {size[1]} taxels, larger than the "
            f"{of_what} of skin.rows and skin.columns; give recordings of a sensor of that size"
        )
    refused = {
        int(index): "has an event at y = {}, x = {}, outside {} rows and {} columns".format(
            *(extents[index] - 1), *(n or "any" for n in (reading.rows, reading.columns))
        )
        for index in np.flatnonzero(outside)
    }
    _require_equal_sizes(path, recordings, extents, parts)
    if len(sizes) > 1:
        usual = sizes.most_common(1)[0][0]
        for index, recording in enumerate(recordings):
            if recording.size and recording.size != usual:
                own, most = ("x".join(map(str, size)) for size in (recording.size, usual))
                refused.setdefault(index, f"is of a sensor of {own}, most others are of {most}")
    return refused


def _require_equal_sizes(path, recordings, extents, parts):
    """Refuse a published split whose parts are of different sensors."""
    sizes = {}
    for part in sorted(set(parts)):
        chosen = np.array([p == part for p in parts])
        stated = Counter(r.size for r, is_chosen in zip(recordings, chosen, strict=True) if r.size)
        sizes[part] = np.array(stated.most_common(1)[0][0] if stated else extents[chosen].max(0))
    smallest, largest = (how(list(sizes.values()), axis=0) for how in (np.min, np.max))
    if ((largest >= SMALLEST_SENSOR) & (largest > 1.25 * smallest)).any():
        texts = {part: f"{size[0]} x {size[1]} taxels" for part, size in sizes.items()}
        _refuse_parts(path, "sensors", texts)


def _refuse_parts(path, what, values):
    listed = ", ".join(f"{part} has {value}" for part, value in sorted(values.items())[::-1])
    raise UserError(
        f"{path}: its parts are of different {what}: {listed}; give parts of one sensor in one unit"
    )


def _require_equal_polarities(path, settled, parts):
    polarities = {}
    for index, events in zip(settled.kept, settled.events, strict=True):
        if parts[index]:
            polarities.setdefault(parts[index], set()).update(np.unique(events.polarity).tolist())
    if len({tuple(sorted(values)) for values in polarities.values()}) > 1:
        text = {
            part: " and ".join(name for sign, name in ((1, "ON"), (-1, "OFF")) if sign in values)
            for part, values in polarities.items()
        }
        _refuse_parts(path, "polarities", {p: f"{names} events" for p, names in text.items()})


def _size_of(path, recordings, side, reading):
    """Rows and columns of files of events."""
    places = [(r.y, r.x) for r in recordings]
    size = [
        requested
        or max(
            [1, *(int(p[axis].max()) + 1 for p in places)]
            + [-(-r.size[axis] // side) for r in recordings if r.size]
        )
        for axis, requested in ((0, reading.rows), (1, reading.columns))
    ]
    if max(size) > MAX_SIDE:
        needed = -(-max(size) // MAX_SIDE) * side
        raise UserError(
            f"{path}: the sensor has {size[0]} rows and {size[1]} columns, more than {MAX_SIDE}; "
            f"combine squares of pixels: --set data.downsample={needed}"
        )
    return size


# Times.


def _span(time) -> float:
    """The time from the first event to the last."""
    return float(time[-1] - time[0])


def recognised(times) -> str:
    """The unit of recordings, inferred from their duration.

    Times with fractions are seconds if they are as short as recordings are.  Whole numbers are
    taken for the longest unit in which the recordings last at most a minute.

    Parameters
    ----------
    times : sequence of ndarray
        Times of each recording, in order.

    Returns
    -------
    str
        One of :data:`pipeline.recordings.formats.recording.UNITS`, or empty if none fits.
    """
    spans = np.array([_span(time) for time in times])
    spans = spans[spans > 0]
    if not len(spans):
        return "s" if all(time[-1] <= MAX_DURATION_S for time in times) else ""
    typical = float(np.median(spans))
    whole = all(time.dtype.kind == "i" for time in times)
    for unit, seconds in UNITS.items():
        if unit == "s" and whole:
            continue  # no sensor has times in whole seconds
        if SHORTEST_S <= typical * seconds <= MAX_DURATION_S:
            return unit
    return "s" if not whole and typical <= MAX_DURATION_S else ""


def _of_other_units(times) -> list:
    """Indices of recordings whose times cannot be in the unit of the others.

    Recordings with a single event have no duration, and fit any unit.
    """
    spans = np.array([_span(time) for time in times])
    some = np.flatnonzero(spans > 0)
    if len(some) < 2:
        return []
    ratio = spans[some] / np.median(spans[some])
    return some[(ratio > MIXED) | (ratio < 1 / MIXED)].tolist()


def _is_a_clock(times, unit: str) -> bool:
    """True if the times of recordings are a running clock's, not relative to their start.

    A camera's clock starts when it is switched on, or in 1970.  One recording that starts later
    than the longest one lasts, or that ends later than any can last, shows that the recordings
    were cut from a longer one, also those from its first minute.
    """
    first, last = (max((float(time[i]) for time in times), default=0) for i in (0, -1))
    longest = max(map(_span, times), default=0)
    return last * UNITS[unit] > MAX_DURATION_S or first > longest > 0


def to_ns(time: np.ndarray, unit: str, from_first: bool = False) -> np.ndarray:
    """Times in nanoseconds.

    Parameters
    ----------
    time : ndarray
        In order.
    unit : str
    from_first : bool
        True for times relative to the first event.
    """
    if from_first:
        time = time - time[0]
    if time.dtype.kind == "i":
        return time * round(UNITS[unit] * 1e9)
    return np.rint(time * UNITS[unit] * 1e9).astype(np.int64)


# Positions.


def read_positions(content: bytes) -> dict:
    """Read ``taxels.csv``: a line ``taxel,x,y`` for each taxel, below a line with these names.

    Returns
    -------
    dict of int to (float, float)
        Position of each taxel: x to the right, y downwards, in any unit.

    Raises
    ------
    BadRecording
        It has other columns or values, or a taxel twice.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig")), skipinitialspace=True))
        taxels = [int(row["taxel"]) for row in rows]
        places = [(float(row["x"]), float(row["y"])) for row in rows]
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise BadRecording("is not a table with the columns taxel, x and y in numbers") from error
    doubled = [taxel for taxel, count in Counter(taxels).items() if count > 1]
    if doubled:
        raise BadRecording(f"has taxel {doubled[0]} twice; keep one line of it")
    if not rows or not np.isfinite(places).all():
        raise BadRecording("has no taxels, or a position that is not finite")
    return dict(zip(taxels, places, strict=True))


def _with_positions(path, settled, positions):
    """The taxels with their positions, of a sensor in one row whose taxels are numbered by x."""
    if settled.rows != 1:
        raise UserError(
            f"{path}: taxels.csv is for sensors whose taxels are numbered by x, in one row; these "
            f"recordings have {settled.rows} rows: remove taxels.csv"
        )
    if wrong := sorted(positions.keys() ^ set(range(settled.columns))):
        raise UserError(
            f"{path}: taxels.csv needs a line for each taxel from 0 to {settled.columns - 1} (or "
            f"give --set skin.columns=...), and taxel {wrong[0]} is missing or not one of them"
        )
    return replace(
        settled.taxels,
        positions=np.array([positions[taxel] for taxel in range(settled.columns)], float),
    )
