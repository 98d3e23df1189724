"""Recordings in the published layout: a zip or folder with a sub-folder for each class.

The published layout is ``data_submission/<digit>/*.mat``; the folders may have any names and be at
any depth; ``LUT.mat`` is optional and may be anywhere.  Recordings of other sensors may be ``.npz``
files of events instead.  The zip is read without being unpacked to disk.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import lzma
import os
import re
import warnings
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from joblib import delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError

from deploy.errors import SeveralErrors, UserError
from deploy.files import open_regular, replacing, sha256_of
from deploy.terminal import WARNING, printable
from pipeline.data import labelled, sensors
from pipeline.data.budget import MOST_BYTES, MOST_FILES, Spent
from pipeline.data.eventfile import SUFFIXES as EVENT_SUFFIXES
from pipeline.data.eventfile import read_events
from pipeline.data.events import DIGITS, Recordings, Source, collect
from pipeline.data.mat5 import LARGEST
from pipeline.data.matfile import (
    BadRecording,
    MatRecording,
    lookup_table_bytes,
    read_limited,
    read_lookup_table,
    read_recording,
    recording_bytes,
)
from pipeline.jobs import results_of

LOOKUP_TABLE = "lut.mat"
SUFFIXES = (".mat", *EVENT_SUFFIXES)
CHUNK = 32
"""Number of files that a worker reads at a time: a compromise of overhead and progress bar."""

NO_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of the members of a zip that this program writes, so that equal files give equal bytes."""

LISTED = 10
"""Number of reasons, and of files that were left out, that are listed individually."""

NAMED = 3
"""Maximum number of refused files that are named in a line."""

LONGEST_NAME = 120
"""Characters of a name in a message."""

LONGEST_PART = 255
"""Characters of the name of a file or folder."""

READ_ERRORS = (
    *(OSError, EOFError, RuntimeError, ValueError, KeyError, zipfile.BadZipFile),
    *(zlib.error, lzma.LZMAError),
)
"""Errors that reading a member of a damaged zip raises."""


@dataclass(frozen=True)
class Listing:
    """The files of a source.

    Attributes
    ----------
    path : Path
    recordings : tuple of (str, str)
        Member path and class of each recording, in order of class and path.
    lookup_table : str or None
        Member path of ``LUT.mat``.
    refused : tuple of (str, str)
        Member path and reason of each file that cannot be a recording.
    parts : dict of str to Part
        The part of the file, for recordings that are parts of a longer file; see
        :mod:`pipeline.data.labelled`.
    noted : tuple of (str, str)
        Folders that are left out with a message, and why.
    """

    path: Path
    recordings: tuple
    lookup_table: str | None
    refused: tuple
    parts: dict = field(default_factory=dict)
    noted: tuple = ()


def list_source(path) -> Listing:
    """Find the recordings in a zip or folder.

    Raises
    ------
    UserError
        The source does not exist, is not a zip or a damaged zip, or has no recordings or recordings
        of both kinds.
    """
    path = Path(path)
    refused, recordings, tables, seen = [], [], [], set()
    files, folders = _everything(path)
    for name, problem in files:
        member = PurePosixPath(name)
        if problem is None and (member.is_absolute() or ".." in member.parts):
            problem = "its path leaves the archive"
        elif problem is None and name in seen:
            problem = "is in the archive twice"
        elif problem is None and max(map(len, member.parts), default=0) > LONGEST_PART:
            problem = f"has a name in its path longer than the {LONGEST_PART} of any folder"
        seen.add(name)
        hidden = member.name.startswith(".") or "__MACOSX" in member.parts
        if hidden or member.suffix.lower() not in SUFFIXES:
            if problem:
                refused.append((name, problem))
            continue
        if problem:
            refused.append((name, problem))
        elif member.name.lower() == LOOKUP_TABLE:
            tables.append(name)
        else:
            recordings.append((name, member.parts[-2] if len(member.parts) >= 2 else ""))
    parts, used, unread = labelled.divided(
        [name for name, _ in recordings], lambda name: _reader(path).read(name)
    )
    whole = [entry for entry in recordings if entry[0] not in used]
    kept, others, main = _of_main_kinds(whole)
    recordings, strays = _of_classes(kept)
    strays += _of_other_kinds(path, others, main)
    known = {*(name for name, _ in recordings + strays + refused), *tables, *used}
    empty, noted = _empty_classes(path, recordings, known, files, folders)
    refused += strays + unread + empty
    recordings += [(name, of_class) for name, (of_class, _) in parts.items()]
    if not recordings and not refused:
        raise UserError(
            f"{path}: holds no recordings; expected a folder for each class with .mat, .npz or "
            "other files of events, <digit>/*.mat in the ST-MNIST archive"
        )
    places = {name: part for name, (_, part) in parts.items()}
    read = sorted({places[name].file if name in places else name for name, _ in recordings})
    kinds = {_suffix(name): name for name in reversed(read)}
    if len(kinds) > 1:
        raise UserError(
            f"{path}: holds both {' and '.join(sorted(kinds))} recordings, such as "
            f"{' and '.join(_short(kinds[kind]) for kind in sorted(kinds))}; keep one kind"
        )
    if len(recordings) > MOST_FILES:
        raise UserError(
            f"{path}: holds {len(recordings):,} recordings, more than {MOST_FILES:,}; give a part "
            "of it"
        )
    _refuse_too_large(path, recordings)
    recordings.sort(key=lambda entry: (sensors.class_order(entry[1]), entry[0]))
    refused += _other_tables(path, sorted(tables))
    table = min(tables, default=None)
    return Listing(path, tuple(recordings), table, tuple(refused), places, tuple(noted))


