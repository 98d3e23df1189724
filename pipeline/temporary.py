"""A process's own folder for temporary files, so that what others leave there goes with it.

TensorFlow writes a file for each function that it rewrites and removes it when Python ends, which
a kill prevents.  The folder of a process that was killed is removed by the next one.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from pathlib import Path

PREFIX = "stmnist-"
LOCK = "lock"


@contextlib.contextmanager
def own_folder():
    """Make temporary files of this process and its workers in a folder that is removed after.

    Where none can be made everything stays as it is.
    """
    before, directory = os.environ.get("TMPDIR"), tempfile.tempdir
    with contextlib.suppress(OSError):
        clean()
    try:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX))
        lock = (folder / LOCK).open("w")
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        yield
        return
    os.environ["TMPDIR"], tempfile.tempdir = str(folder), str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = directory
        if before is None:
            del os.environ["TMPDIR"]
        else:
            os.environ["TMPDIR"] = before
        shutil.rmtree(folder, ignore_errors=True)
        lock.close()


def clean():
    """Remove the folders of processes that are no more."""
    for folder in Path(tempfile.gettempdir()).glob(PREFIX + "*"):
        with contextlib.suppress(OSError), (folder / LOCK).open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # whose owner lives holds it
            shutil.rmtree(folder, ignore_errors=True)
