"""Write recordings as a zip: events with labels, or a set of recordings in the published layout."""

import io
import zipfile
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from deploy.errors import SeveralErrors, UserError
from deploy.files import replacing, require_ending, zip_member
from pipeline.progress import ignore_progress
from pipeline.recordings.formats.mat import MatRecording, encode_lookup_table, encode_recording
from pipeline.recordings.formats.recording import UNITS, BadRecording, make_recording
from pipeline.recordings.interpretation.class_order import CLASS_ORDER
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.sensor import make_class_sort_key

# Number of reasons that are listed individually.
MAX_LISTED = 10


def write_recordings(  # noqa: PLR0913 - a public function, whose callers name all but the first
    path,
    recordings: Iterable,
    classes: Sequence[str] | None = None,
    time_unit: str = "",
    writers: Sequence[int] | None = None,
    simulated: bool = False,
    parts: Sequence[str] | None = None,
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
        of :func:`pipeline.recordings.formats.recording.make_recording`: x is the column from the
        left, y the row from the top.  A label is a number from 0, or the name of a class.  An
        attribute ``sensor_size`` (columns, rows, ...), as Tonic's, is the size of the sensor.
    classes : sequence of str, optional
        Names of the labels 0, 1, ..., an order that the file keeps; default: the ``classes`` of
        ``recordings`` if it has this attribute, else the labels themselves.
    time_unit : str
        Unit of the times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; empty: inferred from the
        duration of the recordings when the file is read.
    writers : sequence of int, optional
        Number of the person who made each recording, from 0.
    simulated : bool
        True if the recordings are simulated; every result repeats this.
    parts : sequence of str, optional
        ``"train"`` or ``"test"`` for each recording, of a data set with a published split.

    Returns
    -------
    Path

    Raises
    ------
    UserError
        Events or labels are not valid, with a line for each reason; or there are none.
    """
    path = Path(path)
    require_ending(path, ".zip")
    _require_valid_options(path, time_unit, writers, parts)
    names = _list_classes(path, recordings, classes)
    properties = _Properties(
        time_unit=time_unit,
        writers=writers,
        simulated=simulated,
        parts=parts,
        size=_find_sensor_size(recordings),
    )
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        _add_class_order(archive, names or [])
        n_read, problems = _add_recordings(archive, recordings, names, properties)
        _require_complete(path, n_read, problems, properties)
    return path


@dataclass(frozen=True)
class _Properties:
    """Properties of the recordings that are written with their events.

    Attributes
    ----------
    time_unit : str
    writers : sequence of int or None
    simulated : bool
    parts : sequence of str or None
    size : (int, int) or None
        Rows and columns of the sensor.
    """

    time_unit: str
    writers: Sequence[int] | None
    simulated: bool
    parts: Sequence[str] | None
    size: tuple | None

    @property
    def lengths(self) -> set:
        """The numbers of recordings for which there are writers or parts."""
        return {len(values) for values in (self.writers, self.parts) if values is not None}

    def make_path(self, index: int, class_name: str) -> PurePosixPath:
        """The path of a recording in the zip."""
        part = "" if self.parts is None else self.parts[index]
        return PurePosixPath(part, class_name, f"{index:06d}.npz")

    def encode(self, index: int, events) -> bytes:
        """The content of the file of a recording."""
        writer = -1 if self.writers is None else int(self.writers[index])
        recording = replace(make_recording(events), size=self.size, writer=writer)
        return _encode_npz(recording, self.time_unit, self.simulated)


def _add_class_order(archive, names):
    """Write the order of the classes to a zip, if it is not that of their names."""
    if names != sorted(names, key=make_class_sort_key):
        archive.writestr(zip_member(CLASS_ORDER, zipfile.ZIP_STORED), "\n".join(names) + "\n")


def _add_recordings(archive, recordings, names, properties):
    """Write recordings to a zip.

    Returns
    -------
    n_read : int
        Number of the recordings, valid or not; reading ends after the last writer or part.
    problems : dict of str to list of int
        Indices of the recordings that are not valid, by the reason.
    """
    known_names = names or []
    problems: dict = {}
    n_read = 0
    for index, (events, label) in enumerate(recordings):
        n_read += 1
        if index in properties.lengths:
            break
        try:
            class_name = _find_class(label, known_names, is_fixed=names is not None)
            content = properties.encode(index, events)
        except BadRecording as error:
            problems.setdefault(str(error), []).append(index)
            continue
        member = zip_member(properties.make_path(index, class_name), zipfile.ZIP_STORED)
        archive.writestr(member, content)
    return n_read, problems


def _require_complete(path, n_read, problems, properties):
    """Refuse recordings that are not valid, and another number of them than of writers or parts."""
    if properties.lengths - {n_read}:
        raise UserError(f"{path}: give a writer or a part for each of the recordings")
    if problems:
        raise SeveralErrors(
            f"{path}: {len(indices)} of {n_read}: recording {indices[0]} {reason}"
            for reason, indices in list(problems.items())[:MAX_LISTED]
        )
    if not n_read:
        raise SeveralErrors([f"{path}: no recordings"])


def _require_valid_options(path, time_unit, writers, parts):
    """Refuse a unit of time, parts or writers that are not valid."""
    if time_unit and time_unit not in UNITS:
        raise UserError(f"time_unit {time_unit!r}: choose one of {', '.join(UNITS)}")
    if parts is not None and not set(parts) <= {"train", "test"}:
        raise UserError(f"{path}: a part is 'train' or 'test', for each recording")
    if writers is not None and not all(
        isinstance(writer, (int, np.integer)) and writer >= 0 for writer in writers
    ):
        raise UserError(f"{path}: a writer is a whole number from 0, for each recording")


def _list_classes(path, recordings, classes) -> list[str] | None:
    """Names of the classes; None if only the labels themselves name them."""
    if classes is None:
        classes = getattr(recordings, "classes", None)
    if classes is None:
        return None
    if isinstance(classes, str):
        raise UserError(f"classes: {classes!r} is one name; give a list of names")
    if isinstance(classes, Set):
        raise ValueError("classes: a set has no order; give a list of names")
    names = list(map(str, classes))
    if len(set(names)) < len(names):
        raise UserError(f"{path}: two of the classes have the same name")
    return names


def _find_class(label, names, is_fixed):
    """The name of a label's class, which must be one of the names if these are fixed."""
    is_number = isinstance(label, (int, np.integer)) and not isinstance(label, bool)
    if is_fixed and is_number:
        if not 0 <= label < len(names):
            raise BadRecording(f"has the label {label}, not from 0 to {len(names) - 1}")
        name = names[label]
    elif is_number and label < 0:
        raise BadRecording(f"has the label {label}; labels are numbers from 0, or names")
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
    if is_fixed and name not in names:
        raise BadRecording(f"has the class {name!r}, which is not one of those given")
    return name


def _find_sensor_size(recordings):
    """Rows and columns of the sensor of a data set of Tonic's; None if it has none."""
    size = getattr(recordings, "sensor_size", None)
    if not isinstance(size, tuple) or len(size) < 2:
        return None
    columns, rows = size[:2]
    is_size = all(isinstance(side, (int, np.integer)) and side > 0 for side in (rows, columns))
    return (int(rows), int(columns)) if is_size else None


def _encode_npz(recording, time_unit, simulated) -> bytes:
    """The content of a ``.npz`` file with a recording."""
    arrays = {"x": recording.x.astype(np.uint16), "y": recording.y.astype(np.uint16)}
    unit = recording.unit or time_unit
    arrays[f"t_{unit}" if unit else "t"] = recording.time
    arrays["p"] = recording.polarity
    if recording.writer >= 0:
        arrays["writer"] = np.array(recording.writer)
    if recording.size is not None:
        arrays["rows"], arrays["columns"] = map(np.array, recording.size)
    if simulated:
        arrays["simulated"] = np.array(True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def write_mat_zip(path, recordings: Recordings, progress=ignore_progress):
    """Write recordings as a zip in the published layout; equal recordings give equal bytes.

    Parameters
    ----------
    path : path-like
    recordings : Recordings
        Their ids become the names: ``"3/0042"`` is ``data_submission/3/0042.mat``.
    progress : callable, optional
        As in :func:`pipeline.recordings.files.reading.read_source`.
    """
    with (
        replacing(path) as file,
        zipfile.ZipFile(file, "w") as archive,
        progress("write", len(recordings), "recordings") as advance,
    ):

        def add(name, content):  # stored: recordings are compressed already
            member = PurePosixPath("data_submission", name)
            archive.writestr(zip_member(member, zipfile.ZIP_STORED), content)

        add("LUT.mat", encode_lookup_table(recordings.taxels))
        for index, name in enumerate(recordings.ids):
            recording = MatRecording(
                recordings[index],
                recordings.source.simulated,
                int(recordings.writers[index]),
                n_taxels=len(recordings.taxels),
            )
            add(f"{name}.mat", encode_recording(recording))
            advance(1)
