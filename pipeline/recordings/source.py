"""A source of recordings: a zip or folder with a sub-folder for each class.

::

    LUT.mat, taxels.csv           places or positions of the taxels, optional
    train/, test/                 the parts of a published split, optional
        <class>/<recording>       all with one suffix

or the class is in the name of each file, ``<name>_label_<class>.npy``, without folders of classes.

There may be any number of folders around everything, as ``data_submission`` in ST-MNIST's archive.
Hidden files, ``README*``, ``LICENSE*``, ``*.txt`` and ``*.md`` are ignored, unless all files are
``*.txt``, which then are the recordings; anything else is refused by name.  A zip is read without
being unpacked to disk.
"""

import functools
import hashlib
import json
import lzma
import os
import re
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

from joblib import delayed

from deploy.errors import SeveralErrors, UserError
from deploy.files import hash_file, open_regular
from deploy.tables import list_names
from deploy.terminal import WARNING, escape_control
from pipeline.jobs import call_in_processes
from pipeline.progress import ignore_progress
from pipeline.recordings import sensor
from pipeline.recordings.events import Recordings, Source, collect
from pipeline.recordings.formats import READERS, read_file
from pipeline.recordings.formats.camera import CONVERT_OLD, OLD_SUFFIX
from pipeline.recordings.formats.column_order import ORDERS, settle_orders
from pipeline.recordings.formats.mat import read_lookup_table
from pipeline.recordings.formats.recording import MAX_FILE_BYTES, BadRecording, read_limited
from pipeline.recordings.taxels import read_positions

LOOKUP_TABLE = "lut.mat"
POSITIONS = "taxels.csv"
IGNORED = ("readme*", "license*", "*.md")
# Recordings if there are no others, and ignored otherwise.
TEXT_SUFFIX = ".txt"
# Part of a published split, by the name of a folder in lower case.
PART_OF_FOLDER = {"train": "train", "training": "train", "test": "test", "testing": "test"}

# What stands before the class in the name of a file.
LABEL_MARK = "_label_"

VALIDATION = ("validation", "valid", "val", "dev")

# Events of a source: 100,000 recordings of 600. To read a million events takes up to 75 MB, once:
# then they are in the cache.
MAX_SOURCE_EVENTS = 60_000_000

# Recordings of a source.
MAX_FILES = 100_000

# Number of files that a worker reads at a time: a compromise of overhead and progress bar.
FILES_PER_JOB = 32

# Number of reasons, and of files that were left out, that are listed individually.
MAX_LISTED = 10

ALL_OFF = (
    "all events are OFF, since their polarity is 0 or -1; write 1 if the sensor does not tell ON "
    "and OFF apart, and name the columns if another column is the polarity"
)

# Number of files that are named in one line.
MAX_NAMED = 3

# Errors that reading a member of a damaged zip raises.
READ_ERRORS = (
    *(OSError, EOFError, RuntimeError, ValueError, KeyError, zipfile.BadZipFile),
    *(zlib.error, lzma.LZMAError),
)


@dataclass(frozen=True)
class Entry:
    """A file with a recording.

    Attributes
    ----------
    member : str
        Its path in the source.
    part : str
        ``"train"`` or ``"test"`` in a source with a published split, otherwise empty.
    of_class : str
        Name of its class.
    """

    member: str
    part: str
    of_class: str

    @property
    def id(self) -> str:
        """The recording's id: part, class and name without suffix and label."""
        stem = PurePosixPath(self.member).stem
        name = stem.rpartition(LABEL_MARK)[0] or stem
        return str(PurePosixPath(self.part, self.of_class, name))


@dataclass(frozen=True)
class Listing:
    """The files of a source.

    Attributes
    ----------
    path : Path
    entries : tuple of Entry
        In order of part, class and path.
    lookup_table, positions : str or None
        Member paths of ``LUT.mat`` and ``taxels.csv``.
    refused : tuple of (str, str)
        Path and reason of each file or folder that does not belong to a source.
    """

    path: Path
    entries: tuple
    lookup_table: str | None
    positions: str | None
    refused: tuple

    @property
    def total(self) -> int:
        """Number of files and folders, recordings or not."""
        return len(self.entries) + len(self.refused)

    @property
    def files(self) -> list:
        """Member paths of all files that are read."""
        tables = [name for name in (self.lookup_table, self.positions) if name]
        return tables + [entry.member for entry in self.entries]


