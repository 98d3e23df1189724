"""Files: written completely or not at all, hashed, and never executed on reading.

A file is written under a temporary name in the same folder, ``.<name>.<random>.tmp``, and renamed.
A process that is killed can leave such a file, which :func:`remove_leftovers` removes.
"""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import stat
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from . import limits
from .errors import UserError

# End of the names of temporary files and folders, which begin with a dot.
TEMPORARY = ".tmp"


@contextlib.contextmanager
def reporting_os_errors(path, failure, remedy):
    """Turn an error of the operating system in the block into one line for the user.

    Parameters
    ----------
    path : path-like
        The file or folder that the block reads or writes.
    failure : str
        What failed, such as "cannot read".
    remedy : str
        The user's remedy, at the end of the error message.

    Raises
    ------
    UserError
    """
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: {failure} ({error.strerror or error}); {remedy}") from error


def require_ending(path, ending):
    """Refuse a file's name with another ending, such as ``.zip``, in capitals or not."""
    if Path(path).suffix.lower() != ending:
        raise UserError(f"{path}: the name must end in {ending}")


# What Git LFS has in place of a large file that was not fetched, and the remedy.
POINTER_START = b"version https://git-lfs.github.com/"
POINTER_PROBLEM = "is a pointer of Git LFS and not the file itself; fetch it with 'git lfs pull'"


def is_pointer(content: bytes) -> bool:
    """True for the beginning of a pointer of Git LFS, which stands for a file."""
    return content.startswith(POINTER_START)


# Remedy if a file cannot be written.
WRITE_REMEDY = "check the folder's permissions and the free space"


@contextlib.contextmanager
def replacing(path, mode="wb"):
    """Open a temporary file next to ``path`` that takes its place when the block succeeds.

    A symbolic link at ``path`` is itself replaced; the file that it points to is not touched.

    Parameters
    ----------
    path : path-like
        The file to write.  Missing parent folders are created.
    mode : str
        ``"wb"``, or ``"w"`` for text in UTF-8.

    Yields
    ------
    file object
        Open for writing.  On any exception, including an interruption, it is removed and what is
        at ``path`` does not change.

    Raises
    ------
    UserError
        The folder or file cannot be written.
    """
    path = Path(path)
    temporary = None
    if path.exists() and not path.is_file():  # would replace /dev/null
        raise UserError(f"{path}: cannot write (not a file); choose another name")
    try:
        with reporting_os_errors(path, "cannot write", WRITE_REMEDY):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(TEMPORARY, f".{path.name}.", str(path.parent))
            options = {} if "b" in mode else {"encoding": "utf-8", "newline": "\n"}
            with os.fdopen(handle, mode, **options) as file:
                yield file
                file.flush()
                mask = os.umask(0)
                os.umask(mask)
                os.fchmod(handle, 0o666 & ~mask)  # mkstemp's files are for their owner only
            os.replace(temporary, str(path))
            temporary = None
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def remove_leftovers(folder):
    """Remove the temporary files and folders that killed processes have left, at any depth.

    Parameters
    ----------
    folder : path-like
        Locked by this process, so that nobody else is writing there.

    Raises
    ------
    UserError
        See :func:`refuse_linked_folders`.
    """
    refuse_linked_folders(folder)
    for path in list(Path(folder).rglob(f".*{TEMPORARY}")):
        with contextlib.suppress(OSError):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()


def open_regular(path, mode="rb", **options):
    """Open a file for reading; refuse a pipe or a device, which could block or be read forever.

    Parameters
    ----------
    path : path-like
    mode, **options
        As for :func:`open`.

    Raises
    ------
    OSError
        The file cannot be opened, or is a pipe or a device.
    """
    kind = os.stat(str(path)).st_mode
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):  # Python refuses a folder itself
        raise OSError(errno.EINVAL, "a pipe or a device, not a file", str(path))
    return open(str(path), mode, **options)


