"""A run's folder: where each artifact is, what it was made from, and who is writing to it."""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from deploy.errors import UserError
from deploy.files import lock, read_json
from pipeline.settings import Settings, read_settings, write_settings

FILES = {
    *(".keras", ".h5", ".hdf5", ".zip", ".mat", ".json", ".npz", ".toml", ".html", ".csv"),
    *(".py", ".pyz", ".pb", ".png", ".nir"),
}
"""Ends of names that nobody gives to a folder: a file that is not there must not become one."""


DELETE_IT = "delete it and run the command again"
DELETE_ITS_FOLDER = "delete its folder and run the command again"
"""What to do about a damaged file of a run."""


@dataclass(frozen=True)
class RunFolder:
    """Paths of a run's artifacts.

    Attributes
    ----------
    path : Path
        May be given as text.
    """

    path: Path

    def __post_init__(self):
        object.__setattr__(self, "path", Path(self.path))

    @property
    def experiment(self) -> Path:
        """Every setting, resolved."""
        return self.path / "experiment.toml"

    @property
    def dataset(self) -> Path:
        """What the recordings were."""
        return self.path / "dataset.json"

    @property
    def cnn(self) -> Path:
        """Weights, history and metrics of the CNN."""
        return self.path / "cnn"

    @property
    def snn(self) -> Path:
        """Weights, history and metrics of the rate-based network."""
        return self.path / "snn"

    @property
    def bundle(self) -> Path:
        """What is deployed."""
        return self.path / "bundle"

    @property
    def ladder(self) -> Path:
        """The loss ladder."""
        return self.path / "ladder.json"

    def check(self, stage: str) -> Path:
        """Result of a target or stage on the check's samples."""
        return self.path / "checks" / f"{stage}.json"

    @property
    def whole_ladder(self) -> Path:
        """The loss ladder on the whole test split."""
        return self.path / "ladder-whole.json"

    @property
    def confusion(self) -> Path:
        """Confusion matrix of each stage on the whole test split."""
        return self.path / "confusion.png"

    def whole_check(self, stage: str) -> Path:
        """Result of a target or stage on the whole test split."""
        return self.path / "checks" / "whole" / f"{stage}.json"

    def resolve_settings(self, base: Path | None, changes: dict) -> Settings:
        """Settings of this run: those of its folder or of a file, with changes.

        Parameters
        ----------
        base : Path, optional
            A TOML file that takes the place of the run's own settings.
        changes : dict
            From the command line.

        Raises
        ------
        UserError
            A file or value is wrong.
        """
        if base is not None:
            settings = read_settings(base)
        elif self.experiment.exists():
            settings = read_settings(self.experiment)
        else:
            settings = Settings()
        return settings.with_values(changes, "command line")

    def save_settings(self, settings: Settings):
        """Keep the settings for the next command, unless they are there already.

        Raises
        ------
        UserError
            The folder cannot be written.
        """
        if not self.experiment.exists() or read_settings(self.experiment) != settings:
            write_settings(self.experiment, settings)

    @contextlib.contextmanager
    def locked(self):
        """Make the folder, and keep a second process from working in it.

        Raises
        ------
        UserError
            One is; or the name is a file's and no folder of that name is there.
        """
        if self.path.suffix.lower() in FILES and not self.path.is_dir():
            raise UserError(
                f"{self.path}: named like a file, and no folder of that name is there; "
                "RUN is a folder, such as runs/default"
            )
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            file = (self.path / ".lock").open("w")
        except OSError as error:
            raise UserError(
                f"{self.path}: cannot write ({error.strerror}); choose another RUN"
            ) from error
        with file:
            lock(
                file,
                f"{self.path}: another process is working in this run; "
                "wait for it or choose another RUN",
            )
            yield


def stamp_of(*parts) -> str:
    """Hash of plain values that an artifact is made from."""
    text = json.dumps(parts, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()


def is_current(metrics: Path, stamp: str, *artifacts: Path) -> bool:
    """True if the artifacts are there and ``metrics`` says that they were made from ``stamp``."""
    if not metrics.exists() or not all(path.exists() for path in artifacts):
        return False
    return read_json(metrics, DELETE_IT).get("made_from") == stamp


def read_stamped(path: Path, stamp: str) -> dict | None:
    """A result written with ``made_from``, or None if it is missing or of another stamp."""
    if not path.exists():
        return None
    result = read_json(path, DELETE_IT)
    return result if result.get("made_from") == stamp else None
