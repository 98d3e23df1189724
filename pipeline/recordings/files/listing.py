"""The files of a source: its recordings and tables, and what does not belong to it."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from deploy.errors import UserError
from deploy.files import hash_file
from pipeline.recordings.files.class_folders import (
    LABEL_MARK,
    PART_OF_FOLDER,
    MisplacedFile,
    find_class_folders,
    find_part_and_class,
)
from pipeline.recordings.files.members import is_ignored, list_members
from pipeline.recordings.files.messages import shorten
from pipeline.recordings.formats import READERS
from pipeline.recordings.formats.camera import CONVERT_OLD, OLD_ENDING
from pipeline.recordings.interpretation.class_order import CLASS_ORDER
from pipeline.recordings.sensor import make_class_sort_key

LOOKUP_TABLE = "lut.mat"
POSITIONS = "taxels.csv"

# Ending of files that are recordings only if the source has no others.
TEXT_ENDING = ".txt"

# Recordings of a source.
MAX_FILES = 100_000


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
        """The recording's id: part, class and name without ending and label."""
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
    class_order : str or None
        Member path of ``classes.txt``, in the folder of the classes' folders.
    refused : tuple of (str, str)
        Path and reason of each file or folder that does not belong to a source.
    is_one_file : bool
        True if the source is one recording; ``path`` is the folder that it is in.
    """

    path: Path
    entries: tuple
    lookup_table: str | None
    positions: str | None
    class_order: str | None
    refused: tuple
    is_one_file: bool = False

    @property
    def name(self) -> str:
        """The name of the zip, folder or file."""
        return self.entries[0].member if self.is_one_file else self.path.name

    @property
    def total(self) -> int:
        """Number of files and folders, recordings or not."""
        return len(self.entries) + len(self.refused)

    @property
    def files(self) -> list:
        """Member paths of all files that are read."""
        tables = (self.lookup_table, self.positions, self.class_order)
        return [name for name in tables if name] + [entry.member for entry in self.entries]


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
        The source does not exist, is a damaged zip or no zip, or has no recordings, recordings of
        several formats or a folder of validation samples.
    """
    path = Path(path)
    if not labelled and path.suffix.lower() in READERS and path.is_file():
        return _list_file(path)
    members = list_members(path)
    candidates, tables = _separate_tables(path, members.files)
    recordings, others = _choose_format(path, candidates, labelled)
    refused = members.refused + others
    class_folders = find_class_folders(path, recordings)
    entries = []
    for member in recordings:
        try:
            part, of_class = find_part_and_class(member, class_folders, labelled)
            entries.append(Entry(str(member), part, of_class))
        except MisplacedFile as error:
            refused.append((str(member), str(error)))
    if not entries:
        raise UserError(f"{path}: {shorten(refused[-1][0])} {refused[-1][1]}")
    refused += _find_empty_classes(entries, members.folders)
    entries.sort(key=lambda e: (e.part != "train", make_class_sort_key(e.of_class), e.member))
    return Listing(
        path,
        tuple(entries),
        lookup_table=tables[LOOKUP_TABLE],
        positions=tables[POSITIONS],
        class_order=_find_class_order(members.files, class_folders),
        refused=tuple(sorted(refused)),
    )


def _list_file(path):
    """The listing of one recording, with the tables in the same folder."""
    files = {entry.name.lower(): entry.name for entry in path.parent.iterdir() if entry.is_file()}
    tables = [files.get(name) for name in (LOOKUP_TABLE, POSITIONS)]
    entries = (Entry(path.name, "", ""),)
    return Listing(path.parent, entries, *tables, None, (), is_one_file=True)


def _separate_tables(path, files):
    """Paths of the files that are not ignored, and those of the tables by their names."""
    tables = {LOOKUP_TABLE: [], POSITIONS: []}
    members = []
    for name in files:
        member = PurePosixPath(name)
        if not is_ignored(member) and member.name.lower() != CLASS_ORDER:
            tables.get(member.name.lower(), members).append(member)
    if any(member.suffix.lower() != TEXT_ENDING for member in members):
        members = [member for member in members if member.suffix.lower() != TEXT_ENDING]
    for name, paths in tables.items():
        if len(paths) > 1:
            listed = " and ".join(map(shorten, paths[:2]))
            raise UserError(f"{path}: has several files {name}: {listed}; keep one")
    return members, {name: str(paths[0]) if paths else None for name, paths in tables.items()}


def _find_class_order(files, class_folders):
    """Path of the file with the order of the classes; None without it."""
    members = map(PurePosixPath, files)
    found = [
        str(member)
        for member in members
        if member.parent == class_folders.around and member.name.lower() == CLASS_ORDER
    ]
    return found[0] if found else None


def _choose_format(path, members, labelled):
    """The recordings, which have one ending, and the other files, each with the reason."""
    examples = {member.suffix.lower(): member for member in reversed(members)}
    examples = {ending: examples[ending] for ending in READERS if ending in examples}
    if not examples:
        archives = [shorten(m) for m in members if m.suffix.lower() == ".zip"]
        if archives:
            raise UserError(
                f"{path}: holds no recordings, but archives; give one of them: "
                f"--data {path / archives[0]}"
            )
        if any(member.suffix.lower() == OLD_ENDING for member in members):
            raise UserError(f"{path}: holds no recordings that can be read; {CONVERT_OLD}")
        folders = "a folder for each class with files" if labelled else "files"
        raise UserError(
            f"{path}: holds no recordings; expected {folders} of events (.mat, .npz and others)"
        )
    if len(examples) > 1:
        raise UserError(
            f"{path}: holds both {' and '.join(examples)} files, such as "
            f"{' and '.join(map(shorten, examples.values()))}; keep one format"
        )
    (ending,) = examples
    recordings = [member for member in members if member.suffix.lower() == ending]
    if len(recordings) > MAX_FILES:
        raise UserError(
            f"{path}: holds {len(recordings):,} recordings, more than {MAX_FILES:,}; give a part "
            "of it"
        )
    others = [
        (str(member), f"is not a recording (the others are {ending} files); move it away")
        for member in members
        if member.suffix.lower() != ending
    ]
    return recordings, others


def _find_empty_classes(entries, folders):
    """Folders without recordings that are in the same folder as those of the classes."""
    parents = {PurePosixPath(entry.member).parent for entry in entries}
    classes = {
        folder for folder in parents if folder.name.lower() not in PART_OF_FOLDER and folder.name
    }
    around = {folder.parent for folder in classes}
    return [
        (str(folder), "is a class without a recording; remove the folder")
        for folder in map(PurePosixPath, folders)
        if folder.parent in around and folder not in classes and not is_ignored(folder)
    ]


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
