"""A network that the user has trained elsewhere: its file, and what becomes of it in a run."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from deploy.errors import UserError
from deploy.files import hash_file
from deploy.terminal import WARNING
from pipeline.settings import IMPORTED
from pipeline.storage.artifacts import State

# Beginnings of the changes after which other samples are in the test set.
SPLIT_SETTINGS = ("seed", "split", "recordings", "data.", "skin.")


class ImportedNetwork(NamedTuple):
    """A file of the user from which a step of a run is made.

    Attributes
    ----------
    file : str
    sha256 : str
        SHA-256 of the file's content when it was imported.
    step : str
        Name of the step that reads it.
    remedy : str
        How a changed file is imported again.
    """

    file: str
    sha256: str
    step: str
    remedy: str

    def list_warnings(self) -> Iterator[str]:
        """A warning if the file has changed since it was imported."""
        if Path(self.file).is_file() and not is_file(self.file, self.sha256):
            yield (
                f"{WARNING}{self.file}: has changed since it was imported; the run keeps the "
                f"earlier version; for this one {self.remedy}"
            )

    def list_split_notes(self, state: State, seed: int) -> Iterator[str]:
        """A line on the split that the network must have been trained on; a warning if it is new.

        Parameters
        ----------
        state : State
            State of the step that reads the file.
        seed : int
            Seed of the split.
        """
        changed = [change.name for change in state.because]
        if state.is_missing:
            yield (
                f"{self.step}: the accuracies are too high if the network in the file was trained "
                f"on test samples of this split (seed {seed})"
            )
        of_split = [name for name in changed if name.startswith(SPLIT_SETTINGS)]
        if of_split and not set(changed) & set(IMPORTED.values()):
            yield (
                f"{WARNING}{self.file}: was not trained on this split, so that test samples may be "
                "among those of its training; train it on this split, and give it again"
            )


def is_file(path, sha256: str) -> bool:
    """True if a file can be read and has this SHA-256."""
    try:
        return hash_file(Path(path)) == sha256
    except (OSError, UserError):
        return False


def find_imported_file(file, sha256: str, copy: Path) -> Path:
    """The file of a network that was imported: the user's, or the run's copy if that has changed.

    The user's file is also returned if the copy is damaged or missing; then neither has the hash.
    """
    return next((path for path in (Path(file), copy) if is_file(path, sha256)), Path(file))
