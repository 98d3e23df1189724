"""The code of documents, executed within seconds instead of minutes."""

import contextlib

import pytest

import stmnist
from tests.command import hurry_emulator


@contextlib.contextmanager
def hurry_runs(epochs=2):
    """In the block, each `stmnist.Run` trains for this number of epochs, whatever it is told.

    A run starts no other processes, and the target ``emulator`` computes as ``fast`` does.
    """
    brief = {f"{network}.epochs": epochs for network in ("cnn", "snn", "events")}

    class BriefRun(stmnist.Run):
        def __init__(self, path, **given):
            super().__init__(path, **{**given, **brief, "jobs": 1})

    with pytest.MonkeyPatch.context() as patch, hurry_emulator():
        patch.setattr(stmnist, "Run", BriefRun)
        yield
