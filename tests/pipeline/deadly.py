"""A reader that a file ends: light, since each of the processes that it ends imports it."""

import os
import signal
import zipfile

from pipeline.data.matfile import read_recording

CONTENT = b"deadly"


def read_members(path, names):
    """In the place of the one in `pipeline.data.archive`."""
    with zipfile.ZipFile(path) as file:
        return [_read(file.read(name)) for name in names]


def _read(content):
    if content == CONTENT:
        os.kill(os.getpid(), signal.SIGKILL)
    return read_recording(content), len(content)