def _other_tables(path, names):
    """The look-up tables that differ from the first one, each with the reason to refuse it."""
    first, others = None, []
    for name in names if len(names) > 1 else ():
        try:
            table = read_lookup_table(_reader(path).read(name))
        except BadRecording as error:
            if name != names[0]:  # which is read again, and refused, with the recordings
                others.append((name, str(error)))
            continue
        first = first or table
        if not np.array_equal((table.row, table.column), (first.row, first.column)):
            others.append((name, f"is another table than {_short(names[0])}; keep one of them"))
    return others


def _refuse_too_large(path, recordings):
    """Refuse a source of more bytes on the disk than its recordings may have when unpacked."""
    if path.is_dir():
        files = {path / name for name, _ in recordings}
        sizes = [file.stat().st_size for file in files if file.is_file()]
        size = sum(size for size in sizes if size <= LARGEST)  # others are refused unread
    else:
        size = path.stat().st_size
    if size > MOST_BYTES:
        raise UserError(
            f"{path}: is larger than {MOST_BYTES:,} bytes; give a part of it, such as fewer "
            "recordings of each class"
        )


def _suffix(name):
    return PurePosixPath(name).suffix.lower()


def _of_main_kinds(recordings):
    """The files of the main formats, and those of others that may be recordings too.

    Files above the classes are neither: they are taken for tables.  So is a file beside one of the
    main kind with the same name, perhaps with an addition (``3.npz``, ``3_raw.csv``), such as its
    copy in another format.

    Returns
    -------
    kept, others : list of (str, str)
    main : set of PurePosixPath
        The folders of the main kind.
    """
    ranks = [_rank(name) for name, _ in recordings]
    best = min(ranks, default=0)
    of_best = [n for (n, _), rank in zip(recordings, ranks, strict=True) if rank == best]
    main = {PurePosixPath(name).parent for name in of_best}
    copied = {PurePosixPath(name).with_suffix("") for name in of_best}

    def is_copy(name):
        path = PurePosixPath(name).with_suffix("")
        added = re.finditer(r"[-_. ]", path.name)
        stems = [path.name, *(path.name[: match.start()] for match in added)]
        return any(stem and path.with_name(stem) in copied for stem in stems)

    above = {folder for leaf in main for folder in leaf.parents}
    kept, others = [], []
    for entry, rank in zip(recordings, ranks, strict=True):
        around = PurePosixPath(entry[0]).parents
        if rank == best:
            kept.append(entry)
        elif around[0] in main:
            if not is_copy(entry[0]):
                others.append(entry)
        elif around[0] not in above and (main - above).isdisjoint(around):
            others.append(entry)
    return kept, others, main


def _of_other_kinds(path, others, main):
    """Files of other formats in folders of recordings, each with the reason to refuse it.

    The first file of a folder shows whether the folder has recordings or, say, tables; in the
    folders of the main kind there may be both.
    """
    refused, are_recordings = [], {}
    for name, _ in others:
        folder = PurePosixPath(name).parent
        if folder not in are_recordings or folder in main:
            are_recordings[folder] = _is_readable(path, name)
        if are_recordings[folder]:
            refused.append((name, f"is a {_suffix(name)} file, unlike the other recordings"))
    return refused


def _is_readable(path, name):
    try:
        read_file(name, _reader(path).read(name))
    except BadRecording:
        return False
    return True