def list_source(path, labelled: bool = True) -> Listing:
    """Find the recordings in a zip or folder.

    Parameters
    ----------
    path : path-like
    labelled : bool
        False if recordings need not be in folders of classes, so that a class may have an empty
        name; the path may be that of one recording then.

    Raises
    ------
    UserError
        The source does not exist, is not a zip or a damaged zip, or has no recordings, recordings
        of several formats or a folder of validation samples.
    """
    path = Path(path)
    if not labelled and path.suffix.lower() in READERS and path.is_file():
        return _list_file(path)
    files, folders, refused = _list_members(path)
    members, tables = _sort_files(path, files)
    recordings, others = _choose_format(path, members)
    refused += others
    class_folders = _find_class_folders(path, recordings)
    entries = []
    for member in recordings:
        part, of_class, problem = _find_part_and_class(member, class_folders, labelled)
        if problem:
            refused.append((str(member), problem))
        else:
            entries.append(Entry(str(member), part, of_class))
    if not entries:
        raise UserError(f"{path}: {_shorten(refused[-1][0])} {refused[-1][1]}")
    refused += _find_empty_classes(entries, folders)
    entries.sort(key=lambda e: (e.part != "train", sensor.make_sort_key(e.of_class), e.member))
    lookup_table, positions = tables
    return Listing(path, tuple(entries), lookup_table, positions, tuple(sorted(refused)))


def _list_file(path):
    """The listing of one recording, with the tables beside it."""
    beside = {entry.name.lower(): entry.name for entry in path.parent.iterdir() if entry.is_file()}
    tables = [beside.get(name) for name in (LOOKUP_TABLE, POSITIONS)]
    return Listing(path.parent, (Entry(path.name, "", ""),), *tables, ())


def _sort_files(path, files):
    """Paths of the files that are not ignored, and those of ``LUT.mat`` and ``taxels.csv``."""
    tables = {LOOKUP_TABLE: [], POSITIONS: []}
    members = []
    for name in files:
        member = PurePosixPath(name)
        if not _is_ignored(member):
            tables.get(member.name.lower(), members).append(member)
    if any(member.suffix.lower() != TEXT_SUFFIX for member in members):
        members = [member for member in members if member.suffix.lower() != TEXT_SUFFIX]
    for name, several in tables.items():
        if len(several) > 1:
            listed = " and ".join(_shorten(member) for member in several[:2])
            raise UserError(f"{path}: has several files {name}: {listed}; keep one")
    return members, [str(found[0]) if found else None for found in tables.values()]


def _choose_format(path, members):
    """The recordings, which have one suffix, and the other files, each with the reason."""
    examples = {member.suffix.lower(): member for member in reversed(members)}
    examples = {suffix: examples[suffix] for suffix in READERS if suffix in examples}
    if not examples:
        archives = [_shorten(m) for m in members if m.suffix.lower() == ".zip"]
        if archives:
            raise UserError(
                f"{path}: holds no recordings, but archives; give one of them: "
                f"--data {path / archives[0]}"
            )
        if any(member.suffix.lower() == OLD_SUFFIX for member in members):
            raise UserError(f"{path}: holds no recordings that can be read; {CONVERT_OLD}")
        raise UserError(
            f"{path}: holds no recordings; expected a folder for each class with .mat, .npz or "
            "other files of events, <digit>/*.mat in the ST-MNIST archive"
        )
    if len(examples) > 1:
        raise UserError(
            f"{path}: holds both {' and '.join(examples)} files, such as "
            f"{' and '.join(map(_shorten, examples.values()))}; keep one format"
        )
    (suffix,) = examples
    recordings = [member for member in members if member.suffix.lower() == suffix]
    if len(recordings) > MAX_FILES:
        raise UserError(
            f"{path}: holds {len(recordings):,} recordings, more than {MAX_FILES:,}; give a part "
            "of it"
        )
    others = [
        (str(member), f"is not a recording (the others are {suffix} files); move it away")
        for member in members
        if member.suffix.lower() != suffix
    ]
    return recordings, others


@dataclass(frozen=True)
class _ClassFolders:
    """Where the classes of a source are.

    Attributes
    ----------
    around : PurePosixPath
        The folder that contains train and test, or the folders of the classes.
    is_published : bool
        True if it contains train and test.
    has_numbers : bool
        True if most labels in names of files are whole numbers.
    """

    around: PurePosixPath
    is_published: bool
    has_numbers: bool


