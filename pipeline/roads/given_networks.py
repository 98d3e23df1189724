"""Messages about a user's own network, a NIR graph or a Keras model, that was trained elsewhere."""

from __future__ import annotations

from pathlib import Path

from deploy.errors import UserError
from deploy.files import sha256_of
from deploy.terminal import WARNING
from pipeline.artifacts import OUTDATED, State
from pipeline.roads.nir_settings import give_again
from pipeline.settings import Settings

GIVE_MODEL_AGAIN = (
    "give it again with 'stmnist convert RUN --model FILE' (--retrain too if you gave it)"
)
"""The remedy for a Keras model that has changed since it was imported."""

FROM_ELSEWHERE = ("nir.sha256", "cnn.model_sha256")
"""Settings that change if another file is given."""

SPLIT_AGAIN = ("seed", "split", "recordings", "data.", "skin.")
"""Beginnings of the changes after which other samples are in the test split."""


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


def changed_note(settings: Settings) -> str | None:
    """A warning if the file of a run's own network is another one now, such as a later version."""
    file, sha256, remedy = settings.nir.file, settings.nir.sha256, give_again(settings)
    if settings.network == "image":
        file, sha256, remedy = settings.cnn.model, settings.cnn.model_sha256, GIVE_MODEL_AGAIN
    if not file or not Path(file).is_file() or is_file(file, sha256):
        return None
    return (
        f"{WARNING}{file}: has changed since it was imported; the run keeps the earlier version; "
        f"for this one {remedy}"
    )


def split_note(state: State, file: str) -> str | None:
    """A warning if recordings are split anew for a network that was trained on an earlier split.

    Parameters
    ----------
    state : State
        Of the artifact that is made from the file.
    file : str
        The user's file; empty if the network is trained here.
    """
    changed = [change.what for change in state.because]
    if not file or state.state != OUTDATED or any(what in FROM_ELSEWHERE for what in changed):
        return None
    if not any(what.startswith(SPLIT_AGAIN) for what in changed):
        return None
    return (
        f"{WARNING}{file}: was not trained for this split of the recordings, so that test samples "
        "may be among its training samples and the accuracies too high; train it on this split, "
        "and give it again"
    )
