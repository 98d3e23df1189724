"""Saving recordings that people wrote, in a folder with the published layout.

``FOLDER/<class>/w<writer>-<number>.mat``: the number counts up over all classes of a writer.  The
list of recordings is always read from these names, so that there is no other record that could be
lost or become outdated.  A file is never overwritten.
"""

import contextlib
import hashlib
import json
import os
import re
import threading
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import lock_file, open_regular, remove_leftovers, replacing, reporting_os_errors
from pipeline.recordings.formats.mat import (
    MatRecording,
    encode_lookup_table,
    encode_recording,
    read_lookup_table,
)
from pipeline.recordings.formats.recording import BadRecording, read_limited
from pipeline.recordings.sensor import Sensor, TaxelMap

# Writers are numbered from 1 to one less than this.
END_OF_WRITERS = 1000

# Number with which every page begins, until a writer is chosen there.
FIRST_WRITER = 1

# Position of each taxel, in the folder that has the classes' folders.
TABLE = "LUT.mat"

LOCK = ".lock"

_NAME = re.compile(r"w([0-9]{3})-([0-9]{4,})\.mat")


@dataclass(frozen=True)
class SavedRecording:
    """A recording in the folder.

    Attributes
    ----------
    label : int
    writer : int
    number : int
    class_folder : str
        The folder of its class.
    """

    label: int
    writer: int
    number: int
    class_folder: str

    @property
    def name(self) -> str:
        """The path of the recording in the folder."""
        return f"{self.class_folder}/w{self.writer:03d}-{self.number:04d}.mat"


def name_class_folders(classes) -> tuple:
    """The folder name of each class: its name or, if one is not valid for a folder, its number.

    Classes that were read from folders have such names; a copied network may have any names.
    """
    valid = len(set(classes)) == len(classes) and all(
        re.fullmatch(r"[^./][^/]*", n) and n.isprintable() and len(n.encode()) < 256
        for n in classes
    )
    return tuple(classes) if valid else tuple(map(str, range(len(classes))))


