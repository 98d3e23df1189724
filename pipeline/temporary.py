"""A separate folder for the temporary files of a process, which is removed with all files in it.

TensorFlow writes a file for each function that it rewrites.  It removes the file when Python ends,
but not if the process is killed.  The folder of a killed process is removed by the next process.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile

from deploy.files import temporary_folder
from deploy.interrupts import at_the_end

PREFIX = ".stmnist-process-"
"""Start of the names; users do not choose such a name, since abandoned folders are removed."""


@contextlib.contextmanager
def own_folder():
    """Put temporary files of this process and its workers into a folder that is removed afterwards.

    If no folder can be created, nothing changes.
    """
    before, directory = os.environ.get("TMPDIR"), tempfile.tempdir
    try:
        handle, folder = temporary_folder(tempfile.gettempdir(), PREFIX)
    except OSError:
        yield
        return
    os.environ["TMPDIR"], tempfile.tempdir = folder, folder
    try:
        with at_the_end(shutil.rmtree, folder):
            yield
    finally:
        tempfile.tempdir = directory
        if before is None:
            del os.environ["TMPDIR"]
        else:
            os.environ["TMPDIR"] = before
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)
