"""A network that is read from a user's file, a NIR graph or a Keras model, instead of trained."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from deploy.errors import UserError
from deploy.files import sha256_of
from deploy.terminal import WARNING
from pipeline.artifacts import OUTDATED, State

FROM_ELSEWHERE = ("nir.sha256", "cnn.model_sha256")
"""Settings that change if another file is imported."""

SPLIT_AGAIN = ("seed", "split", "recordings", "data.", "skin.")
"""Beginnings of the changes after which other samples are in the test split."""


class Imported(NamedTuple):
    """A user's file from which a part of a road is read.

    Attributes
    ----------
    file : str
    sha256 : str
        Of its content when it was imported.
    part : str
        Name of the part that is read from it.
    remedy : str
        How a changed file is imported again.
    """

    file: str
    sha256: str
    part: str
    remedy: str

    def changed_note(self) -> str | None:
        """A warning if the file is another one now, such as a later version."""
        if not Path(self.file).is_file() or is_file(self.file, self.sha256):
            return None
        return (
            f"{WARNING}{self.file}: has changed since it was imported; the run keeps the earlier "
            f"version; for this one {self.remedy}"
        )

    def split_note(self, state: State) -> str | None:
        """A warning if recordings are split anew for a network trained on an earlier split.

        Parameters
        ----------
        state : State
            Of the part that is read from the file.
        """
        changed = [change.what for change in state.because]
        if state.state != OUTDATED or any(what in FROM_ELSEWHERE for what in changed):
            return None
        if not any(what.startswith(SPLIT_AGAIN) for what in changed):
            return None
        return (
            f"{WARNING}{self.file}: was not trained for this split of the recordings, so that test "
            "samples may be among its training samples and the accuracies too high; train it on "
            "this split, and give it again"
        )


def is_file(path, sha256: str) -> bool:
    """True if a file can be read and has this SHA-256."""
    try:
        return sha256_of(Path(path)) == sha256
    except (OSError, UserError):
        return False


def imported_file(file, sha256: str, copy: Path) -> Path:
    """The file of a network that was imported: the user's, or the run's copy if that has changed.

    The user's file is also returned if the copy is damaged or missing; then neither has the hash.
    """
    return next((path for path in (Path(file), copy) if is_file(path, sha256)), Path(file))
