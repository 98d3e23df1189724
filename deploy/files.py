"""Files: written whole or not at all, hashed, and never executed on reading."""

import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np

from . import limits
from .errors import UserError


@contextlib.contextmanager
def replacing(path, mode="wb"):
    """Open a temporary file beside ``path`` that takes its place when the block succeeds.

    Parameters
    ----------
    path : path-like
        The file to write.  Missing parent folders are made.
    mode : str
        ``"wb"``, or ``"w"`` for text in UTF-8.

    Yields
    ------
    file object
        Open for writing.  On any exception, an interruption included, it is removed and whatever
        was at ``path`` stays as it was.

    Raises
    ------
    UserError
        The folder or file cannot be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # /dev/null would be gone
        raise UserError(f"{path}: cannot write (not a file); choose another name")
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        prefix = "." + path.name + "."
        remove_abandoned(path.parent, prefix)
        handle, temporary = tempfile.mkstemp(dir=str(path.parent), prefix=prefix)
        options = {} if "b" in mode else {"encoding": "utf-8", "newline": "\n"}
        with os.fdopen(handle, mode, **options) as file:
            claim(handle)
            yield file
            file.flush()
            # mkstemp makes files that only their owner can read.
            os.chmod(temporary, 0o666 & ~_umask())
            os.replace(temporary, str(path))  # before it is closed, so that it is always locked
            temporary = None
    except OSError as error:
        raise UserError(
            f"{path}: cannot write ({error.strerror or error}); "
            "check the folder's permissions and the free space"
        ) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


ABANDONED_S = 0.5
"""Age of what may be abandoned: just made, before :func:`claim`, a file is not locked yet.  Shorter
than a command takes to start, so that the next one removes what a killed one left."""


def claim(handle):
    """Lock an open temporary file or folder, so that it is not taken for an abandoned one."""
    with contextlib.suppress(OSError):  # a file system without locks
        _take(handle)


def _take(handle):
    """Lock what is open until it is closed; an OSError if another process has."""
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_abandoned(folder, prefix):
    """Remove temporary files and folders whose process was killed.

    Parameters
    ----------
    folder : path-like
    prefix : str
        Of their names; what `tempfile` adds follows.
    """
    name = re.compile(re.escape(prefix) + "[a-z0-9_]{8}")
    with contextlib.suppress(OSError), os.scandir(str(folder)) as entries:
        for entry in [entry for entry in entries if name.fullmatch(entry.name)]:
            with contextlib.suppress(OSError):
                if time.time() - entry.stat(follow_symlinks=False).st_mtime < ABANDONED_S:
                    continue
                handle = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)
                try:
                    _take(handle)  # whose owner lives holds it
                    if entry.is_dir(follow_symlinks=False):
                        shutil.rmtree(entry.path)
                    else:
                        os.unlink(entry.path)
                finally:
                    os.close(handle)


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def lock(file, taken: str):
    """Lock an open file against other processes until it is closed.

    Parameters
    ----------
    file : file object
    taken : str
        The error's line if another process holds the lock.

    Raises
    ------
    UserError
        Another process does.
    """
    try:
        _take(file)
    except OSError:
        raise UserError(taken) from None


def write_json(path, value):
    """Write ``value`` as JSON in UTF-8, indented, whole or not at all."""
    with replacing(path, "w") as file:
        json.dump(value, file, indent=2, ensure_ascii=False, allow_nan=False)
        file.write("\n")


def read_json(path, remedy):
    """Read a JSON object.

    Parameters
    ----------
    path : path-like
    remedy : str
        What the user can do if the file is missing or damaged; ends the error's line.

    Raises
    ------
    UserError
        The file is missing, unreadable, or not a JSON object.
    """
    try:
        with open(str(path), "rb") as file:
            content = file.read(limits.TEXT_BYTES + 1)
        if len(content) > limits.TEXT_BYTES:
            raise UserError(f"{path}: larger than any file of this kind; {remedy}")
        value = json.loads(content.decode("utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror or error}); {remedy}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({error}); {remedy}") from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: not a JSON object; {remedy}")
    return value


def write_arrays(path, compress=True, **arrays):
    """Write named arrays as ``.npz``, whole or not at all, the same bytes for the same arrays."""
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    # Not numpy.savez: it stamps each member with the time of day, and a bundle's id is a hash.
    with replacing(path) as file, zipfile.ZipFile(file, "w", kind) as archive:
        for name in sorted(arrays):
            member = zipfile.ZipInfo(name + ".npy", date_time=(1980, 1, 1, 0, 0, 0))
            member.compress_type = kind
            member.external_attr = 0o644 << 16
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(arrays[name]), allow_pickle=False)


def read_arrays(path, remedy, most=limits.ARRAY_BYTES):
    """Read every array of an ``.npz`` file into a dict, refusing pickled objects.

    Parameters
    ----------
    path : path-like
    remedy : str
        What the user can do if the file is missing or damaged; ends the error's line.
    most : int
        Bytes that the arrays may take.

    Raises
    ------
    UserError
        The file is missing, damaged, too large, or holds anything but plain arrays.
    """
    try:
        with np.load(str(path), allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > most:
                raise UserError(f"{path}: arrays of more than {most >> 20} MB; {remedy}")
            arrays = {name: archive[name] for name in archive.files}
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror or error}); {remedy}") from error
    except (ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: damaged or not an .npz of plain arrays; {remedy}") from error
    except Exception as error:  # zlib.error and whatever else a damaged archive provokes
        raise UserError(f"{path}: damaged ({type(error).__name__}); {remedy}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise UserError(f"{path}: damaged or not an .npz of plain arrays; {remedy}")
    return arrays


def sha256_of(path):
    """Hexadecimal SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with open(str(path), "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()
