"""A run's folder: where each artifact is, and who is writing to it."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from deploy.errors import UserError
from deploy.files import locked_folder, refuse_linked_folders
from pipeline.artifacts import Artifact, Library, Origin
from pipeline.settings import Settings, read_settings, write_settings

FILES = {
    *(".keras", ".h5", ".hdf5", ".zip", ".mat", ".json", ".npz", ".toml", ".html", ".csv"),
    *(".py", ".pyz", ".pb", ".png", ".nir"),
}
"""Ends of names that nobody gives to a folder: a file that is not there must not become one."""


DELETE_ITS_FOLDER = "delete its folder and run the command again"
"""What to do about a damaged file of a network."""


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

    def check(self, stage: str, whole: bool = False) -> Path:
        """Result of a target or stage on the check's samples, or on the whole test split."""
        folder = self.path / "checks"
        return (folder / "whole" if whole else folder) / f"{stage}.json"

    def network(self, name: str, origin: Origin) -> Path:
        """Folder of a trained network, ``"cnn"`` or ``"snn"``, or of its ``"threshold"``.

        A run has one of each, whatever its origin.
        """
        return self.cnn if name == "cnn" else self.snn

    @property
    def artifacts(self) -> dict:
        """The artifacts whose place does not depend on settings, by name."""
        return {
            "dataset": Artifact("dataset", self.dataset),
            "bundle": Artifact(
                "bundle",
                self.bundle / "network.json",
                (self.bundle / "MANIFEST.json",),
                _recorded_in_bundle,
            ),
        }

    @property
    def whole_ladder(self) -> Path:
        """The loss ladder on the whole test split."""
        return self.path / "ladder-whole.json"

    @property
    def confusion(self) -> Path:
        """Confusion matrix of each stage on the whole test split."""
        return self.path / "confusion.png"

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
            One is; the name is a file's and no folder of that name is there; or a folder in it is a
            symbolic link.
        """
        if self.path.suffix.lower() in FILES and not self.path.is_dir():
            raise UserError(
                f"{self.path}: named like a file, and no folder of that name is there; "
                "RUN is a folder, such as runs/default"
            )
        taken = (
            f"{self.path}: another process is working in this run; "
            "wait for it or choose another RUN"
        )
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked_folder(self.path, taken))
            except OSError as error:
                raise UserError(
                    f"{error.filename or self.path / '.lock'}: cannot write ({error.strerror}); "
                    "choose another RUN"
                ) from error
            refuse_linked_folders(self.path)
            yield


@dataclass(frozen=True)
class NetworkLibrary(Library):
    """Trained networks of many settings side by side; stands where stages expect a run's folder."""

    def network(self, name: str, origin: Origin) -> Path:
        """Folder of a trained network or threshold of an origin."""
        return self.folder(name, origin)


def _recorded_in_bundle(network):
    """What ``network.json`` says of its origin; that of an earlier version says something else."""
    provenance = network.get("provenance")
    return provenance.get("made_from") if isinstance(provenance, dict) else None
