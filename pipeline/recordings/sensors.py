"""What a set of recordings was made with: rows and columns, duration and classes, as found.

Recordings in the published layout with a hundred taxels and digits for classes are ST-MNIST's, and
have its ten classes and its two seconds whatever is in them.  Of all others what counts is what is
there, unless the settings say how many rows and columns there are.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.eventfile import EventRecording
from pipeline.recordings.events import DIGITS, GRID, N_TAXELS, Sensor, TaxelMap


@dataclass(frozen=True)
class Settled:
    """Recordings of one sensor.

    Attributes
    ----------
    kept : list of (str, Events)
        Name of the file and events of each recording that fits.
    refused : list of (str, str)
        Name of the file and reason of those that do not.
    taxels : TaxelMap
    sensor : Sensor
    labels : list of int
        Of ``kept``.
    """

    kept: list
    refused: list
    taxels: TaxelMap
    sensor: Sensor
    labels: list


def class_order(name: str):
    """Key that sorts names as people do: 2 before 10."""
    parts = re.split(r"(\d+)", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts], name


def settle(path, read, lookup: TaxelMap | None = None, rows: int = 0, columns: int = 0) -> Settled:
    """Find out the sensor of recordings that were read one by one.

    Parameters
    ----------
    path : path-like
        Of the source, for messages.
    read : list of (str, str, MatRecording or EventRecording)
        Name of the file, class and content of each; all of the same kind.
    lookup : TaxelMap, optional
        Positions of the taxels.
    rows, columns : int
        As given by the user; 0 for as found.

    Raises
    ------
    UserError
        Rows and columns cannot be known, or are fewer than the look-up table has.
    """
    if lookup is not None:
        for what, given, found in (("rows", rows, lookup.row), ("columns", columns, lookup.column)):
            if given and given <= found.max():
                raise UserError(
                    f"{path}: LUT.mat has coordinates outside the {given} {what} asked for; "
                    f"give at least {found.max() + 1}, or 0 for as many as there are"
                )
        rows, columns = rows or int(lookup.row.max()) + 1, columns or int(lookup.column.max()) + 1
    of_events = any(isinstance(recording, EventRecording) for _, _, recording in read)
    settled = _from_coordinates if of_events else _from_addresses
    taxels, kept, refused = settled(path, read, lookup, rows, columns)
    rows, columns = rows or int(taxels.row.max()) + 1, columns or int(taxels.column.max()) + 1
    names = {name for _, name, _ in kept}
    is_full = len(taxels) == N_TAXELS and rows == columns == GRID
    is_published = not of_events and is_full and names <= set(DIGITS)
    if is_published:
        sensor = Sensor(rows, columns)
    else:
        everything = [events for _, _, events in kept]
        sensor = Sensor(
            rows,
            columns,
            polarities=1 if all((e.polarity > 0).all() for e in everything) else 2,
            duration_s=_duration_s(max((int(e.time_ns[-1]) for e in everything), default=0)),
            classes=tuple(sorted(names, key=class_order)),
        )
    return Settled(
        kept=[(name, events) for name, _, events in kept],
        refused=refused,
        taxels=taxels,
        sensor=sensor,
        labels=[sensor.classes.index(name) for _, name, _ in kept],
    )


def _from_coordinates(path, read, lookup, rows, columns):
    """Of files with the row and column of each event."""
    kept, refused = [], []
    for file, name, recording in read:
        for what, places, given in (("y", recording.y, rows), ("x", recording.x, columns)):
            if given and places.max() >= given:
                of_what = "rows" if what == "y" else "columns"
                refused.append((file, f"has {what} = {places.max()}, outside {given} {of_what}"))
                break
        else:
            kept.append((file, name, recording))
    rows = rows or max((int(r.y.max()) + 1 for _, _, r in kept), default=1)
    columns = columns or max((int(r.x.max()) + 1 for _, _, r in kept), default=1)
    return TaxelMap.grid(rows, columns), [(f, n, r.events(rows)) for f, n, r in kept], refused


def _from_addresses(path, read, lookup, rows, columns):
    """Of files in the published layout, with a row for each taxel."""
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
            "add it, or say how many rows and columns there are: --rows and --columns of "
            "'stmnist data', else --set skin.rows=... --set skin.columns=..."
        )
    return TaxelMap.grid(rows, columns), kept, refused


def _duration_s(latest_ns):
    """The time of the last event, up to the next tenth of a second."""
    return max(-(-latest_ns // 100_000_000), 1) / 10


def too_small(recordings) -> str | None:
    """What is wrong with the numbers of recordings in the classes, if anything.

    A class that has one recording can be trained or tested, not both.
    """
    counts = np.bincount(recordings.labels, minlength=len(recordings.sensor.classes))
    single = [recordings.sensor.classes[i] for i in np.flatnonzero(counts == 1)]
    if single:
        listed = ", ".join(map(repr, single[:5])) + (", ..." if len(single) > 5 else "")
        return f"only one recording of {listed}; record more, or take the folder away"
    if np.count_nonzero(counts) < 2:
        return "recordings of one class only; at least two are needed"
    return None