def _rank(name):
    """0 for the formats of recordings, 2 for the one that any table has, 1 for all others."""
    return {".mat": 0, ".npz": 0, ".csv": 2}.get(_suffix(name), 1)


def _of_classes(recordings):
    """The files in folders of classes, and all others with the reason why they are refused."""
    folders = Counter(PurePosixPath(name).parent for name, _ in recordings)
    above = {folder for leaf in folders for folder in leaf.parents}
    names = Counter(name for _, name in recordings)
    of_digits = set(DIGITS) <= set(names)
    kept, strays = [], []
    for file, name in recordings:
        if of_user := labelled.class_of_user_file(file):
            kept.append((file, of_user))
            continue
        # A single file in a folder beside those of the ten digits is not an eleventh class.
        if of_digits and name not in DIGITS and (names[name] < 2 or not name):
            strays.append((file, "is not in a folder named for a digit, 0 to 9, as the others are"))
        elif not name or PurePosixPath(file).parent in above:
            strays.append((file, "is not in a folder of a class"))
        else:
            kept.append((file, name))
    return kept, strays


def _empty_classes(path, recordings, known, files, folders):
    """Folders next to those of the classes that have no recording, each with the reason.

    Returns
    -------
    empty : list of (str, str)
        Folders without a file.
    with_others : list of (str, str)
        Folders of other files.  Beside the ten digits, a folder of another name is not mentioned.
    """
    names = {name for _, name in recordings}
    around = {PurePosixPath(name).parent.parent for name, _ in recordings}
    with_recordings, with_files = (
        {parent for name in some for parent in PurePosixPath(name).parents}
        for some in (known, [name for name, _ in files])
    )
    empty, with_others = [], []
    for folder in sorted({*map(PurePosixPath, folders), *with_files} - with_recordings):
        if folder.parent not in around or folder.name.startswith((".", "__MACOSX")):
            continue
        if (path / folder).is_symlink():
            empty.append((str(folder), "is a link to a folder, which is not followed"))
        elif folder not in with_files:
            empty.append((str(folder), "is a class without a recording"))
        elif not (set(DIGITS) <= names and folder.name not in DIGITS):
            with_others.append((str(folder), "has files, but no recording"))
    return empty, with_others


def read_source(
    path,
    jobs: int = 2,
    skip_bad: bool = False,
    progress=None,
    reading: sensors.Reading = sensors.AS_FOUND,
) -> Recordings:
    """Read every recording of a zip or folder, in parallel.

    Parameters
    ----------
    path : path-like
    jobs : int
        Processes.
    skip_bad : bool
        True to continue without refused files; they are in ``source.left_out``.
    progress : callable, optional
        ``progress(label, total)``, a context manager that yields ``advance(n)``.
    reading : pipeline.data.sensors.Reading
        Properties that the user has specified.

    Returns
    -------
    Recordings

    Raises
    ------
    UserError
        Rows, columns or the unit of time cannot be determined; or, unless ``skip_bad``, files are
        refused, with a line for each reason.
    """
    listing = list_source(path)
    refused, read = list(listing.refused), []
    parts = {n: replace(part, unit=reading.time_unit) for n, part in listing.parts.items()}
    # The parts of a file are adjacent, so that it is read once.
    entries = sorted(listing.recordings, key=lambda e: parts[e[0]].file if e[0] in parts else "")
    chunks = [entries[start : start + CHUNK] for start in range(0, len(entries), CHUNK)]
    names = [[parts.get(name, name) for name, _ in chunk] for chunk in chunks]
    work = _read_chunks(listing.path, names, jobs)
    spent = Spent()
    with contextlib.closing(work), _shown(progress, "import", len(listing.recordings)) as advance:
        for chunk, results in zip(chunks, work, strict=True):
            for (name, of_class), (result, size) in zip(chunk, results, strict=True):
                spent.add(result, size)
                _refuse_too_much(path, spent)
                if isinstance(result, str):
                    refused.append((name, result))
                else:
                    read.append((name, of_class, result))
            advance(len(chunk))
    if parts:
        place = {name: index for index, (name, _) in enumerate(listing.recordings)}
        read.sort(key=lambda entry: place[entry[0]])
    taxels = None
    if listing.lookup_table is not None:
        try:
            taxels = read_lookup_table(_reader(listing.path).read(listing.lookup_table))
        except BadRecording as error:
            refused.append((listing.lookup_table, str(error)))
    settled = sensors.settle(path, read, taxels, reading)
    refused += settled.refused
    dropped = {name for name, _ in settled.refused}
    read = [recording for name, _, recording in read if name not in dropped]
    problems = [f"{path}: {problem}" for problem in settled.problems]
    if refused and not skip_bad:
        problems += _refusals(path, refused, len(refused) + len(read))
    if problems:
        names = sorted({name for _, name in listing.recordings}, key=sensors.class_order)
        labels = [names.index(name) for _, name in listing.recordings]
        is_own = settled.sensor.classes != DIGITS
        if is_own and labels and (problem := sensors.too_few(labels, names)):
            problems.append(f"{path}: {problem}")
        raise SeveralErrors(problems)
    if not read:
        raise UserError(f"{path}: no recording in it can be read")
    return collect(
        parts=[events for _, events in settled.kept],
        labels=settled.labels,
        ids=_ids([name for name, _ in settled.kept]),
        writers=[recording.writer for recording in read],
        source=Source(
            name=listing.path.name,
            sha256=content_hash(listing.path),
            simulated=any(recording.simulated for recording in read),
            written=all(getattr(recording, "written", None) for recording in read),
            left_out=tuple(
                f"{_short(name)}: {reason}" for name, reason in (*refused, *listing.noted)
            ),
            time_unit=settled.time_unit,
        ),
        taxels=settled.taxels,
        sensor=settled.sensor,
    )


