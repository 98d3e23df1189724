"""Recordings in memory: the events of all of them, with their labels, source and sensor."""

from __future__ import annotations

import hashlib
import html
import operator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from deploy.tables import format_count
from pipeline.recordings.cache import release_pages
from pipeline.recordings.events import EVENT_DTYPES, Events, join_events
from pipeline.recordings.formats.recording import UNIT_NAMES
from pipeline.recordings.sensor import (
    Sensor,
    TaxelMap,
    are_digits,
    describe_size,
    is_st_mnist_sensor,
)
from pipeline.recordings.spike_frames import EventTable


@dataclass(frozen=True)
class Source:
    """The source of recordings.

    Attributes
    ----------
    name : str
        File or folder name without its path, or a description of the simulation.
    sha256 : str
        Hash over the content (of the files, or of the simulation's settings and version).
    simulated : bool
        True if the recordings were not made on a real skin.
    written : bool
        True if people wrote all of them on the simulated skin.
    left_out : tuple of str
        The files that could not be read and were left out, each with the reason.
    time_unit : str
        Unit in which the times of files of events were read, such as ``"us"``; empty for other
        files.
    bin_ms : float
        Width of a bin in milliseconds, with which arrays of counts were read; 0 for other files.
    rise : int
        Channel of such arrays that was read as the rise of pressure.
    remarks : tuple of str
        What the user should know about how the files were read.
    warnings : tuple of str
        What may be wrong with them, such as a file that alone decides how large the sensor is.
    """

    name: str
    sha256: str
    simulated: bool
    written: bool = False
    left_out: tuple = ()
    time_unit: str = ""
    bin_ms: float = 0.0
    rise: int = 0
    remarks: tuple = ()
    warnings: tuple = ()