@contextlib.contextmanager
def lock_file(path, problem: str, remedy: str):
    """Lock a file of this program against other processes while the block runs.

    Parameters
    ----------
    path : path-like
        Created with its folders if it does not exist.  A symbolic link is not followed.
    problem : str
        Message of the error if another process holds the lock.
    remedy : str
        The user's remedy if the file cannot be written, at the end of the error message.

    Yields
    ------
    file object
        Open for reading and appending bytes.

    Raises
    ------
    UserError
        Another process holds the lock, or the file cannot be opened.
    """
    folder = Path(path).parent
    with reporting_os_errors(folder, "cannot write", remedy):
        folder.mkdir(parents=True, exist_ok=True)
    with reporting_os_errors(path, "cannot write", remedy):
        handle = os.open(str(path), os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW, 0o666)
    with os.fdopen(handle, "a+b", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(problem) from None
        except OSError:  # a file system without locks
            pass
        yield file


def refuse_linked_folder(folder):
    """Refuse a folder that is a symbolic link: files would be written elsewhere.

    Raises
    ------
    UserError
    """
    if os.path.islink(str(folder)):
        raise UserError(f"{folder}: is a link to a folder, which is not followed; replace it")


def refuse_linked_folders(root):
    """Refuse a folder in which another one, at any depth, is a symbolic link.

    Parameters
    ----------
    root : path-like
        May itself be a link, because the user has named it.

    Raises
    ------
    UserError
        A folder is a link; the message names it.
    """
    for above, folders, _ in os.walk(str(root)):
        for name in folders:
            refuse_linked_folder(os.path.join(above, name))


def write_json(path, value, indent=2):
    """Write JSON in UTF-8, completely or not at all; on one line if ``indent`` is None."""
    with replacing(path, "w") as file:
        json.dump(value, file, indent=indent, ensure_ascii=False, allow_nan=False)
        file.write("\n")


def read_json(path, remedy):
    """Read a JSON object.

    Parameters
    ----------
    path : path-like
    remedy : str
        The user's remedy if the file is missing or damaged, at the end of the error message.

    Raises
    ------
    UserError
        The file is missing, unreadable, or not a JSON object.
    """
    with reporting_os_errors(path, "cannot read", remedy), open_regular(path) as file:
        content = file.read(limits.TEXT_BYTES + 1)
    if len(content) > limits.TEXT_BYTES:
        raise UserError(f"{path}: larger than any file of this kind; {remedy}")
    try:
        value = json.loads(content.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({error}); {remedy}") from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: not a JSON object; {remedy}")
    return value


def _refuse_constant(name):
    raise ValueError(f"{name} is not a JSON number")


@contextlib.contextmanager
def reporting_damage(path, remedy):
    """Report a file as damaged if the block finds a value missing or of another type.

    Parameters
    ----------
    path : path-like
        The file whose values the block reads.
    remedy : str
        The user's remedy, at the end of the error message.

    Raises
    ------
    UserError
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        problem = f"{type(error).__name__}: {str(error)[:200]}"
        raise UserError(f"{path}: damaged or incomplete ({problem}); {remedy}") from error


def write_arrays(path, compress=True, **arrays):
    """Write named arrays as ``.npz``, completely or not at all; equal arrays give equal bytes."""
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    # Not numpy.savez: it writes the time of day into each member, and a bundle's id is a hash.
    with replacing(path) as file, zipfile.ZipFile(file, "w", kind) as archive:
        for name in sorted(arrays):
            with archive.open(zip_member(name + ".npy", kind), "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(arrays[name]), allow_pickle=False)


def zip_member(name, kind=zipfile.ZIP_DEFLATED):
    """A member of a zip whose bytes do not depend on the time of day."""
    member = zipfile.ZipInfo(str(name), date_time=(1980, 1, 1, 0, 0, 0))
    member.compress_type = kind
    member.external_attr = 0o644 << 16
    return member


def read_arrays(path, remedy, max_bytes=limits.ARRAY_BYTES):
    """Read every array of an ``.npz`` file into a dict, refusing pickled objects.

    Parameters
    ----------
    path : path-like
    remedy : str
        The user's remedy if the file is missing or damaged; ends the error's line.
    max_bytes : int
        Maximum size of the arrays in bytes.

    Raises
    ------
    UserError
        The file is missing, damaged, too large, or has anything but plain arrays.
    """
    try:
        reporting = reporting_os_errors(path, "cannot read", remedy)
        with reporting, open_regular(path) as file, np.load(file, allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > max_bytes:
                raise UserError(f"{path}: arrays of more than {max_bytes >> 20} MB; {remedy}")
            arrays = {name: archive[name] for name in archive.files}
    except UserError:
        raise
    except Exception as error:  # NumPy, zipfile and zlib have many errors for damaged archives
        raise UserError(f"{path}: damaged or not an .npz of plain arrays; {remedy}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise UserError(f"{path}: damaged or not an .npz of plain arrays; {remedy}")
    return arrays


def copy_file(source, to):
    """Copy a file's content, completely or not at all."""
    with open_regular(source) as content, replacing(to) as file:
        shutil.copyfileobj(content, file)


def hash_file(path):
    """Hexadecimal SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with open_regular(path) as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()