def _find_class_folders(path, recordings):
    _require_one_data_set(path, recordings)
    around = _find_folders_around(recordings)
    inside = [m.relative_to(around) for m in recordings if m.is_relative_to(around)]
    tops = {m.parts[0] for m in inside if len(m.parts) > 1}
    is_published = _are_part_folders(inside)
    if is_published and (extra := [top for top in tops if top.lower() in VALIDATION]):
        raise UserError(
            f"{path}: has a folder {extra[0]!r} beside train and test; move its recordings to "
            "train, from which validation samples are drawn, or move it away"
        )
    labels = [label for label in map(_read_label, recordings) if label is not None]
    number = sum(label.isdecimal() for label in labels)
    return _ClassFolders(around, is_published, 2 * number > len(labels))


def _read_label(member):
    """The class in a file's name, ``..._label_<class>``; None if there is none."""
    _, mark, label = member.stem.rpartition(LABEL_MARK)
    return label if mark else None


def _are_part_folders(members):
    """True if train and test are the top folders, and the classes are below or in the names."""
    tops = {
        PART_OF_FOLDER.get(member.parts[0].lower())
        for member in members
        if len(member.parts) > (2 if _read_label(member) is None else 1)
    }
    return len(tops - {None}) == 2


def _require_one_data_set(path, recordings):
    """Refuse a folder with several data sets, each with train and test."""
    parts = {}
    for member in recordings:
        folders = member.parts[:-1]
        depth = next((i for i, name in enumerate(folders) if name.lower() in PART_OF_FOLDER), None)
        if depth is not None:
            found = parts.setdefault(PurePosixPath(*folders[:depth]), set())
            found.add(PART_OF_FOLDER[folders[depth].lower()])
    roots = sorted(map(str, parts))
    if len(roots) > 1 and any(len(found) == 2 for found in parts.values()):
        is_folder = path.is_dir()
        remedy = f"give one of them: --data {path / roots[0]}" if is_folder else "give one of them"
        raise UserError(
            f"{path}: has several data sets with train or test: "
            f"{list_names(map(_shorten, roots))}; {remedy}"
        )


def _list_members(path):
    """Paths of all files and folders of a source, and files refused with the reason."""
    if path.is_dir():
        return _list_members_of_folder(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; give a zip or a folder of recordings")
    if path.suffix.lower() == OLD_SUFFIX:
        raise UserError(f"{path}: cannot be read; {CONVERT_OLD}")
    if path.suffix.lower() in READERS:
        raise UserError(
            f"{path}: is one recording; give the zip or folder of all of them "
            "('stmnist predict' takes one)"
        )
    try:
        with open_regular(path) as file, _open_archive(file) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, EOFError, NotImplementedError, ValueError) as error:
        raise UserError(
            f"{path}: not a zip archive, or cut short ({error}); download it again"
        ) from error
    return _list_members_of_archive(members)


def _list_members_of_folder(path):
    """As :func:`_list_members`, of a folder."""
    files = []
    folders = []
    refused = []
    for root, below, names in os.walk(path, followlinks=True):
        around = Path(root)
        above = {os.path.realpath(folder) for folder in (around, *around.parents)}
        # Links in a circle end.
        below[:] = [name for name in below if os.path.realpath(around / name) not in above]
        for name in sorted([*below, *names]):
            entry = around / name
            member = entry.relative_to(path).as_posix()
            if entry.is_file():
                files.append(member)
            elif entry.is_dir():
                folders.append(member)
            elif not _is_ignored(PurePosixPath(member)):
                refused.append((member, "is not a regular file; move it away"))
    return sorted(files), folders, refused


def _list_members_of_archive(members):
    """As :func:`_list_members`, of the entries of a zip."""
    files = []
    seen = set()
    refused = []
    for info in members:
        name = info.filename
        if info.is_dir():
            continue
        if name in seen or PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            reason = "is in the archive twice" if name in seen else "has a path out of the archive"
            refused.append((name, reason))
        else:
            files.append(name)
            seen.add(name)
    around = {parent for name in files for parent in PurePosixPath(name).parents}
    folders = {PurePosixPath(info.filename) for info in members if info.is_dir()}
    return files, sorted(map(str, (around | folders) - {PurePosixPath(".")})), refused


