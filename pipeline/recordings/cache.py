"""The folder of the cache, and arrays in it that are read from the disk as they are used."""

import mmap
import os
import tempfile
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import replacing

# Size in bytes from which an array that is made is on the disk and not in memory.
MAX_BYTES_IN_MEMORY = 1 << 28


def find_cache_folder() -> Path:
    """The folder of the cache: ``$STMNIST_CACHE``, or ``stmnist`` in the user's cache folder."""
    if os.environ.get("STMNIST_CACHE"):  # if empty, it is not set
        return Path(os.environ["STMNIST_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stmnist"


def make_empty_array(shape: tuple, dtype) -> np.ndarray:
    """An array to be filled: in memory or, if it is large, in a file that is deleted with it.

    Parameters
    ----------
    shape : tuple of int
    dtype : data type
    """
    size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    if size <= MAX_BYTES_IN_MEMORY:
        return np.empty(shape, dtype)
    folder = find_cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:  # unlinked: the mapping keeps it
        return np.memmap(file, dtype, "w+", shape=shape)


def release_pages(array: np.ndarray):
    """Release the memory of a mapped array; values that are used again are read again.

    The system does so by itself only if memory is short.  Other arrays stay as they are.
    """
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def write_column(path: Path, column: np.ndarray):
    """Write a ``.npy`` file of one dimension."""
    with replacing(path) as file:
        np.save(file, column, allow_pickle=False)


def map_column(path: Path, dtype, remedy: str) -> np.ndarray:
    """A ``.npy`` file of one dimension, whose parts are read from the disk when they are used.

    Parameters
    ----------
    path : Path
    dtype : data type
        That it must have.
    remedy : str
        The user's remedy if the file is missing or damaged; ends the error's line.

    Raises
    ------
    UserError
        The file is missing, damaged, or has another type.
    """
    try:
        column = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: damaged cache ({error}); {remedy}") from error
    if not isinstance(column, np.ndarray) or column.ndim != 1 or column.dtype != dtype:
        raise UserError(f"{path}: damaged cache (not a column of {np.dtype(dtype)}); {remedy}")
    return column