@dataclass(frozen=True, repr=False)
class Recordings:
    """A set of labelled recordings, whose events are in the same four columns.

    Attributes
    ----------
    events : Events
        Events of recording 0, then of recording 1, and so on.
    offsets : ndarray of int64, shape (n_samples + 1,)
        ``events`` of recording i are those from ``offsets[i]`` to ``offsets[i + 1]``.
    labels : ndarray of int64, shape (n_samples,)
        The class, from 0: the digit itself in the published recordings; see ``sensor.classes``.
    ids : tuple of str
        A name for each recording that does not change from import to import, such as
        ``"3/0042"``.
    writers : ndarray of int64, shape (n_samples,)
        The writer, from 0; -1 if it is not known.
    source : Source
        Name, hash and properties of the files that they were read from.
    taxels : TaxelMap
        Row and column of each taxel, and its position if it is known.
    sensor : Sensor
        Rows, columns, polarities, longest duration and names of the classes.
    parts : tuple of str
        ``"train"`` or ``"test"`` for each recording of a source with a published split; otherwise
        all are empty.
    """

    events: Events
    offsets: np.ndarray
    labels: np.ndarray
    ids: tuple
    writers: np.ndarray
    source: Source
    taxels: TaxelMap = field(default_factory=TaxelMap)
    sensor: Sensor = field(default_factory=Sensor)
    parts: tuple = ()

    def __post_init__(self):
        if not self.parts:
            object.__setattr__(self, "parts", ("",) * len(self.labels))

    @classmethod
    def read(cls, path, **reading) -> Recordings:
        """Read the recordings of a zip or folder, as ``--data`` does.

        Parameters
        ----------
        path : path-like
        **reading
            Properties of the files that you state: ``time_unit``, ``rows``, ``columns``,
            ``downsample``, ``bin_ms`` and ``rise``, as in
            :class:`pipeline.recordings.interpretation.options.ReadingOptions`.

        Raises
        ------
        UserError
            They cannot be read.
        """
        from pipeline.recordings.arrays import read_recordings  # imports this module

        return read_recordings(path, **reading)

    @classmethod
    def from_arrays(  # noqa: PLR0913 - a public function, whose callers name all but the first two
        cls,
        events,
        labels=None,
        rows=0,
        columns=0,
        *,
        classes=None,
        time_unit="",
        writers=None,
        simulated=False,
        parts=None,
        name="arrays",
    ) -> Recordings:
        """Make recordings of events in memory, in the order in which they are given.

        Parameters
        ----------
        events : iterable
            Events of each recording: arrays x, y, t, p, a dict of them, a structured array, or an
            array of shape (n, 4).  ``x`` is the column from the left, ``y`` the row from the top.
        labels : iterable, optional
            Class of each recording: a number from 0, or a name; default: not known.
        rows, columns : int
            Size of the sensor; default: that of the events' places.
        classes : sequence of str, optional
            Names of the labels 0, 1, ...; default: the labels themselves.
        time_unit : str
            Unit of the times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; empty: guessed from the
            durations, and printed.
        writers : sequence of int, optional
            Number of the person who made each recording, from 0.
        simulated : bool
            True if the recordings are simulated; every result repeats this.
        parts : sequence of str, optional
            ``"train"`` or ``"test"`` for each recording, of a data set with a published split.
        name : str
            What messages and reports call the recordings.

        Raises
        ------
        UserError
            Events or labels are not valid, with a line for each reason; or there are none.
        """
        from pipeline.recordings.arrays import make_recordings  # imports this module

        details = {
            "classes": classes,
            "time_unit": time_unit,
            "writers": writers,
            "simulated": simulated,
            "parts": parts,
        }
        return make_recordings(events, labels, (rows, columns), name, details)

    def write(self, path):
        """Write the recordings as a zip that every command accepts.

        Parameters
        ----------
        path : path-like
            The zip; its name must end in ``.zip``.
        """
        from pipeline.recordings.arrays import write_npz_zip  # imports this module

        return write_npz_zip(self, path)

    def __repr__(self):
        return f"{len(self)} recordings of {self.source.name}, on {self.sensor}"

    def _repr_html_(self):
        counts = np.bincount(self.labels[self.labels >= 0], minlength=len(self.sensor.classes))
        names = "".join(f"<th>{html.escape(name)}</th>" for name in self.sensor.classes)
        numbers = "".join(f"<td>{count}</td>" for count in counts)
        title = html.escape(repr(self))
        return f"<p>{title}</p><table><tr>{names}</tr><tr>{numbers}</tr></table>"

    def __len__(self):
        return len(self.labels)

    def __getitem__(self, index: int) -> Events:
        if isinstance(index, slice):
            raise TypeError("recordings have no slices; subset(indices) has some of them")
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"no recording {index}; there are {len(self)}")
        index %= len(self)
        span = slice(self.offsets[index], self.offsets[index + 1])
        return Events(*(getattr(self.events, name)[span] for name in EVENT_DTYPES))

    def subset(self, indices) -> Recordings:
        """Some of the recordings, in the order of their indices."""
        indices = np.asarray(indices, int)
        counts = np.diff(self.offsets)[indices]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        event = np.arange(offsets[-1]) + np.repeat(self.offsets[indices] - offsets[:-1], counts)
        return replace(
            self,
            events=Events(*(getattr(self.events, name)[event] for name in EVENT_DTYPES)),
            offsets=offsets,
            labels=self.labels[indices],
            ids=tuple(self.ids[index] for index in indices),
            writers=self.writers[indices],
            parts=tuple(self.parts[index] for index in indices),
        )

    @property
    def classes(self) -> tuple:
        """Names of the classes 0, 1, ..., those of the sensor."""
        return self.sensor.classes

    @property
    def is_split(self) -> bool:
        """True if the source has a published split."""
        return any(self.parts)

    @cached_property
    def table(self) -> EventTable:
        """The physical events in the form that networks are trained on, made once."""
        return EventTable.from_recordings(self)

    @cached_property
    def hashes(self) -> tuple:
        """A hash of the events of each recording, to recognise it in another source.

        Times are relative to the first event, and taxels are given by their places, so that the
        hash depends neither on the format of the file nor on the other recordings.

        Returns
        -------
        tuple of str
            16 hexadecimal digits for each recording.
        """
        events = self.events
        taxels = self.taxels
        hashes = []
        for start, end in zip(self.offsets[:-1], self.offsets[1:], strict=True):
            time = events.time_ns[start:end]
            taxel = events.taxel[start:end]
            content = np.empty((4, end - start), "<i8")
            content[0] = time - time[:1]
            content[1] = taxels.row[taxel]
            content[2] = taxels.column[taxel]
            content[3] = events.polarity[start:end]
            order = np.lexsort(content[::-1])  # events at the same time have no order
            hashes.append(hashlib.sha256(content[:, order].tobytes()).hexdigest()[:16])
        for name in EVENT_DTYPES:
            release_pages(getattr(events, name))
        return tuple(hashes)

    @property
    def sample_of_event(self) -> np.ndarray:
        """Index of the recording each event belongs to, shape (n_events,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))


def join_recordings(  # noqa: PLR0913 - the columns of a table of recordings
    samples, labels, ids, writers, source, taxels=None, sensor=None, parts=()
) -> Recordings:
    """Join the events of single recordings.

    Parameters
    ----------
    samples : sequence of Events
    labels, ids, writers : sequences
        One entry per recording.
    source : Source
    taxels : TaxelMap, optional
    sensor : Sensor, optional
    parts : sequence of str, optional
        Part of the published split of each recording.
    """
    return Recordings(
        events=join_events(samples),
        offsets=np.concatenate([[0], np.cumsum([len(each) for each in samples])]).astype(np.int64),
        labels=np.asarray(labels, np.int64),
        ids=tuple(ids),
        writers=np.asarray(writers, np.int64),
        source=source,
        taxels=taxels or TaxelMap(),
        sensor=sensor or Sensor(),
        parts=tuple(parts),
    )


def is_handwriting(recordings: Recordings) -> bool:
    """True for handwriting on the skin.

    This is what people wrote on the simulated skin, and digits that were simulated or are in
    ST-MNIST's format on its array.
    """
    source = recordings.source
    sensor = recordings.sensor
    is_simulated = source.simulated and are_digits(sensor.classes)
    is_numbered = not source.time_unit and not source.bin_ms
    is_st_mnist = is_st_mnist_sensor(sensor.rows, sensor.columns, sensor.classes) and is_numbered
    return bool(source.written or is_simulated or is_st_mnist)


def list_facts(recordings: Recordings) -> dict:
    """The source, the sensor and the number of recordings of each class, as plain values."""
    source = recordings.source
    sensor = recordings.sensor
    counts = np.bincount(recordings.labels, minlength=len(sensor.classes)).tolist()
    return {
        "source": source.name,
        "sha256": source.sha256,
        "simulated": source.simulated,
        "written": source.written,
        "samples": len(recordings),
        "files_left_out": len(source.left_out),
        "samples_per_class": dict(zip(sensor.classes, counts, strict=True)),
        "sensor": {
            "rows": sensor.rows,
            "columns": sensor.columns,
            "taxels": len(recordings.taxels),
            "polarities": sensor.polarities,
            "duration_s": sensor.duration_s,
        },
    }


def describe_recordings(recordings: Recordings) -> str:
    """Summary of a source in one line: numbers, sizes, durations, unit of times, polarities."""
    time_ns = recordings.events.time_ns
    offsets = recordings.offsets
    sensor = recordings.sensor
    has_events = np.diff(offsets) > 0
    durations_s = (time_ns[offsets[1:][has_events] - 1] - time_ns[offsets[:-1][has_events]]) * 1e-9
    durations_s = durations_s if has_events.any() else np.zeros(1)
    parts = [
        f"{len(recordings)} recordings",
        describe_size(sensor),
        format_count(len(sensor.classes), "class", "classes"),
        " to ".join(
            dict.fromkeys(f"{limit:.2g}" for limit in (durations_s.min(), durations_s.max()))
        )
        + " s",
    ]
    if recordings.source.time_unit:
        parts.append(f"times read as {UNIT_NAMES[recordings.source.time_unit]}")
    if sensor.polarities == 1:
        parts.append("ON events only")
    if recordings.source.bin_ms:
        parts.append(f"bins of {recordings.source.bin_ms:g} ms")
    return ", ".join(parts)
