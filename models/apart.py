"""Read files from other sources in a separate process.

The HDF5 library crashes on some damaged files (measured: one flipped byte in a few thousand), and
a file can declare any amount of data.  Therefore the content of a file is read in a second process
with limits of memory and time, which returns plain values and arrays.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from deploy.children import PARENT, end_with_named_parent
from deploy.files import open_regular

MAX_SECONDS = 60
"""Seconds that reading a file may take; it takes less than one."""

MAX_MEMORY = 2 * 2**30
"""Bytes of memory that reading a file may take."""


class TooSlow(Exception):
    """The process did not end within :data:`MAX_SECONDS`."""


class Crashed(Exception):
    """The process ended without a result."""


def content_of(path, limit: int) -> bytes:
    """The bytes of a file, at most one more than ``limit``.

    Parameters
    ----------
    path : path-like
    limit : int
        Callers refuse longer files.

    Raises
    ------
    ValueError
        The file cannot be read; the message names the path.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise ValueError(f"{path}: a folder, not a file")
        with open_regular(path) as file:
            return file.read(limit + 1)
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{path}: cannot read ({reason}); check the path") from error
    except ValueError as error:  # a zero byte in the name, or the folder
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{str(path)!r}: cannot read ({error}); check the path") from error


def read_apart(module: str, content: bytes) -> tuple:
    """Run a module as a script to read a file's content; see :func:`answer_apart`.

    Parameters
    ----------
    module : str
        Dotted name.
    content : bytes

    Returns
    -------
    answer : dict
        Plain values.
    arrays : dict of str to ndarray

    Raises
    ------
    TooSlow, Crashed
    """
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", module],
            input=content,
            capture_output=True,
            timeout=MAX_SECONDS,
            env={
                **os.environ,
                "OPENBLAS_NUM_THREADS": "1",
                "PYTHONPATH": _search_path(),
                PARENT: str(os.getpid()),
            },
        )
    except subprocess.TimeoutExpired as error:
        raise TooSlow from error
    if done.returncode:
        raise Crashed
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        answer = json.loads(found["answer"].tobytes())
        return answer, {name: found[name] for name in found.files if name != "answer"}


def answer_apart(read):
    """The second process of :func:`read_apart`: reads standard input and writes an ``.npz``.

    Parameters
    ----------
    read : callable
        ``read(content) -> (answer, arrays)``, as :func:`read_apart` returns them.
    """
    end_with_named_parent()
    with contextlib.suppress(ImportError):
        import resource  # not on Windows

        resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    answer, arrays = read(sys.stdin.buffer.read())
    text = np.frombuffer(json.dumps(answer).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, answer=text, **arrays)
    sys.stdout.buffer.write(buffer.getvalue())


def _search_path():
    """The search path on which Python finds this package first."""
    here = str(Path(__file__).resolve().parents[1])
    return os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
