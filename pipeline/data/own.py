"""Writing arrays of events as files of recordings that all commands read."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from deploy.errors import SeveralErrors, UserError
from deploy.files import replacing
from pipeline.data.archive import NO_TIME
from pipeline.data.eventarrays import recording_of
from pipeline.data.matfile import BadRecording
from pipeline.data.timeunits import UNITS

LISTED = 10
"""Number of reasons that are listed individually."""


def write_recordings(
    path,
    recordings: Iterable,
    classes: Sequence[str] | None = None,
    time_unit: str = "",
    writers: Sequence[int] | None = None,
    simulated: bool = False,
) -> Path:
    """Write events and labels as a zip that every command accepts as recordings.

    A training needs at least two recordings of each class; `stmnist adapt` does not.

    Give its path as ``data.source`` in the settings, or as ``--data`` to a command.

    Parameters
    ----------
    path : path-like
        The zip; its name must end in ``.zip``.  An existing file is replaced.
    recordings : iterable of (events, label)
        For example a data set of Tonic, or ``zip(events, labels)``.  Events have any of the forms
        of :func:`pipeline.data.eventarrays.recording_of`: x is the column from the left, y
        the row from the top.  A label is a number from 0, or the name of a class.
    classes : sequence of str, optional
        Names of the labels 0, 1, ...; default: the ``classes`` of ``recordings`` if it has this
        attribute, else the labels themselves.
    time_unit : str
        Unit of the times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; empty: inferred from the
        duration of the recordings when the file is read.
    writers : sequence of int, optional
        Number of the person who made each recording, from 0.
    simulated : bool
        True if the recordings are simulated; every result repeats this.

    Returns
    -------
    Path

    Raises
    ------
    UserError
        Events or labels are not valid, with a line for each reason; or there are none.
    """
    path = Path(path)
    if path.suffix != ".zip":
        raise UserError(f"{path}: the name must end in .zip")
    if time_unit and time_unit not in UNITS:
        raise UserError(f"time_unit {time_unit!r}: choose one of {', '.join(UNITS)}")
    if classes is None:
        classes = getattr(recordings, "classes", None)
    names, labels, problems = list(map(str, () if classes is None else classes)), [], {}
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        for index, (events, label) in enumerate(recordings):
            try:
                labels.append(_class_of(label, names, classes is not None))
                writer = -1 if writers is None else int(writers[index])
                content = _npz(recording_of(events), time_unit, writer, simulated)
            except BadRecording as error:
                problems.setdefault(str(error), []).append(index)
                continue
            member = PurePosixPath(names[labels[-1]]) / f"{index:06d}.npz"
            archive.writestr(zipfile.ZipInfo(str(member), NO_TIME), content)
        lines = [
            f"{path}: {len(where)} of {index + 1}: recording {where[0]} {reason}"
            for reason, where in list(problems.items())[:LISTED]
        ]
        if not lines and not labels:
            lines.append(f"{path}: no recordings")
        if lines:
            raise SeveralErrors(lines)
    return path


def _class_of(label, names, fixed):
    """The number of a label's class; a new name is added unless the classes are given."""
    is_number = isinstance(label, (int, np.integer)) and not isinstance(label, bool)
    if fixed and is_number:
        if not 0 <= label < len(names):
            raise BadRecording(f"has the label {label}, not from 0 to {len(names) - 1}")
        name = names[label]
    elif isinstance(label, (str, int, np.integer)):
        name = str(label)
    else:
        raise BadRecording(
            f"has a label of the type {type(label).__name__}; give pairs (events, label) with a "
            "number or a name as label"
        )
    parts = PurePosixPath(name).parts
    if len(parts) != 1 or parts[0] in ("..", "/") or name.startswith(".") or not name.isprintable():
        raise BadRecording(f"has the class {name!r}, which is not a valid name of a folder")
    if name not in names:
        if fixed:
            raise BadRecording(f"has the class {name!r}, which is not one of those given")
        names.append(name)
    return names.index(name)


def _npz(recording, time_unit, writer, simulated) -> bytes:
    """A recording as a file; see :mod:`pipeline.data.eventfile`."""
    arrays = {"x": recording.x.astype(np.uint16), "y": recording.y.astype(np.uint16)}
    unit = recording.unit or time_unit
    arrays[f"t_{unit}" if unit else "t"] = recording.time
    arrays["p"] = recording.polarity
    if writer >= 0:
        arrays["writer"] = np.array(writer)
    if simulated:
        arrays["simulated"] = np.array(True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()