def left_out_lines(path, recordings: Recordings) -> list:
    """Messages about the files that were left out of a source, a line each.

    Parameters
    ----------
    path : path-like
        Path of the source.
    recordings : Recordings
        From :func:`read_source`, now or at an earlier time.
    """
    left_out = recordings.source.left_out
    lines = [f"{WARNING}{path}: left out {line}" for line in left_out[:LISTED]]
    if len(left_out) > LISTED:
        lines.append(f"{WARNING}{path}: left out {len(left_out) - LISTED} more")
    return lines


def refuse_to_replace(path, simulated: bool = False):
    """Refuse an existing file, unless it is a zip that this program has written.

    Parameters
    ----------
    path : path-like
        The file to be written.
    simulated : bool
        True to refuse also a zip whose recordings are not simulated.

    Raises
    ------
    UserError
    """
    path = Path(path)
    if os.path.lexists(path) and not _is_written_here(path, simulated):
        kind = "a zip of simulated recordings" if simulated else "a zip"
        raise UserError(
            f"{path}: exists and is not {kind} that stmnist has written; choose another name, or "
            "move it away"
        )


def _is_written_here(path, simulated):
    """True for a zip of recordings whose members all have the time that :func:`_add` writes."""
    try:
        names = [name for name, _ in list_source(path).recordings]
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            if not names or any(info.date_time != NO_TIME for info in archive.infolist()):
                return False
        return not simulated or all(_is_simulated(path, name) for name in names)
    except (UserError, BadRecording, OSError):
        return False


def _is_simulated(path, name):
    """True for a recording of this program's writers, whom no person's hand moves."""
    recording = read_file(name, _reader(path).read(name))
    return recording.simulated and getattr(recording, "written", None) is None


def write_zip(path, recordings: Recordings, progress=None):
    """Write recordings as a zip in the published layout; equal recordings give equal bytes.

    Parameters
    ----------
    path : path-like
    recordings : Recordings
        Their ids become the names: ``"3/0042"`` is ``data_submission/3/0042.mat``.
    progress : callable, optional
        As in :func:`read_source`.
    """
    root = PurePosixPath("data_submission")
    with (
        replacing(path) as file,
        zipfile.ZipFile(file, "w") as archive,
        _shown(progress, "write", len(recordings)) as advance,
    ):
        _add(archive, root / "LUT.mat", lookup_table_bytes(recordings.taxels))
        for index, name in enumerate(recordings.ids):
            recording = MatRecording(
                recordings[index],
                recordings.source.simulated,
                int(recordings.writers[index]),
                n_taxels=len(recordings.taxels),
            )
            _add(archive, root / f"{name}.mat", recording_bytes(recording))
            advance(1)


