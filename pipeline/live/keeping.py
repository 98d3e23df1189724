"""Saving recordings that people wrote, in a folder with the published layout.

``FOLDER/<digit>/w<writer>-<number>.mat``: the number counts up over all digits of a writer.  The
list of recordings is always read from these names, so that no other record can be lost or become
outdated.  A file is never overwritten.
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
from deploy.files import (
    creating,
    is_at,
    locked_folder,
    refuse_linked_folders,
    remove_abandoned,
)
from pipeline.recordings.events import DIGITS, TaxelMap
from pipeline.recordings.matfile import MatRecording, lookup_table_bytes, recording_bytes

WRITERS = 1000
"""Writers are numbered from 1 to one less than this."""

TEMPORARY = ".recording."
"""Start of the name of a recording that is being written.  It is the same for all of them, so that
what a killed process left is found whatever its number was."""

_EARLIER = re.compile(r"\.w[0-9]+-[0-9]+\.mat\.")
_NAME = re.compile(r"w([0-9]{3})-([0-9]{4,9})\.mat")


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
    """The folder of recordings, used by one process at a time, for several pages.

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
        self._guard = threading.Lock()
        self._held = contextlib.ExitStack()
        self._lock = None
        self._hold()
        self._remove_abandoned()
        self.look()

    def _remove_abandoned(self):
        """Remove what a killed process left, of an earlier version too."""
        for digit in DIGITS:
            prefixes = {TEMPORARY}
            with contextlib.suppress(OSError):
                names = os.listdir(self.folder / digit)
                prefixes |= {found[0] for name in names if (found := _EARLIER.match(name))}
            for prefix in prefixes:
                remove_abandoned(self.folder / digit, prefix)

    def _hold(self):
        """Hold the folder's lock.  The one that was taken may have been deleted with the folder."""
        if self._lock is not None and is_at(self._lock, self.folder / ".lock"):
            return
        self._lock = None
        self._held.close()
        taken = (
            f"{self.folder}: another 'stmnist live' keeps recordings there; "
            "end it, or choose another folder with --record"
        )
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context(locked_folder(self.folder, taken))
            except OSError as error:
                raise UserError(
                    f"{self.folder}: cannot keep recordings there ({error.strerror}); "
                    "choose another folder with --record"
                ) from error
            refuse_linked_folders(self.folder)
            self._held, self._lock = stack.pop_all(), lock

    def look(self):
        """See which recordings are in the folder.

        Raises
        ------
        UserError
            It cannot be read.
        """
        try:
            found = _list(self.folder)
        except OSError as error:
            raise UserError(
                f"{self.folder}: cannot be read ({error.strerror}); check its permissions"
            ) from error
        self._kept = sorted(found, key=lambda kept: (kept.writer, kept.number))

    def close(self):
        """Release the folder for other processes."""
        self._lock = None
        self._held.close()

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
            self._hold()
            self.look()
            table = self.folder / "LUT.mat"
            if not table.exists():
                with contextlib.suppress(FileExistsError):
                    _create(table, lookup_table_bytes(TaxelMap()))
            content = recording_bytes(recording)
            mine = [kept.number for kept in self._kept if kept.writer == recording.writer]
            kept = Kept(digit, recording.writer, max(mine, default=0) + 1)
            while True:  # until a name is free: others may put files here
                try:
                    _create(self.folder / kept.name, content)
                    break
                except FileExistsError:
                    kept = Kept(digit, recording.writer, kept.number + 1)
            self.look()
            return kept

    def undo(self, writer: int) -> Kept | None:
        """Remove a writer's last recording; returns it, or None if there is none.

        Raises
        ------
        UserError
            It could not be removed.
        """
        with self._guard:
            self._hold()
            self.look()
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
            self.look()
            return last


def asked_next(counts, each: int, seed) -> int | None:
    """The digit to ask for next.

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
    """The recordings in a folder; files of other names are ignored."""
    found = []
    for digit in DIGITS:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            for name in os.listdir(folder / digit):
                match = _NAME.fullmatch(name)
                if match and int(match[1]) > 0:
                    found.append(Kept(int(digit), int(match[1]), int(match[2])))
    return found


def _create(path, content):
    """Write a file that was not there, and wait until it is on the disk with its name.

    Raises
    ------
    FileExistsError
        Something of that name is there.
    UserError
        It could not be written; it is not there.
    """
    with creating(path, TEMPORARY) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)  # the new name too
        finally:
            os.close(folder)
    except OSError as error:
        with contextlib.suppress(OSError):
            path.unlink()
        raise UserError(
            f"{path}: cannot write ({error.strerror}); check the disk and label the digit again"
        ) from error
