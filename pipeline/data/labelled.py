"""Data sets whose classes are not the names of folders: DVS Gesture, in two layouts.

**As published** (Amir et al., *A Low Power, Fully Event-Based Gesture Recognition System*, CVPR
2017): a person's recording is one long file, ``user01_led.aedat``, and ``user01_led_labels.csv``
beside it has a line for each gesture: ``class,startTime_usec,endTime_usec``.
``gesture_mapping.csv`` has a name for each class.  Any file of events is divided by such a file.

**As Tonic stores it**: ``user01_led/3.npy`` is a gesture, of the class 3.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from deploy.terminal import printable
from pipeline.data.eventarrays import MAX_EVENTS, EventRecording
from pipeline.data.matfile import BadRecording

LABELS, MAPPING = "_labels.csv", "gesture_mapping.csv"

MOST_EVENTS = 20_000_000
"""Events of a file that is divided."""

MOST_PARTS = 10_000
"""Recordings in one file."""

USER = re.compile(r"user(\d{1,6})_")
"""Pattern of names of files or folders that identify the writer of the recordings."""


@dataclass(frozen=True)
class Part:
    """A recording in a longer file.

    Attributes
    ----------
    file : str
        Path of the file in its source.
    start_us, end_us : int
        Start (included) and end (excluded) in microseconds of the file's clock.
    unit : str
        Unit of the file's times as the user has given it, for a file that does not have it.
    """

    file: str
    start_us: int
    end_us: int
    unit: str = ""

    def of(self, whole: EventRecording) -> EventRecording:
        """The events of this part; times are relative to its start.

        Raises
        ------
        BadRecording
            There are no events or too many, or the file's times are not in microseconds.
        """
        if (whole.unit or self.unit) != "us":
            raise BadRecording(
                "has times that are not known to be in microseconds, the unit of its labels; if "
                "they are, give it (--time-unit of 'stmnist data', else --set data.time_unit=us)"
            )
        first, last = np.searchsorted(whole.time, (self.start_us, self.end_us))
        if first == last:
            raise BadRecording(f"is empty: no events from {self.start_us} to {self.end_us} us")
        if last - first > MAX_EVENTS:
            raise BadRecording(f"has {last - first} events, more than {MAX_EVENTS}")
        kept = slice(first, last)
        return replace(
            whole,
            x=whole.x[kept],
            y=whole.y[kept],
            time=whole.time[kept] - self.start_us,
            polarity=whole.polarity[kept],
            writer=user_of(self.file),
            from_start=True,
        )


def user_of(path: str) -> int:
    """The number of the person in the name of a file or of its folder, or -1."""
    parts = PurePosixPath(path).parts[-2:]
    found = [match for part in parts[::-1] if (match := USER.match(part))]
    return int(found[0][1]) if found else -1


def divided(names, read) -> tuple:
    """The recordings in files that have a file of labels beside them.

    Parameters
    ----------
    names : sequence of str
        Paths of the files of a source.
    read : callable
        ``read(name)`` returns a file's content; called for labels and class names only.

    Returns
    -------
    parts : dict of str to (str, Part)
        Class and part of each recording, by its name.
    used : set of str
        The divided files, and the files of labels and names.
    refused : list of (str, str)
        Files of labels that cannot be read, with the reason.
    """
    known, parts, used, refused = set(names), {}, set(), []
    whole = {_labels_of(name): name for name in names if not name.lower().endswith(".csv")}
    labelled = sorted(known & whole.keys())
    titles = {}
    for name in names if labelled else ():
        if PurePosixPath(name).name.lower() == MAPPING:
            used.add(name)
            titles = _titles(read(name))
    for labels in labelled:
        file = whole[labels]
        used |= {labels, file}
        try:
            rows = _rows(read(labels))
        except BadRecording as error:
            refused.append((labels, str(error)))
            continue
        path = PurePosixPath(file)
        for number, (label, start, end) in enumerate(rows):
            title = titles.get(label, str(label))
            name = str(path.parent / title / f"{path.stem} {number:02d}")
            parts[name] = title, Part(file, start, end)
    return parts, used, refused


def class_of_user_file(name: str) -> str:
    """The class of a file in Tonic's layout; empty if it is not in that layout."""
    path = PurePosixPath(name)
    is_one = path.suffix.lower() == ".npy" and path.stem.isdecimal() and path.stem.isascii()
    return path.stem if is_one and USER.match(path.parent.name) else ""


def _labels_of(name):
    path = PurePosixPath(name)
    return str(path.with_name(path.stem + LABELS))


def _lines(content):
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadRecording("is not text in UTF-8") from error
    return [[cell.strip() for cell in line.split(",")] for line in text.splitlines() if line]


def _rows(content):
    """Class, start and end of each line below the first."""
    lines = _lines(content)[1:]
    try:
        rows = [tuple(map(int, line)) for line in lines]
    except ValueError as error:
        raise BadRecording("has a line that is not three whole numbers") from error
    if not rows or any(len(row) != 3 for row in rows):
        raise BadRecording("has no lines of class, startTime_usec, endTime_usec")
    if len(rows) > MOST_PARTS:
        raise BadRecording(f"has {len(rows)} lines, more than {MOST_PARTS}")
    if any(not 0 <= start < end < 2**62 for _, start, end in rows):
        raise BadRecording("has a line whose end is not after its start")
    return rows


def _titles(content):
    """Names of classes from lines such as ``hand_clapping,1``; other lines are left out."""
    try:
        lines = _lines(content)
    except BadRecording:
        return {}
    return {
        int(line[1]): printable(line[0]).replace("/", "_")
        for line in lines
        if len(line) == 2 and line[1].isdecimal() and line[0].strip(".")
    }
