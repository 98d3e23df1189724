"""Files: written completely or not at all, hashed, and never executed on reading."""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from . import limits
from .errors import UserError
from .interrupts import at_the_end


@contextlib.contextmanager
def replacing(path, mode="wb"):
    """Open a temporary file beside ``path`` that takes its place when the block succeeds.

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
    if path.exists() and not path.is_file():  # would replace /dev/null
        raise UserError(f"{path}: cannot write (not a file); choose another name")
    with _written_beside(path, "." + path.name + ".", mode, os.replace) as file:
        yield file


@contextlib.contextmanager
def creating(path, prefix):
    """Open a temporary file beside ``path`` that gets this name unless the name is taken.

    Parameters
    ----------
    path : path-like
        The file to write.  Missing parent folders are made.
    prefix : str
        Start of the temporary file's name; the next call removes the files of killed processes.

    Yields
    ------
    file object
        Open for writing bytes.  On any exception it is removed.

    Raises
    ------
    FileExistsError
        Something is at ``path``; it does not change.
    UserError
        The folder or file cannot be written.
    """
    with _written_beside(Path(path), prefix, "wb", _name_exclusively) as file:
        yield file


@contextlib.contextmanager
def _written_beside(path, prefix, mode, rename):
    """A temporary file, to which ``rename(temporary, path)`` is applied when the block succeeds."""
    temporary = None
    try:
        make_folder(path.parent)
        handle, temporary = temporary_file(path.parent, prefix)
        options = {} if "b" in mode else {"encoding": "utf-8", "newline": "\n"}
        with os.fdopen(handle, mode, **options) as file:
            with at_the_end(os.unlink, temporary):
                yield file
            file.flush()
            # mkstemp makes files that only their owner can read.
            os.fchmod(handle, 0o666 & ~_umask())
            rename(temporary, str(path))  # before it is closed, so that it is always locked
            temporary = None
    except _NameTaken as error:
        raise FileExistsError(errno.EEXIST, "something has this name", str(path)) from error
    except OSError as error:
        raise UserError(
            f"{path}: cannot write ({error.strerror or error}); "
            "check the folder's permissions and the free space"
        ) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


class _NameTaken(Exception):
    """A file cannot be created, because its name is taken."""


def _name_exclusively(temporary, path):
    """Rename a file, but never replace another one, which :func:`os.rename` would do."""
    try:
        try:
            os.link(temporary, path, follow_symlinks=False)
        except FileExistsError:
            raise
        except OSError:  # no links in this file system: an empty file reserves the name
            os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW))
            os.replace(temporary, path)
            return
    except FileExistsError as error:
        raise _NameTaken from error
    os.unlink(temporary)


def temporary_file(folder, prefix):
    """Create a temporary file and lock it; see :func:`temporary_folder`."""
    return _locked_from_the_start(tempfile.mkstemp, folder, prefix)


def temporary_folder(folder, prefix):
    """Create a temporary folder and lock it; first remove those of killed processes.

    Parameters
    ----------
    folder : path-like
        Where it is created.
    prefix : str
        Start of the name; users do not choose such a name, since abandoned files are removed.

    Returns
    -------
    handle : int
        Locks the folder until it is closed: :func:`remove_abandoned` leaves it alone.
    path : str

    Raises
    ------
    OSError
        Nothing can be created in ``folder``.
    """

    def make(**where):
        while True:
            path = tempfile.mkdtemp(**where)
            with contextlib.suppress(FileNotFoundError):  # another process has removed it
                return os.open(path, os.O_RDONLY), path

    return _locked_from_the_start(make, folder, prefix)


def _locked_from_the_start(make, folder, prefix):
    """Make something that no other process has removed in the moment before it was locked."""
    remove_abandoned(folder, prefix)
    while True:
        handle, path = make(dir=str(folder), prefix=prefix)
        try:
            _take(handle)
        except BlockingIOError:  # another process is about to remove it
            os.close(handle)
            continue
        except OSError:  # a file system without locks, where nothing is removed
            return handle, path
        if os.path.lexists(path):
            return handle, path
        os.close(handle)


def _take(handle):
    """Lock an open file until it is closed.

    Raises
    ------
    BlockingIOError
        Another process has locked it.
    OSError
        Its file system has no locks.
    """
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_abandoned(folder, prefix):
    """Remove temporary files and folders whose process was killed.

    Parameters
    ----------
    folder : path-like
    prefix : str
        Start of the names; `tempfile` adds the rest.
    """
    name = re.compile(re.escape(prefix) + "[a-z0-9_]{8}")
    with contextlib.suppress(OSError), os.scandir(str(folder)) as entries:
        for entry in [entry for entry in entries if name.fullmatch(entry.name)]:
            with contextlib.suppress(OSError):
                handle = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
                try:
                    _take(handle)  # fails while the owner is running
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

    def opener(name, flags):
        handle = os.open(name, flags | os.O_NONBLOCK | os.O_NOCTTY)
        kind = os.fstat(handle).st_mode
        if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):  # Python refuses a directory itself
            os.close(handle)
            raise OSError(errno.EINVAL, "a pipe or a device, not a file", name)
        return handle

    return open(str(path), mode, opener=opener, **options)


def open_own(path):
    """Open a file of this program for reading and appending; create it if it does not exist.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    file object
        Binary and without a buffer.  Its content does not change.

    Raises
    ------
    OSError
        The file cannot be opened.  A symbolic link is not followed, and a file with a second name,
        a pipe or a device is refused: it could belong to another program.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        handle = os.open(str(path), flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            message = "a symbolic link, which is not followed"
            raise OSError(errno.ELOOP, message, str(path)) from error
        raise
    about = os.fstat(handle)
    if not stat.S_ISREG(about.st_mode) or about.st_nlink > 1:
        os.close(handle)
        raise OSError(errno.EPERM, "not a regular file with a single name", str(path))
    return os.fdopen(handle, "a+b", buffering=0)


@contextlib.contextmanager
def locked(path, taken: str):
    """Lock a file of this program against other processes while the block runs.

    A file system without locks does not stop the program: there, it cannot notice another process.

    Parameters
    ----------
    path : path-like
        Created if it does not exist; see :func:`open_own`.
    taken : str
        Message of the error if another process holds the lock.

    Yields
    ------
    file object

    Raises
    ------
    UserError
        Another process holds the lock.
    OSError
        The file cannot be opened.
    """
    while True:
        with open_own(path) as file:
            try:
                _take(file)
            except BlockingIOError:
                raise UserError(taken) from None
            except OSError:  # a file system without locks, where nothing can hold one
                pass
            # Its last owner may have removed the file between the two calls above.
            if is_at(file, path):
                yield file
                return


def is_at(file, path) -> bool:
    """True if an open file is still the one at ``path``: a lock on a deleted file is void."""
    try:
        there = os.stat(str(path), follow_symlinks=False)
    except OSError:
        return False
    return os.path.samestat(os.fstat(file.fileno()), there)


@contextlib.contextmanager
def locked_folder(folder, taken: str):
    """Lock a folder through its file ``.lock``, which exists while the block runs.

    Parameters
    ----------
    folder : path-like
        Created if it does not exist.  At the end it is removed, with the parent folders that were
        created for it, if it is empty.
    taken : str
        As for :func:`locked`.

    Yields
    ------
    file object
        The lock file, for :func:`is_at`.

    Raises
    ------
    UserError
        Another process holds the lock.
    OSError
        The folder or its ``.lock`` cannot be created.
    """
    folder = Path(folder)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / ".lock"
    with locked(path, taken) as file:
        _LOCKED.append((folder.absolute(), file))

        def leave():
            with contextlib.suppress(OSError):
                if is_at(file, path):
                    path.unlink()
                    for each in made:
                        each.rmdir()  # fails if the folder is not empty, as intended

        try:
            with at_the_end(leave):
                yield file
        finally:
            _LOCKED.remove((folder.absolute(), file))
            leave()


_LOCKED = []
"""The folders that this process has locked, each with the file of its lock."""


def make_folder(folder):
    """Create a folder for results, with its missing parents.

    Parameters
    ----------
    folder : path-like

    Raises
    ------
    UserError
        The folder is in another one that this process has locked and that was deleted since:
        results written now would be incomplete.
    OSError
        The folder cannot be created.
    """
    folder = Path(folder)
    for held in {held for held, _ in _LOCKED} & {folder.absolute(), *folder.absolute().parents}:
        if not any(is_at(lock, held / ".lock") for path, lock in _LOCKED if path == held):
            raise UserError(
                f"{held}: was deleted or moved while this command worked in it; "
                "run the command again"
            )
    folder.mkdir(parents=True, exist_ok=True)


def refuse_linked_folder(folder):
    """Refuse a folder that is a symbolic link.

    Files would be written elsewhere, and could replace files that are not of this program.

    Raises
    ------
    UserError
    """
    if os.path.islink(str(folder)):
        raise UserError(
            f"{folder}: is a symbolic link to another folder, which is not followed; "
            "remove it, or replace it by a folder"
        )


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
    try:
        with open_regular(path) as file:
            content = file.read(limits.TEXT_BYTES + 1)
        if len(content) > limits.TEXT_BYTES:
            raise UserError(f"{path}: larger than any file of this kind; {remedy}")
        value = json.loads(content.decode("utf-8"), parse_constant=_no_number)
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror or error}); {remedy}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({error}); {remedy}") from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: not a JSON object; {remedy}")
    if _is_deeper(value, limits.NESTED):
        raise UserError(f"{path}: nested more than {limits.NESTED} deep; {remedy}")
    return value