def export_zip(path, folder, progress=None) -> int:
    """Write the files of a folder as a zip in the published layout, without changing them.

    Unlike :func:`write_zip` this preserves the other variables of the files.

    Parameters
    ----------
    path : path-like
        The zip; equal files give equal bytes.
    folder : path-like
        A folder or another zip.
    progress : callable, optional
        As in :func:`read_source`.

    Returns
    -------
    int
        Number of recordings.

    Raises
    ------
    UserError
        A file is not a recording, or the zip cannot be written.
    """
    listing = list_source(folder)
    if listing.refused:
        name, reason = listing.refused[0]
        raise UserError(f"{folder}: {name} {reason}; move it away")
    root, reader = PurePosixPath("data_submission"), _Reader(listing.path)
    if listing.parts:
        raise UserError(f"{folder}: its recordings are parts of longer files; use it as it is")
    names = [name for name, _ in listing.recordings]
    with (
        replacing(path) as file,
        zipfile.ZipFile(file, "w") as archive,
        _shown(progress, "export", len(names)) as advance,
    ):
        name = listing.lookup_table
        try:
            # Without a table the taxels of any array are a grid, whose size the reader chooses.
            if name is not None:
                table = read_lookup_table(reader.read(name))
                _add(archive, root / "LUT.mat", lookup_table_bytes(table))
            for name, short in zip(names, _ids(names), strict=True):
                content, suffix = reader.read(name), PurePosixPath(name).suffix
                read_file(name, content)
                _add(archive, root / f"{short.removesuffix(suffix)}{suffix}", content)
                advance(1)
        except BadRecording as error:
            raise UserError(f"{folder}: {name} {error}; move it away") from error
    return len(names)


def content_hash(path) -> str:
    """SHA-256 over a source's content: of the zip, or of every recording of a folder."""
    path = Path(path)
    if not path.is_dir():
        return sha256_of(path, MOST_BYTES)
    files = {
        name: problem or _hash_of_member(path / name)
        for name, problem in _members(path)
        if problem or _is_recording(name)
    }
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


def _hash_of_member(path):
    """The hash of a file, or the size of one that is refused as too large."""
    size = path.stat().st_size
    return f"{size} bytes" if size > LARGEST else sha256_of(path)


def fingerprint(path) -> str:
    """A fast substitute for the content hash: names, sizes and modification times."""
    path = Path(path)
    files = [(path, None)]
    if path.is_dir():
        files = [(path / name, why) for name, why in _members(path) if why or _is_recording(name)]
    stats = [
        (str(f), why) if why else (str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns)
        for f, why in files
    ]
    return hashlib.sha256(json.dumps(stats).encode()).hexdigest()


def _is_recording(name):
    return name.lower().endswith(SUFFIXES)


def _add(archive, name, content):
    # Stored: the MAT file is compressed already.
    archive.writestr(zipfile.ZipInfo(str(name), date_time=NO_TIME), content)


def _shown(progress, label, total):
    return progress(label, total) if progress else contextlib.nullcontext(lambda n: None)


def _ids(names):
    short = [f"{PurePosixPath(n).parts[-2]}/{PurePosixPath(n).stem}" for n in names]
    return short if len(set(short)) == len(short) else [str(PurePosixPath(n)) for n in names]


def _members(path: Path):
    """Paths of all files of a source, each with the reason why it is refused, or None."""
    return _everything(path)[0]


def _everything(path: Path):
    """The files, as in :func:`_members`, and the paths of the folders."""
    if path.is_dir():
        files, folders = [], []
        for entry in sorted(path.rglob("*")):
            name = entry.relative_to(path).as_posix()
            if entry.is_file():
                files.append((name, None))
            elif entry.is_dir():
                folders.append(name)
            elif not entry.name.startswith("."):
                problem = "is a broken link" if entry.is_symlink() else "is not a regular file"
                files.append((name, problem))
        return files, folders
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; give a zip or a folder of recordings")
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, ValueError) as error:
        raise UserError(
            f"{path}: not a zip archive, or cut short ({error}); download it again"
        ) from error
    files = [
        (info.filename, "is encrypted" if info.flag_bits & 1 else None)
        for info in members
        if not info.is_dir()
    ]
    return files, [info.filename for info in members if info.is_dir()]


class _Reader:
    """Content of a source's members."""

    def __init__(self, path: Path):
        self.folder = path if path.is_dir() else None
        self.archive = None if self.folder else zipfile.ZipFile(open_regular(path))

    def read(self, name) -> bytes:
        try:
            if self.folder:
                with open_regular(self.folder / name) as file:
                    return read_limited(file)
            member = self.archive.getinfo(name)
            if member.file_size > LARGEST:
                raise BadRecording(f"declares {member.file_size} bytes, more than {LARGEST}")
            with self.archive.open(member) as file:
                return read_limited(file)
        except BadRecording:
            raise
        except NotImplementedError as error:
            raise BadRecording(f"has an unsupported compression ({error})") from error
        except READ_ERRORS as error:
            raise BadRecording(f"cannot be read from the source ({error})") from error