def _is_ignored(member):
    if any(name.startswith(".") or name == "__MACOSX" for name in member.parts):
        return True
    return any(fnmatch(member.name.lower(), pattern) for pattern in IGNORED)


def _find_folders_around(recordings) -> PurePosixPath:
    """The folders around most recordings, inside of which are the folders of the classes."""
    parents = {member.parent for member in recordings}
    if len(parents) == 1 and None not in map(_read_label, recordings):
        return parents.pop()
    around = PurePosixPath()
    while True:
        inside = [m.relative_to(around) for m in recordings if m.is_relative_to(around)]
        tops = Counter(member.parts[0] for member in inside if len(member.parts) > 2)
        if _are_part_folders(inside) or not tops:
            return around
        top, number = tops.most_common(1)[0]
        if 2 * number <= len(recordings):
            return around
        around /= top


def _find_part_and_class(member, class_folders, labelled=True):
    """Part of the split, class, and an empty text; or two empty texts and what is wrong."""
    if not member.is_relative_to(class_folders.around):
        return "", "", f"is not in {class_folders.around}, as the others are; move it"
    folders = member.relative_to(class_folders.around).parts[:-1]
    part = ""
    if class_folders.is_published:
        part = PART_OF_FOLDER.get(folders[0].lower() if folders else "")
        if part is None:
            return "", "", "is neither in train nor in test, as the others are; move it away"
        folders = folders[1:]
    if len(folders) > 1:
        return "", "", "is in a folder inside that of a class; move it"
    label = _read_label(member)
    if label is not None and (problem := _examine_label(label, folders, class_folders)):
        return "", "", problem
    if not folders and label is None:
        problem = "is not in a folder of a class; give the folder above, or make a folder for it"
        return part, "", problem if labelled else ""
    return part, (folders[0] if folders else label), ""


def _examine_label(label, folders, class_folders):
    """The reason to refuse a label in a file's name; empty if it is a class."""
    if not label.strip() or (class_folders.has_numbers and not label.isdecimal()):
        return f"has the label {label!r} in its name, which is no class; correct the name"
    if not folders or label == folders[0]:
        return ""
    if label.isdecimal() and folders[0].isdecimal() and int(label) == int(folders[0]):
        return ""
    return (
        f"is in the folder of class {folders[0]!r}, and has the label {label!r} in its name; move "
        "it or correct the name"
    )


def _find_empty_classes(entries, folders):
    """Folders beside those of the classes that have no recording."""
    parents = {PurePosixPath(entry.member).parent for entry in entries}
    classes = {
        folder for folder in parents if folder.name.lower() not in PART_OF_FOLDER and folder.name
    }
    beside = {folder.parent for folder in classes}
    return [
        (str(folder), "is a class without a recording; remove the folder")
        for folder in map(PurePosixPath, folders)
        if folder.parent in beside and folder not in classes and not _is_ignored(folder)
    ]


