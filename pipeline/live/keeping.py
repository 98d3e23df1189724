"""Recordings that people wrote, in a folder laid out as published, safe as soon as they are there.

``FOLDER/<digit>/w<writer>-<number>.mat``: the number counts up over all digits of a writer.  What
has been written is only ever read from those names, so that nothing else can be lost or go stale.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import locked_folder, refuse_linked_folders, replacing
from pipeline.recordings.events import DIGITS, TaxelMap
from pipeline.recordings.matfile import MatRecording, lookup_table_bytes, recording_bytes

WRITERS = 1000
"""Writers that a folder can tell apart."""

_NAME = re.compile(r"w(\d{3,})-(\d{4,})\.mat")


@dataclass(frozen=True)
class Kept:
    """A recording in the folder."""

    digit: int
    writer: int
    number: int

    @property
    def name(self) -> str:
        """Its path in the folder."""
        return f"{self.digit}/w{self.writer:03d}-{self.number:04d}.mat"


class Keeper:
    """The folder; at most one at a time, for several pages.

    Parameters
    ----------
    folder : path-like
        Is made if it is not there.

    Raises
    ------
    UserError
        It cannot be written, or another process keeps recordings in it.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        taken = (
            f"{self.folder}: another 'stmnist live' keeps recordings there; "
            "end it, or choose another folder with --record"
        )
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked_folder(self.folder, taken))
            except OSError as error:
                raise UserError(
                    f"{self.folder}: cannot keep recordings there ({error.strerror}); "
                    "choose another folder with --record"
                ) from error
            refuse_linked_folders(self.folder)
            self._lock = stack.pop_all()
        self._guard = threading.Lock()
        self._kept = sorted(_list(self.folder), key=lambda kept: (kept.writer, kept.number))

    def close(self):
        """Let another process have the folder."""
        self._lock.close()

    def __len__(self):
        return len(self._kept)

    @property
    def writers(self) -> list:
        """Numbers of the writers of whom there are recordings, in order."""
        return sorted({kept.writer for kept in self._kept})

    def counts(self, writer: int) -> list:
        """Recordings of each digit by a writer."""
        counts = Counter(kept.digit for kept in self._kept if kept.writer == writer)
        return [counts[digit] for digit in range(10)]

    def save(self, digit: int, recording: MatRecording) -> Kept:
        """Write a recording; when this returns it is on the disk.

        Raises
        ------
        UserError
            It could not be written; nothing has been.
        """
        with self._guard:
            table = self.folder / "LUT.mat"
            if not table.exists():
                _write(table, lookup_table_bytes(TaxelMap()))
            numbers = [k.number for k in self._kept if k.writer == recording.writer]
            kept = Kept(digit, recording.writer, max(numbers, default=0) + 1)
            _write(self.folder / kept.name, recording_bytes(recording))
            self._kept.append(kept)
            return kept

    def undo(self, writer: int) -> Kept | None:
        """Remove a writer's last recording; returns it, or None if there is none.

        Raises
        ------
        UserError
            It could not be removed.
        """
        with self._guard:
            mine = [kept for kept in self._kept if kept.writer == writer]
            if not mine:
                return None
            last = max(mine, key=lambda kept: kept.number)
            try:
                (self.folder / last.name).unlink(missing_ok=True)
            except OSError as error:
                raise UserError(
                    f"{self.folder / last.name}: cannot be removed ({error.strerror})"
                ) from error
            self._kept.remove(last)
            return last


def asked_next(counts, each: int, seed) -> int | None:
    """Which digit to ask for next.

    The digits come in one random order, ``each`` of every digit; those that are there already are
    left out, so that a session goes on after a break, an undo or a restart.

    Parameters
    ----------
    counts : sequence of 10 int
        What is there.
    each : int
    seed : int or sequence of int
        The same one gives the same order.

    Returns
    -------
    int or None
        None when all are there.
    """
    rest = Counter({digit: n for digit, n in enumerate(counts)})
    for digit in np.random.default_rng(seed).permutation(np.repeat(np.arange(10), each)):
        if rest[int(digit)] == 0:
            return int(digit)
        rest[int(digit)] -= 1
    return None


def _list(folder):
    for digit in DIGITS:
        if (folder / digit).is_dir():
            for name in os.listdir(folder / digit):
                if match := _NAME.fullmatch(name):
                    yield Kept(int(digit), int(match[1]), int(match[2]))


def _write(path, content):
    with replacing(path) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name too
    finally:
        os.close(folder)