def _no_number(name):
    raise ValueError(f"{name} is not a JSON number")


def _is_deeper(value, most):
    """Whether a JSON value is nested deeper than ``most``, found without recursion."""
    level = [value]
    for _ in range(most):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, (dict, list))
        ]
        if not level:
            return False
    return True


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
        The user's remedy if the file is missing or damaged; ends the error's line.
    most : int
        Maximum size of the arrays in bytes.

    Raises
    ------
    UserError
        The file is missing, damaged, too large, or has anything but plain arrays.
    """
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > most:
                raise UserError(f"{path}: arrays of more than {most >> 20} MB; {remedy}")
            arrays = {name: archive[name] for name in archive.files}
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror or error}); {remedy}") from error
    except (ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: damaged or not an .npz of plain arrays; {remedy}") from error
    except Exception as error:  # zlib.error and other errors of damaged archives
        raise UserError(f"{path}: damaged ({type(error).__name__}); {remedy}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise UserError(f"{path}: damaged or not an .npz of plain arrays; {remedy}")
    return arrays


def copy_file(source, to):
    """Copy a file's content, completely or not at all."""
    with open_regular(source) as content, replacing(to) as file:
        shutil.copyfileobj(content, file)


def sha256_of(path, most=limits.FILE_BYTES):
    """Hexadecimal SHA-256 of a file's content.

    Parameters
    ----------
    path : path-like
    most : int
        Largest number of bytes: a sparse file of terabytes takes no space and hours to hash.

    Raises
    ------
    UserError
        The file is larger.
    OSError
        The file cannot be read.
    """
    digest = hashlib.sha256()
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > most:
            raise UserError(f"{path}: larger than {most:,} bytes; choose another file")
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()