def read_source(
    path, jobs: int = 2, skip_bad: bool = False, progress=ignore_progress, reading=sensor.AS_FOUND
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
    reading : pipeline.recordings.sensor.ReadingOptions
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
    entries, read, bad = _read_entries(listing, jobs, progress)
    refused = [*listing.refused, *bad]
    lookup, positions = _read_tables(listing)
    if not read:
        raise SeveralErrors(_describe_refusals(path, refused, listing.total, False))
    parts = [entry.part for entry in entries]
    read, order = _settle_orders(path, read)
    interpretation = sensor.interpret(path, read, parts, lookup, positions, reading)
    refused += [(entries[index].member, why) for index, why in interpretation.refused.items()]
    warnings = _describe_doubts(interpretation, [entry.member for entry in entries])
    if refused and not skip_bad:
        raise SeveralErrors(_describe_refusals(path, refused, listing.total))
    entries = [entries[index] for index in interpretation.kept]
    read = [read[index] for index in interpretation.kept]
    classes = {entry.of_class for entry in entries}
    unread = reading.labelled and sorted({entry.of_class for entry in listing.entries} - classes)
    if unread:
        name = escape_control(unread[0])
        head = f"{path}: no recording of {name!r} can be read; correct or remove them"
        raise SeveralErrors([head, *_describe_refusals(path, refused, listing.total, False)])
    the_sensor = interpretation.make_sensor(classes)
    ids = [entry.id for entry in entries]
    left_out = tuple(f"{_shorten(name)}: {reason}" for name, reason in refused)
    source = _describe_source(listing, read, interpretation, left_out, order)
    return collect(
        samples=interpretation.events,
        labels=[the_sensor.classes.index(entry.of_class) for entry in entries],
        ids=ids if len(set(ids)) == len(ids) else [entry.member for entry in entries],
        writers=[recording.writer for recording in read],
        source=replace(source, warnings=warnings),
        taxels=interpretation.taxels,
        sensor=the_sensor,
        parts=[entry.part for entry in entries],
    )


def _read_entries(listing, jobs, progress):
    """Read the files of a listing.

    Returns
    -------
    entries : list
        Those that can be read.
    read : list of EventRecording
        Their recordings.
    bad : list of (str, str)
        The other files, each with the reason.
    """
    entries = []
    read = []
    bad = []
    chunks = [
        listing.entries[i : i + FILES_PER_JOB]
        for i in range(0, len(listing.entries), FILES_PER_JOB)
    ]
    calls = (delayed(_read_files)(listing.path, chunk) for chunk in chunks)
    n_events = 0
    bar = progress("import", len(listing.entries), "recordings")
    with call_in_processes(calls, jobs) as work, bar as advance:
        for chunk, results in zip(chunks, work, strict=True):
            for entry, recording in zip(chunk, results, strict=True):
                if isinstance(recording, str):
                    bad.append((entry.member, recording))
                else:
                    entries.append(entry)
                    read.append(recording)
            n_events += sum(map(_count_events, results))
            _require_few(listing.path, n_events)
            advance(len(chunk))
    return entries, read, bad


def _describe_source(listing, read, found, left_out, order):
    """The source of recordings that were read."""
    return Source(
        name=listing.path.name,
        sha256=hash_content(listing),
        simulated=any(recording.simulated for recording in read),
        written=all(recording.written for recording in read),
        left_out=left_out,
        time_unit=found.time_unit,
        bin_ms=found.bin_ms,
        rise=found.rise,
        remarks=(*_order_remarks(order), *found.remarks),
    )


def _describe_doubts(found, members) -> tuple:
    """Lines on what may be wrong with recordings, with the names of the files."""
    lines = []
    for indices, text in found.doubts:
        names = [members[index] for index in indices]
        have = "alone has" if len(names) == 1 else "alone have"
        lines.append(f"{_list_some(names)} {have} {text}")
    if found.time_unit and all((events.polarity < 0).all() for events in found.events):
        lines.append(ALL_OFF)
    return tuple(lines)


def _list_some(names):
    """The first names, and the number of the others."""
    listed = [_shorten(name) for name in names[:MAX_NAMED]]
    if len(names) > MAX_NAMED:
        listed.append(f"{len(names) - MAX_NAMED} more files")
    return ", ".join(listed)


def _settle_orders(path, read):
    """Recordings with columns in one order, and that order if they have no names."""
    try:
        return settle_orders(read)
    except BadRecording as error:
        raise UserError(f"{path}: {error}") from error


def _order_remarks(order):
    """A line about an order of columns without names that is not the documented one."""
    if order in ("", ORDERS[0]):
        return ()
    return (f"columns without names are read as {', '.join(order)}",)


def _read_tables(listing):
    """The contents of ``LUT.mat`` and ``taxels.csv``, each None without the file."""
    tables = []
    for name, read in (
        (listing.lookup_table, read_lookup_table),
        (listing.positions, read_positions),
    ):
        try:
            tables.append(None if name is None else read(_find_reader(listing.path).read(name)))
        except BadRecording as error:
            raise UserError(f"{listing.path}: {name} {error}; correct or remove it") from error
    return tables


def describe_reading(path, recordings: Recordings) -> list:
    """Messages about how a source was read and which files were left out, a line each.

    Parameters
    ----------
    path : path-like
        Path of the source.
    recordings : Recordings
        From :func:`read_source`.
    """
    left_out = recordings.source.left_out
    lines = [f"{path}: {remark}" for remark in recordings.source.remarks]
    lines += [f"{WARNING}{path}: {text}" for text in recordings.source.warnings]
    lines += [f"{WARNING}{path}: left out {line}" for line in left_out[:MAX_LISTED]]
    if len(left_out) > MAX_LISTED:
        lines.append(f"{WARNING}{path}: left out {len(left_out) - MAX_LISTED} more")
    return lines


def _describe_refusals(path, refused, total, can_skip=True):
    """A line for each reason: number of files, the first ones, and the reason of the first.

    If there are several, a line with the remedy precedes them.
    """
    by_reason = {}
    for name, reason in sorted(refused):
        by_reason.setdefault(re.sub(r"'[^']*'|-?[\d.]+", "*", reason), []).append((name, reason))
    lines = []
    for files in list(by_reason.values())[:MAX_LISTED]:
        name, reason = files[0]
        others = [_shorten(other) for other, _ in files[1:3]]
        if len(files) > 3:
            others.append(f"{len(files) - 3} more")
        also = f" (also {', '.join(others)})" if others else ""
        lines.append(f"{len(files)} of {total} files refused: {_shorten(name)}{also} {reason}")
    if len(by_reason) > MAX_LISTED:
        lines.append(f"and files refused for {len(by_reason) - MAX_LISTED} more reasons")
    remedy = "correct them" + can_skip * (
        ", or leave them out: --set data.skip_bad=true (of 'adapt', 'check run' and 'predict' "
        "--skip-bad)"
    )
    if len(lines) == 1:
        return [f"{path}: {lines[0]}; {remedy}"]
    head = f"{len(refused)} of {total} files refused, for {len(by_reason)} reasons; {remedy}"
    return [f"{path}: {line}" for line in (head, *lines)]


def _shorten(name, longest=120):
    name = escape_control(str(name))
    return name if len(name) <= longest else f"...{name[3 - longest :]}"


# Reading.


def _read_files(path, entries):
    """Read the files of some entries: each recording, or the reason to refuse it."""
    reader = _find_reader(path)
    results = []
    n_events = 0
    for entry in entries:
        try:
            results.append(read_file(reader.read(entry.member), entry.member))
        except BadRecording as error:
            results.append(str(error))
        n_events += _count_events(results[-1])
        _require_few(path, n_events)
    return results


def _count_events(recording):
    """Number of events of a recording; 0 for the reason to refuse one."""
    return 0 if isinstance(recording, str) else len(recording)


def _require_few(path, n_events):
    if n_events > MAX_SOURCE_EVENTS:
        raise UserError(
            f"{path}: holds more than {MAX_SOURCE_EVENTS:,} events in all; give a part of it, such "
            "as fewer recordings of each class"
        )


def _open_archive(file):
    """A zip.  Names without a mark are UTF-8, as ``zip`` writes them, or else of code page 437."""
    try:
        return zipfile.ZipFile(file, metadata_encoding="utf-8")
    except UnicodeDecodeError:
        return zipfile.ZipFile(file)


class _Reader:
    """Content of a source's members."""

    def __init__(self, path: Path):
        if path.is_dir():
            self._open_member = lambda name: open_regular(path / name)
        else:
            self._open_member = _open_archive(open_regular(path)).open

    def read(self, name) -> bytes:
        try:
            with self._open_member(name) as file:
                content = read_limited(file)
        except NotImplementedError as error:
            raise BadRecording(f"has an unsupported compression ({error})") from error
        except READ_ERRORS as error:
            raise BadRecording(f"cannot be read from the source ({error})") from error
        if len(content) > MAX_FILE_BYTES:
            raise BadRecording(f"is larger than {MAX_FILE_BYTES:,} bytes")
        return content


def _find_reader(path: Path) -> _Reader:
    """A reader of the present source, opened once per process, because a zip's list is long."""
    state = path.stat()
    return _open_reader(path, state.st_ino, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _open_reader(path, *_state):
    return _Reader(path)


# Identity.


def hash_content(listing: Listing) -> str:
    """SHA-256 over a source's content: of the zip, or of every file of a folder that is read."""
    if not listing.path.is_dir():
        return hash_file(listing.path)
    hashes = {name: hash_file(listing.path / name) for name in listing.files}
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


def hash_listing(listing: Listing) -> str:
    """A fast substitute for the content hash: names, sizes and modification times."""
    path = listing.path
    files = [path / name for name in listing.files] if path.is_dir() else [path]
    stats = [(str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps(stats).encode()).hexdigest()
