"""The members of a zip or folder: their paths, and the content of each."""

import functools
import lzma
import os
import zipfile
import zlib
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

from deploy.errors import UserError
from deploy.files import open_regular
from pipeline.recordings.formats import READERS
from pipeline.recordings.formats.camera import CONVERT_OLD, OLD_ENDING
from pipeline.recordings.formats.recording import MAX_FILE_BYTES, BadRecording, read_limited

# Names of files that are ignored, in lower case.
IGNORED = ("readme*", "license*", "*.md")

# Errors that reading a member of a damaged zip raises.
READ_ERRORS = (
    *(OSError, EOFError, RuntimeError, ValueError, KeyError, zipfile.BadZipFile),
    *(zlib.error, lzma.LZMAError),
)


@dataclass(frozen=True)
class Members:
    """Paths in a zip or folder.

    Attributes
    ----------
    files, folders : list of str
    refused : list of (str, str)
        Path of each other entry, and the reason to refuse it.
    """

    files: list
    folders: list
    refused: list


def list_members(path: Path) -> Members:
    """List all files and folders of a zip or folder.

    Raises
    ------
    UserError
        It does not exist, is a recording, or is a damaged zip or no zip.
    """
    if path.is_dir():
        return _list_members_of_folder(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; give a zip or a folder of recordings")
    if path.suffix.lower() == OLD_ENDING:
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
        remedy = "give a zip or a folder of recordings"
        if path.suffix.lower() == ".zip":
            remedy = "download it again"
        raise UserError(f"{path}: not a zip archive, or cut short ({error}); {remedy}") from error
    return _list_members_of_archive(members)


def _list_members_of_folder(path):
    """As :func:`list_members`, for a folder."""
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
            elif not is_ignored(PurePosixPath(member)):
                refused.append((member, "is not a regular file; move it away"))
    return Members(sorted(files), folders, refused)


def _list_members_of_archive(members):
    """As :func:`list_members`, for the entries of a zip."""
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
    return Members(files, sorted(map(str, (around | folders) - {PurePosixPath(".")})), refused)


def is_ignored(member: PurePosixPath) -> bool:
    """True for hidden files, and those that only describe the recordings."""
    if any(name.startswith(".") or name == "__MACOSX" for name in member.parts):
        return True
    return any(fnmatch(member.name.lower(), pattern) for pattern in IGNORED)


def _open_archive(file):
    """A zip.  Names without a mark are UTF-8, as ``zip`` writes them, or else of code page 437."""
    try:
        return zipfile.ZipFile(file, metadata_encoding="utf-8")
    except UnicodeDecodeError:
        return zipfile.ZipFile(file)


class MemberReader:
    """Reads the content of members.

    Parameters
    ----------
    path : Path
        A zip or folder.
    """

    def __init__(self, path: Path):
        if path.is_dir():
            self._open_member = lambda name: open_regular(path / name)
        else:
            self._open_member = _open_archive(open_regular(path)).open

    def read(self, name) -> bytes:
        """Read a member.

        Raises
        ------
        BadRecording
            It cannot be read, or is too large.
        """
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


def find_reader(path: Path) -> MemberReader:
    """A reader of the present source, opened once per process, because a zip's list is long."""
    state = path.stat()
    return _open_reader(path, state.st_ino, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _open_reader(path, *_state):
    return MemberReader(path)