class Keeper:
    """The folder of recordings, used by one process at a time, for several pages.

    Parameters
    ----------
    folder : path-like
        Created if it does not exist.
    sensor : Sensor, optional
        Sensor of the recordings; default: the published one.

    Raises
    ------
    UserError
        The folder cannot be written, another process uses it, or its recordings are of another
        sensor.
    """

    def __init__(self, folder, sensor: Sensor | None = None):
        self.folder = Path(folder)
        self.sensor = sensor or Sensor()
        self._taxels = TaxelMap.grid(self.sensor.rows, self.sensor.columns)
        self._class_folders = name_class_folders(self.sensor.classes)
        self._guard = threading.Lock()
        # Numbers of writers that were on any page.  They are not assigned again when it closes,
        # because a page that has lost its connection comes back with its number.
        self._assigned: set[int] = set()
        self._lock = contextlib.ExitStack()
        try:
            self._refuse_another_sensor()
            self._lock_folder()
            self.read_folder()
        except BaseException:
            self.close()
            raise

    def _refuse_another_sensor(self):
        table = self.folder / TABLE
        files = (path for path in self.folder.glob("[!.]*/[!.]*") if path.is_file())
        if foreign := next((path for path in files if path.suffix != ".mat"), None):
            raise UserError(
                f"{self.folder}: has files other than .mat, such as {foreign.name}; "
                "choose another folder with --record"
            )
        try:
            with open_regular(table) as file:
                stored = read_lookup_table(read_limited(file))
        except (OSError, BadRecording):
            return  # no recordings, or unreadable ones
        taxels = self._taxels
        if not np.array_equal((stored.row, stored.column), (taxels.row, taxels.column)):
            raise UserError(
                f"{self.folder}: has recordings of {len(stored)} taxels in another "
                f"arrangement than {self.sensor.rows}x{self.sensor.columns}; choose another folder "
                "with --record"
            )

    def _lock_folder(self):
        """Lock the folder, which is created if it does not exist."""
        remedy = "choose another folder with --record"
        problem = f"{self.folder}: another 'stmnist live' saves there; end it, or {remedy}"
        self._lock.enter_context(lock_file(self.folder / LOCK, problem, remedy))
        remove_leftovers(self.folder)

    def read_folder(self):
        """Read which recordings are in the folder.

        Raises
        ------
        UserError
            The folder cannot be read.
        """
        with reporting_os_errors(self.folder, "cannot read", "check its permissions"):
            files = _list_recordings(self.folder, self._class_folders)
        self._recordings = sorted(files, key=lambda file: (file.writer, file.number))

    def close(self):
        """Wait until nothing is being saved, then release the folder for other processes."""
        with self._guard:
            self._lock.close()

    def __len__(self):
        return len(self._recordings)

    @property
    def data_set(self) -> str:
        """A name for the folder and its classes, the same after a restart.

        Browsers store a page's writer under it.  It is a hash, because the path of the folder is
        not for other devices.
        """
        identity = [str(self.folder.resolve()), *self.sensor.classes]
        return hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:16]

    @property
    def writers(self) -> Counter:
        """How many recordings each writer has, by the writer's number."""
        return Counter(file.writer for file in self._recordings)

    def save(self, label: int, recording: MatRecording) -> SavedRecording:
        """Write a recording; when the function returns, it is on the disk.

        Parameters
        ----------
        label : int
        recording : MatRecording

        Raises
        ------
        UserError
            The recording could not be written; the folder has not changed.
        """
        with self._guard:
            self.read_folder()
            table = self.folder / TABLE
            if not table.exists():
                _create(table, encode_lookup_table(self._taxels))
            numbers = [file.number for file in self._recordings if file.writer == recording.writer]
            number = max(numbers, default=0) + 1
            class_folder = self._class_folders[label]
            saved = SavedRecording(label, recording.writer, number, class_folder)
            _create(self.folder / saved.name, encode_recording(recording))
            self.read_folder()
            return saved

    def remove(self, recording: SavedRecording):
        """Remove a recording; nothing happens if it does not exist any more.

        Raises
        ------
        UserError
            The recording could not be removed.
        """
        path = self.folder / recording.name
        with self._guard:
            with reporting_os_errors(path, "cannot remove", "check the folder's permissions"):
                path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                path.parent.rmdir()  # a class without a recording is refused as data
            self.read_folder()

    def note_writer(self, number: int):
        """Note that a page has a writer's number, which :meth:`add_writer` then does not return."""
        with self._guard:
            self._assigned.add(number)

    def add_writer(self) -> int:
        """A number that no other page has or had, also if its writer has not saved anything yet.

        It is above all others or, if there is none, the lowest free one.

        Raises
        ------
        UserError
            All numbers are taken.
        """
        with self._guard:
            self.read_folder()
            used = {*self._assigned, *self.writers}
            numbers = [max(used, default=0) + 1, *range(1, END_OF_WRITERS)]
            free = next((n for n in numbers if n < END_OF_WRITERS and n not in used), None)
            if free is None:
                raise UserError(
                    f"{self.folder}: all {END_OF_WRITERS - 1} numbers of writers are taken; "
                    "choose another folder with --record"
                )
            self._assigned.add(free)
            return free


def _list_recordings(folder, class_folders):
    """The recordings in a folder; files of other names are ignored."""
    files = []
    for label, class_folder in enumerate(class_folders):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            for name in os.listdir(folder / class_folder):
                match = _NAME.fullmatch(name)
                if match and int(match[1]) > 0:
                    files.append(SavedRecording(label, int(match[1]), int(match[2]), class_folder))
    return files


def _create(path, content):
    """Write a new file, and wait until it is on the disk.

    Raises
    ------
    UserError
        The name is taken, or the file could not be written.
    """
    if os.path.lexists(path):
        raise UserError(f"{path}: another program has just written it; save again")
    with replacing(path) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
