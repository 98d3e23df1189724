"""A process's own folder for temporary files, so that what others leave there goes with it.

TensorFlow writes a file for each function that it rewrites and removes it when Python ends, which
a kill prevents.  The folder of a process that was killed is removed by the next one.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile

from deploy.files import claim, remove_abandoned
from deploy.interrupts import at_the_end

PREFIX = ".stmnist-process-"
"""Start of the names; users do not choose such a name, since abandoned folders are removed."""


@contextlib.contextmanager
def own_folder():
    """Make temporary files of this process and its workers in a folder that is removed after.

    If no folder can be made, everything stays as it is.
    """
    before, directory = os.environ.get("TMPDIR"), tempfile.tempdir
    try:
        remove_abandoned(tempfile.gettempdir(), PREFIX)
        folder = tempfile.mkdtemp(prefix=PREFIX)
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        yield
        return
    claim(handle)
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
