"""Determine the sensor of a set of recordings: rows, columns, duration and classes.

Recordings in the published layout with a hundred taxels and digits as classes are treated as
ST-MNIST's: they have its ten classes and its two seconds, independently of their content.  For all
others the values are those found, unless the settings specify rows and columns.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from deploy.errors import UserError
from pipeline.data.eventarrays import EventRecording
from pipeline.data.events import DIGITS, GRID, N_TAXELS, Sensor, TaxelMap
from pipeline.data.matfile import LATEST_S, MAX_SIDE
from pipeline.data.timeunits import (
    MIXED,
    UNIT_NAMES,
    UNITS,
    of_a_clock,
    of_other_units,
    recognised,
    span_of,
    to_ns,
)


@dataclass(frozen=True)
class Settled:
    """Recordings of one sensor.

    Attributes
    ----------
    kept : list of (str, Events)
        Name of the file and events of each recording that fits.
    refused : list of (str, str)
        Name of the file and reason for each recording that does not fit.
    taxels : TaxelMap
    sensor : Sensor
    labels : list of int
        Labels of ``kept``.
    problems : list of str
        Problems of the recordings as a whole.
    time_unit : str
        Unit in which the times of files of events were read.
    """

    kept: list
    refused: list
    taxels: TaxelMap
    sensor: Sensor
    labels: list
    problems: list
    time_unit: str


def class_order(name: str):
    """Key that sorts names as people do: 2 before 10."""
    parts = re.split(r"([0-9]+)", name)
    # The longer of two numbers is the larger one; int() refuses those of thousands of digits.
    numbers = [part.lstrip("0") if part[:1] in DIGITS else "" for part in parts]
    return [
        (part[:1] in DIGITS, len(number), number, part)
        for part, number in zip(parts, numbers, strict=True)
    ], name


@dataclass(frozen=True)
class Reading:
    """Properties of files that the user specifies instead of having them detected.

    Attributes
    ----------
    rows, columns : int
        Size of the sensor, after :attr:`downsample`; 0 for as found.
    time_unit : str
        Unit in files of events, one of :data:`pipeline.data.timeunits.UNITS`; empty:
        inferred.
    downsample : int
        Side of the square of pixels of a file of events that becomes one taxel.
    usual_unit : str
        Unit of similar recordings, for files of events that do not have theirs, if
        :attr:`time_unit` is empty; empty: inferred.
    """

    rows: int = 0
    columns: int = 0
    time_unit: str = ""
    downsample: int = 1
    usual_unit: str = ""


AS_FOUND = Reading()


def settle(path, read, lookup: TaxelMap | None = None, reading: Reading = AS_FOUND) -> Settled:
    """Determine the sensor of recordings that were read one by one.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    read : list of (str, str, MatRecording or EventRecording)
        Name of the file, class and content of each; all of the same kind.
    lookup : TaxelMap, optional
        Positions of the taxels.
    reading : Reading

    Raises
    ------
    UserError
        Rows and columns cannot be determined, or are fewer than the look-up table has.
    """
    rows, columns = reading.rows, reading.columns
    if lookup is not None:
        for what, given, found in (("rows", rows, lookup.row), ("columns", columns, lookup.column)):
            if given and given <= found.max():
                raise UserError(
                    f"{path}: LUT.mat has coordinates outside the {given} {what} requested; "
                    f"give at least {found.max() + 1}, or 0 for as many as there are"
                )
        rows, columns = rows or int(lookup.row.max()) + 1, columns or int(lookup.column.max()) + 1
    if any(isinstance(recording, EventRecording) for _, _, recording in read):
        return _of_camera(path, read, reading)
    taxels, kept, refused = _from_addresses(path, read, lookup, rows, columns)
    rows, columns = rows or int(taxels.row.max()) + 1, columns or int(taxels.column.max()) + 1
    names = {name for _, name, _ in kept}
    is_full = len(taxels) == N_TAXELS and rows == columns == GRID
    if is_full and names <= set(DIGITS):
        return _settled(kept, refused, taxels, Sensor(rows, columns))
    return _settled(kept, refused, taxels, _sensor_of(kept, rows, columns))


def _settled(kept, refused, taxels, sensor, problems=(), time_unit=""):
    return Settled(
        kept=[(name, events) for name, _, events in kept],
        refused=refused,
        taxels=taxels,
        sensor=sensor,
        labels=[sensor.classes.index(name) for _, name, _ in kept],
        problems=list(problems),
        time_unit=time_unit,
    )


def _sensor_of(kept, rows, columns):
    """The sensor with the polarities, the duration and the classes that were found."""
    everything = [events for _, _, events in kept]
    return Sensor(
        rows,
        columns,
        polarities=1 if all((e.polarity > 0).all() for e in everything) else 2,
        duration_s=_duration_s(max((int(e.time_ns[-1]) for e in everything), default=0)),
        classes=tuple(sorted({name for _, name, _ in kept}, key=class_order)),
    )


def _of_camera(path, read, reading):
    """The sensor of files with the column and row of each event."""
    side = reading.downsample
    if side > 1:
        read = [(f, n, replace(r, x=r.x // side, y=r.y // side)) for f, n, r in read]
    refused, problems = [], []
    unit = reading.time_unit or next((r.unit for _, _, r in read if r.unit), reading.usual_unit)
    if not unit:
        unit = recognised([r.time for _, _, r in read])
    if not unit:
        problems.append(
            f"{len(read)} of {len(read)} files: no unit of time fits recordings of up to "
            f"{LATEST_S:g} s; give the unit ({GIVE_UNIT})"
        )
        unit = "s"
    reasons = {read[i][0]: MIXED_UNITS for i in of_other_units([r.time for _, _, r in read])}
    reasons |= _elsewhere(read, reading)
    for file, _, recording in read:
        if span_of(recording.time) * UNITS[unit] > LATEST_S and not problems:
            longest = span_of(recording.time) * UNITS[unit]
            reasons.setdefault(
                file,
                f"lasts {longest:.4g} s with its times as {UNIT_NAMES[unit]}, more than "
                f"{LATEST_S:g} s; if they are in another unit, give it ({GIVE_UNIT})",
            )
    refused = list(reasons.items())
    kept = [entry for entry in read if entry[0] not in reasons]
    if _counts_from_1(kept) and not (reading.rows and reading.columns):
        problems.append(
            f"{len(kept)} of {len(kept)} files: no event has x = 0 or y = 0; if they are counted "
            "from 1, subtract 1, otherwise give the sensor's size: --set skin.rows=... "
            "--set skin.columns=..."
        )
    sizes = [r.size for _, _, r in kept if r.size]
    declared = (
        [max(-(-size[axis] // side) for size in sizes) for axis in (0, 1)] if sizes else [1, 1]
    )
    rows = reading.rows or max([declared[0], *(int(r.y.max()) + 1 for _, _, r in kept)])
    columns = reading.columns or max([declared[1], *(int(r.x.max()) + 1 for _, _, r in kept)])
    if max(rows, columns) > MAX_SIDE:
        needed = -(-max(rows, columns) // MAX_SIDE) * side
        problems.append(
            f"{len(kept)} of {len(kept)} files: the sensor has {rows} rows and {columns} columns, "
            f"more than {MAX_SIDE}; combine squares of pixels: --downsample {needed} of 'stmnist "
            f"data', else --set data.downsample={needed}"
        )
        rows, columns = min(rows, MAX_SIDE), min(columns, MAX_SIDE)
    clock = of_a_clock([r.time for _, _, r in kept if not r.from_start], unit)
    events = [
        (f, n, r.events(rows, to_ns(r.time, unit, clock and not r.from_start))) for f, n, r in kept
    ]
    taxels, sensor = TaxelMap.grid(rows, columns), _sensor_of(events, rows, columns)
    return _settled(events, refused, taxels, sensor, problems, unit)


GIVE_UNIT = "--time-unit of 'stmnist data', else --set data.time_unit=..."

MIXED_UNITS = (
    f"has times more than {MIXED} times as long or as short as most have; if they are in another "
    "unit, convert them to that of the others"
)


def _elsewhere(read, reading):
    """Files whose events cannot be from the same sensor as the others, each with the reason."""
    reasons = {}
    for file, _, recording in read:
        for what, places, given in (
            ("y", recording.y, reading.rows),
            ("x", recording.x, reading.columns),
        ):
            if given and places.max() >= given:
                of_what = "rows" if what == "y" else "columns"
                reasons[file] = f"has {what} = {places.max()}, outside {given} {of_what}"
                break
    sizes = Counter(r.size for _, _, r in read if r.size)
    if len(sizes) > 1:
        most = sizes.most_common(1)[0][0]
        for file, _, recording in read:
            if recording.size and recording.size != most:
                found, usual = ("x".join(map(str, size)) for size in (recording.size, most))
                reasons.setdefault(file, f"is of a sensor of {found}, most others are of {usual}")
    elif not (reading.rows and reading.columns):
        for index in _larger([(int(r.y.max()) + 1, int(r.x.max()) + 1) for _, _, r in read]):
            reasons.setdefault(
                read[index][0],
                "has events far outside the rows and columns of the others; remove it if it is of "
                "another sensor, or give the sensor's size (--rows, --columns of 'stmnist "
                "data', else --set skin.rows=... --set skin.columns=...)",
            )
    return reasons


def _larger(extents):
    """Indices of recordings with far larger coordinates than the others in both directions.

    If recordings of one sensor are sorted by their largest coordinate, no gap is wide.  Half of the
    recordings or more are returned only if each recording fills one of the two sizes.
    """
    if len(extents) < 4:
        return []
    extents = np.array(extents)
    for axis in (0, 1):
        order = np.sort(extents[:, axis])
        gaps = order[1:] / order[:-1]
        at = int(np.argmax(gaps))
        if gaps[at] < SIZE_GAP or order[at] < SMALLEST_SENSOR:
            continue
        large = extents[:, axis] > order[at]
        if 2 * large.sum() >= len(order) and not (
            _filled(extents[large]) and _filled(extents[~large])
        ):
            continue
        others = extents[~large].max(axis=0)
        if (extents[large] >= SIZE_GAP * others).all():
            return np.flatnonzero(large).tolist()
    return []


def _filled(extents):
    """True if each recording has events up to the last rows and columns, or nearly."""
    return bool((extents >= FILLED * extents.max(axis=0)).all())


FILLED = 0.8
"""Share of the rows and columns up to which a recording fills its sensor."""

SIZE_GAP = 1.8
"""Factor by which recordings of a larger sensor reach further than those of a smaller one."""

SMALLEST_SENSOR = 6
"""Number of rows or columns below which the largest coordinates do not identify a sensor."""


def _counts_from_1(read):
    """True if no recording has an event in the first row or column."""
    return (
        len(read) > 1
        and all(r.x.min() > 0 and r.y.min() > 0 for _, _, r in read)
        and (min(r.x.min() for _, _, r in read) == 1 and min(r.y.min() for _, _, r in read) == 1)
    )


def _from_addresses(path, read, lookup, rows, columns):
    """The sensor of files in the published layout, with a row for each taxel."""
    counts = Counter(recording.n_taxels for _, _, recording in read)
    n = len(lookup) if lookup is not None else counts.most_common(1)[0][0] if counts else N_TAXELS
    kept, refused = [], []
    for file, name, recording in read:
        if recording.n_taxels == n:
            kept.append((file, name, recording.events))
        else:
            why = f"has {recording.n_taxels + 1} rows, not {n + 1}"
            refused.append((file, why + (" as LUT.mat says" if lookup else " as most have")))
    if lookup is not None:
        return lookup, kept, refused
    rows = rows or (n // columns if columns else math.isqrt(n))
    columns = columns or n // rows
    if rows * columns != n:
        raise UserError(
            f"{path}: its {n} taxels are not {rows} rows of {columns}, and there is no LUT.mat; "
            "add it, or give the numbers of rows and columns: --rows and --columns of "
            "'stmnist data', else --set skin.rows=... --set skin.columns=..."
        )
    return TaxelMap.grid(rows, columns), kept, refused


def _duration_s(latest_ns):
    """The time of the last event, up to the next tenth of a second."""
    return max(-(-latest_ns // 100_000_000), 1) / 10


def too_small(recordings) -> str | None:
    """Problems with the numbers of recordings in the classes; see :func:`too_few`."""
    return too_few(recordings.labels, recordings.sensor.classes)


def too_few(labels, classes) -> str | None:
    """Find problems with the numbers of recordings in the classes.

    A class with one recording can be used for training or for testing, but not for both.

    Parameters
    ----------
    labels : sequence of int
    classes : sequence of str
    """
    counts = np.bincount(labels, minlength=len(classes))
    single = [classes[i] for i in np.flatnonzero(counts == 1)]
    if single:
        listed = ", ".join(map(repr, single[:5])) + (", ..." if len(single) > 5 else "")
        return f"only one recording of {listed}; record more, or take the folder away"
    if np.count_nonzero(counts) < 2:
        return "recordings of one class only; at least two are needed"
    return None