def _reader(path: Path) -> _Reader:
    """A reader of the present source, opened once per process, because a zip's list is long."""
    state = path.stat()
    return _open_reader(path, state.st_ino, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _open_reader(path, *_state):
    return _Reader(path)


def _read_chunks(path, chunks, jobs):
    """Yield the recordings and reasons of each chunk of names; see :func:`_read_members`."""
    done = 0
    work = results_of((delayed(_read_members)(path, names) for names in chunks), jobs)
    try:
        for results in work:
            yield results
            done += 1
    except TerminatedWorkerError:
        # It is unknown which file was the cause: the remaining ones are read in separate processes.
        for names in chunks[done:]:
            yield _read_carefully(path, names)
    finally:
        with warnings.catch_warnings():
            # The remaining tasks are cancelled if the caller stops.
            warnings.filterwarnings("ignore", message=r"\d+ tasks (which were|have been)")
            work.close()


def _read_carefully(path, names):
    """Run :func:`_read_members` in a process that may crash; bisection finds the file at fault."""
    try:
        return next(results_of([delayed(_read_members)(path, names)], 2))
    except TerminatedWorkerError:
        if len(names) == 1:
            return [("crashes the process that reads it; damaged, or too little memory", 0)]
        half = len(names) // 2
        return _read_carefully(path, names[:half]) + _read_carefully(path, names[half:])


def read_file(name: str, content: bytes):
    """A recording of any sensor: MatRecording, or EventRecording of a file of events.

    Raises
    ------
    BadRecording
    """
    if PurePosixPath(name).suffix.lower() in EVENT_SUFFIXES:
        return read_events(content, name)
    return read_recording(content, n_taxels=None)


def _read_members(path, names):
    """Read some members: each recording, or the reason to refuse it, and its size in bytes.

    Parameters
    ----------
    path : Path
    names : list of str or pipeline.data.labelled.Part

    Raises
    ------
    UserError
        The members exceed the limits of a source.
    """
    reader, results, spent, before = _reader(path), [], Spent(), None
    for name in names:
        content = b""
        try:
            if isinstance(name, labelled.Part):
                if name.file != before:
                    content = reader.read(name.file)
                    whole = read_events(content, name.file, labelled.MOST_EVENTS)
                    before = name.file
                result = name.of(whole)
            else:
                content = reader.read(name)
                result = read_file(name, content)
                if labelled.class_of_user_file(name):
                    result = replace(result, writer=labelled.user_of(name))
        except BadRecording as error:
            result = str(error)
        except MemoryError:
            result = "needs more memory than there is"
        results.append((result, len(content)))
        spent.add(*results[-1])
        _refuse_too_much(path, spent)
    return results


def _refuse_too_much(path, spent):
    if spent.too_much:
        raise UserError(
            f"{path}: holds {spent.too_much}; give a part of it, such as fewer recordings of each "
            "class"
        )


def _refusals(path, refused, total):
    """A line for each kind of reason: number of files, the first ones, and the reason of the first.

    If there are several kinds, a line with the remedy precedes them.
    """
    kinds = {}
    for name, reason in sorted(refused):
        kinds.setdefault(re.sub(r"'[^']*'|-?[\d.]+", "*", reason), []).append((name, reason))
    lines = []
    for files in list(kinds.values())[:LISTED]:
        (name, reason), others = files[0], [_short(other) for other, _ in files[1:NAMED]]
        if len(files) > NAMED:
            others.append(f"{len(files) - NAMED} more")
        also = f" (also {', '.join(others)})" if others else ""
        lines.append(f"{len(files)} of {total} files refused: {_short(name)}{also} {reason}")
    if len(kinds) > LISTED:
        lines.append(f"and files refused for {len(kinds) - LISTED} more reasons")
    remedy = (
        "correct them, or leave them out: --skip-bad of 'stmnist data', 'adapt' and 'check run', "
        "else --set data.skip_bad=true"
    )
    if len(lines) == 1:
        return [f"{path}: {lines[0]}; {remedy}"]
    head = f"{len(refused)} of {total} files refused, for {len(kinds)} reasons; {remedy}"
    return [f"{path}: {line}" for line in (head, *lines)]


def _short(name):
    name = printable(name)
    return name if len(name) <= LONGEST_NAME else f"...{name[3 - LONGEST_NAME :]}"
