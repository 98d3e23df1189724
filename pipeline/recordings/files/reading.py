"""Read the recordings of a zip or folder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from joblib import delayed

from deploy.errors import SeveralErrors, UserError
from deploy.terminal import escape_control
from pipeline.jobs import call_in_processes
from pipeline.progress import ignore_progress
from pipeline.recordings.files.listing import Listing, hash_content, list_source
from pipeline.recordings.files.members import find_reader
from pipeline.recordings.files.messages import describe_doubts, describe_refusals, shorten
from pipeline.recordings.formats import read_file
from pipeline.recordings.formats.column_order import ORDERS, settle_orders
from pipeline.recordings.formats.mat import read_lookup_table
from pipeline.recordings.formats.recording import BadRecording, EventRecording
from pipeline.recordings.interpretation.class_order import order_classes
from pipeline.recordings.interpretation.interpretation import Interpretation
from pipeline.recordings.interpretation.layouts import interpret_recordings
from pipeline.recordings.interpretation.options import AS_FOUND
from pipeline.recordings.interpretation.taxel_tables import read_positions
from pipeline.recordings.recordings import Recordings, Source, join_recordings

# Events of a source: 100,000 recordings of 600. To read a million events takes up to 75 MB, once:
# then they are in the cache.
MAX_SOURCE_EVENTS = 60_000_000

# Number of files that a worker reads at a time: a compromise of overhead and progress bar.
FILES_PER_JOB = 32


@dataclass(frozen=True)
class _ReadFiles:
    """The files of a source after they were read.

    Attributes
    ----------
    entries : list of Entry
        The files with a recording.
    recordings : list of EventRecording
        The recording of each of them.
    refused : list of (str, str)
        Path of each other file, and the reason to refuse it.
    """

    entries: list
    recordings: list
    refused: list

    def without_refused(self, interpretation: Interpretation) -> _ReadFiles:
        """The files without those that an interpretation refuses."""
        reasons = [
            (self.entries[index].member, reason) for index, reason in interpretation.refused.items()
        ]
        return _ReadFiles(
            [self.entries[index] for index in interpretation.kept],
            [self.recordings[index] for index in interpretation.kept],
            self.refused + reasons,
        )


def read_source(
    path, jobs: int = 2, skip_bad: bool = False, progress=ignore_progress, reading=AS_FOUND
) -> Recordings:
    """Read every recording of a zip or folder, in parallel.

    Parameters
    ----------
    path : path-like
    jobs : int
        Number of processes.
    skip_bad : bool
        True to continue without refused files; they are in ``source.left_out``.
    progress : callable, optional
        ``progress(label, total)``, a context manager that yields ``advance(n)``.
    reading : pipeline.recordings.interpretation.options.ReadingOptions
        Properties that the user has specified.

    Returns
    -------
    Recordings

    Raises
    ------
    UserError
        The sensor or the unit of time cannot be determined, or differ between the parts of a
        published split; or files are refused, with a line for each reason, or with ``skip_bad``
        all files of a class.
    """
    listing = list_source(path, reading.labelled)
    files = _read_files(listing, jobs, progress)
    lookup, positions = _read_tables(listing)
    if not files.entries:
        raise SeveralErrors(describe_refusals(path, files.refused, listing.total, can_skip=False))
    files, order = _settle_orders(path, files)
    parts = [entry.part for entry in files.entries]
    interpretation = interpret_recordings(path, files.recordings, parts, lookup, positions, reading)
    warnings = describe_doubts(interpretation, [entry.member for entry in files.entries])
    files = files.without_refused(interpretation)
    if files.refused and not skip_bad:
        raise SeveralErrors(describe_refusals(path, files.refused, listing.total))
    if reading.labelled:
        _require_every_class(path, listing, files)
    names = {entry.of_class for entry in files.entries}
    class_order = _read_table(listing.path, listing.class_order, bytes)
    classes, remark = order_classes(names, class_order)
    remarks = [*_describe_order(order), *interpretation.remarks, *filter(None, [remark])]
    source = _make_source(listing, files, interpretation, tuple(remarks))
    source = replace(source, warnings=warnings)
    return _collect_recordings(files, interpretation, classes, source)


def _read_files(listing, jobs, progress):
    """Read the files of a listing in parallel; see :class:`_ReadFiles`."""
    files = _ReadFiles([], [], list(listing.refused))
    chunks = [
        listing.entries[i : i + FILES_PER_JOB]
        for i in range(0, len(listing.entries), FILES_PER_JOB)
    ]
    calls = (delayed(_read_chunk)(listing.path, chunk) for chunk in chunks)
    n_events = 0
    bar = progress("import", len(listing.entries), "recordings")
    with call_in_processes(calls, jobs) as work, bar as advance:
        for chunk, results in zip(chunks, work, strict=True):
            for entry, result in zip(chunk, results, strict=True):
                if isinstance(result, EventRecording):
                    files.entries.append(entry)
                    files.recordings.append(result)
                else:
                    files.refused.append((entry.member, result))
            n_events += sum(map(_count_events, results))
            _require_few_events(listing.path, n_events)
            advance(len(chunk))
    return files


def _read_chunk(path, entries):
    """Read several files of a source: each recording, or the reason to refuse it."""
    reader = find_reader(path)
    results: list[EventRecording | str] = []
    n_events = 0
    for entry in entries:
        try:
            results.append(read_file(reader.read(entry.member), entry.member))
        except BadRecording as error:
            results.append(str(error))
        n_events += _count_events(results[-1])
        _require_few_events(path, n_events)
    return results


def _count_events(result):
    """Number of events of a recording; 0 for the reason to refuse one."""
    return len(result) if isinstance(result, EventRecording) else 0


def _require_few_events(path, n_events):
    """Refuse a source with more events than one may have."""
    if n_events > MAX_SOURCE_EVENTS:
        raise UserError(
            f"{path}: holds more than {MAX_SOURCE_EVENTS:,} events in all; give a part of it, such "
            "as fewer recordings of each class"
        )


def _read_tables(listing):
    """The contents of ``LUT.mat`` and ``taxels.csv``, each None without the file."""
    return (
        _read_table(listing.path, listing.lookup_table, read_lookup_table),
        _read_table(listing.path, listing.positions, read_positions),
    )


def _read_table(path: Path, member: str | None, read_content):
    """The content of a table of a source; None without the file."""
    if member is None:
        return None
    try:
        return read_content(find_reader(path).read(member))
    except BadRecording as error:
        raise UserError(f"{path}: {member} {error}; correct or remove it") from error


def _settle_orders(path, files):
    """The files with columns in one order, and that order if they have no names."""
    try:
        recordings, order = settle_orders(files.recordings)
    except BadRecording as error:
        raise UserError(f"{path}: {error}") from error
    return replace(files, recordings=recordings), order


def _require_every_class(path, listing, files):
    """Refuse a source that has a class none of whose recordings can be read."""
    classes = {entry.of_class for entry in files.entries}
    unread = sorted({entry.of_class for entry in listing.entries} - classes)
    if unread:
        name = escape_control(unread[0])
        head = f"{path}: no recording of {name!r} can be read; correct or remove them"
        lines = describe_refusals(path, files.refused, listing.total, can_skip=False)
        raise SeveralErrors([head, *lines])


def _describe_order(order) -> list:
    """A line on the order of columns without names, unless it is the usual one."""
    if order in ("", ORDERS[0]):
        return []
    return [f"columns without names are read as {', '.join(order)}"]


def _make_source(listing: Listing, files, interpretation: Interpretation, remarks: tuple):
    """The source of recordings that were read."""
    return Source(
        name=listing.name,
        sha256=hash_content(listing),
        simulated=any(recording.simulated for recording in files.recordings),
        written=all(recording.written for recording in files.recordings),
        left_out=tuple(f"{shorten(member)}: {reason}" for member, reason in files.refused),
        time_unit=interpretation.time_unit,
        bin_ms=interpretation.bin_ms,
        rise=interpretation.rise,
        remarks=remarks,
    )


def _collect_recordings(files, interpretation: Interpretation, classes: tuple, source: Source):
    """The recordings of all files, with their labels and the sensor."""
    entries = files.entries
    sensor = interpretation.make_sensor(classes)
    ids = [entry.id for entry in entries]
    return join_recordings(
        samples=interpretation.events,
        labels=[sensor.classes.index(entry.of_class) for entry in entries],
        ids=ids if len(set(ids)) == len(ids) else [entry.member for entry in entries],
        writers=[recording.writer for recording in files.recordings],
        source=source,
        taxels=interpretation.taxels,
        sensor=sensor,
        parts=[entry.part for entry in entries],
    )
