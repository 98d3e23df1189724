"""A run's folder: the places of its files, its lock, and what may become one."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from deploy.errors import UserError
from deploy.files import lock_file, refuse_linked_folder, remove_leftovers
from deploy.terminal import format_command

if TYPE_CHECKING:
    from pipeline.settings import Settings
    from pipeline.storage.artifacts import Origin

# File name endings that no folder has: a missing file must not be created as a folder.
FILES = {
    *(".keras", ".h5", ".hdf5", ".zip", ".mat", ".json", ".npz", ".toml", ".html", ".csv"),
    *(".py", ".pyz", ".pb", ".png", ".nir"),
}

# Remedy for a damaged file of a network.
DELETE_ITS_FOLDER = "delete its folder and run the command again"


def _make_path_property(name, meaning):
    """A property of a folder: the path of a file or folder in it."""
    return property(lambda folder: folder.path / name, doc=meaning)


def find_checks_folder(bundle: Path) -> Path:
    """The folder for the check results of a bundle: ``checks`` in its run, or else in itself.

    A copied bundle's ``deploy.pyz check`` writes there, too.

    Parameters
    ----------
    bundle : Path

    Raises
    ------
    UserError
        The folder is a symbolic link: results would be written elsewhere.
    """
    path = Path(os.path.abspath(bundle))  # which follows no link
    of_run = path.name == "bundle" and RunFolder(path.parent).experiment.is_file()
    folder = (path.parent if of_run else path) / "checks"
    refuse_linked_folder(folder)
    return folder


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

    experiment = _make_path_property("experiment.toml", "The file of all settings, resolved.")
    dataset = _make_path_property("dataset.json", "The description of the recordings.")
    bundle = _make_path_property("bundle", "The folder of the bundle.")
    ladder = _make_path_property("ladder.json", "The file of the loss ladder.")

    def find_check_file(self, stage: str) -> Path:
        """The file of a stage's result on the check's samples."""
        return self.path / "checks" / f"{stage}.json"

    def find_folder(self, name: str, origin: Origin | None = None) -> Path:
        """The folder of an artifact, such as ``"cnn"`` or ``"snn"``.

        A run has only one of each, independently of the origin, unlike a
        :class:`pipeline.storage.artifacts.Library`.
        """
        return self.path / name

    def resolve_settings(self, base: Path | None, changes: dict) -> Settings:
        """What the user has set, in this run's folder or in a file, with changes.

        Values that were chosen for the recordings have their defaults, so that they are chosen
        again.

        Parameters
        ----------
        base : Path, optional
            A TOML file that is used instead of the run's own settings.
        changes : dict
            Changes from the command line.

        Raises
        ------
        UserError
            A file or value is invalid.
        """
        from pipeline.settings import Settings, read_own_settings  # import NumPy

        settings = Settings()
        if base is not None or self.experiment.exists():
            settings = read_own_settings(base or self.experiment)
        return settings.with_values(changes, "command line")

    def save_settings(self, settings: Settings):
        """Save the settings for later commands, with the provenance of each value.

        Raises
        ------
        UserError
            The folder cannot be written.
        """
        from pipeline.settings import write_settings

        write_settings(self.experiment, settings)

    @contextlib.contextmanager
    def lock(self):
        """Create the folder, and lock it against other processes.

        Raises
        ------
        UserError
            Another process has locked it, it has a file's name, or a folder in it is a link.
        """
        if self.path.suffix.lower() in FILES and not self.path.is_dir():
            raise UserError(f"{self.path}: has a file's name; give a folder, such as runs/default")
        in_use = (
            f"{self.path}: another process is working in this run; "
            "wait for it or choose another RUN"
        )
        with lock_file(self.path / LOCK, in_use, "choose another RUN"):
            remove_leftovers(self.path)
            yield


LOCK = ".lock"
# Most folders from a file or bundle of a run up to the run: ``checks/other/mine.json``.
MAX_FOLDERS_UP = 3


def run_around(path) -> Path | None:
    """The folder of the run that a file or bundle is in, or None."""
    above = list(Path(path).absolute().parents)[:MAX_FOLDERS_UP]
    return next((folder for folder in above if (folder / "experiment.toml").is_file()), None)


def require_run_or_new_folder(path: Path, of_results: bool = False):
    """Make sure that a folder is a run or can become one: new, empty, or with experiment.toml.

    Parameters
    ----------
    path : Path
    of_results : bool
        True for the folder of a benchmark or sweep, which may have results of an interrupted one:
        only a bundle and a run are refused.

    Raises
    ------
    UserError
        The path is a file; the folder is a bundle or in one, has files that are not those of a
        run, or is a run where results of a benchmark are meant, or the other way round.
    """
    if path.is_file():
        raise UserError(f"{path}: is a file; give a folder as RUN")
    for folder in (path.absolute(), *path.absolute().parents):
        if (folder / "MANIFEST.json").is_file():
            raise UserError(
                f"{path}: is a bundle, or in one, and not a run; give its run, or another folder"
            )
    if of_results and (path / "dataset.json").is_file():
        raise UserError(
            f"{path}: is a run, whose settings would be replaced; give another folder for "
            "the results"
        )
    if not of_results and (path / "rows").is_dir() and not (path / "dataset.json").is_file():
        raise UserError(
            f"{path}: has the results of a sweep or an experiment, and is not a run; give another "
            "folder as RUN"
        )
    if of_results or not path.is_dir() or (path / "experiment.toml").exists():
        return
    names = sorted(entry.name for entry in path.iterdir() if not entry.name.startswith("."))
    if names:
        raise UserError(
            f"{path}: is not a run (it has no experiment.toml) and not empty "
            f"(it has {names[0]!r}); give another folder as RUN"
        )


def require_run(run: RunFolder):
    """Make sure that a folder is that of a run.

    Raises
    ------
    UserError
        It has no settings of a run: it is a bundle, has other files, or is not there.
    """
    require_run_or_new_folder(run.path)
    if not run.experiment.is_file():
        raise UserError(
            f"{run.path}: not the folder of a run, since it has no {run.experiment.name}; make one "
            f"with {format_command('ladder', run.path)}"
        )


@contextlib.contextmanager
def lock_run(path, of_results: bool = False):
    """Lock a folder for a run, or for results; nothing is left of it if nothing is saved.

    Parameters
    ----------
    path : path-like
    of_results : bool
        As in :func:`require_run_or_new_folder`.

    Yields
    ------
    RunFolder

    Raises
    ------
    UserError
        As :func:`require_run_or_new_folder` and :meth:`RunFolder.lock`.
    """
    folder = RunFolder(path)
    require_run_or_new_folder(folder.path, of_results)
    new_folders = [above for above in (folder.path, *folder.path.parents) if not above.exists()]
    had_lock = (folder.path / LOCK).exists()
    try:
        with folder.lock():
            yield folder
    except BaseException:
        with contextlib.suppress(OSError):
            if not had_lock:
                (folder.path / LOCK).unlink(missing_ok=True)
            for above in new_folders:
                above.rmdir()  # an OSError if something is in it
        raise
