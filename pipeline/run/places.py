"""Checks of the folder of a run, and its removal when a command fails."""

from __future__ import annotations

import contextlib
import difflib
from pathlib import Path

from deploy.errors import UserError
from deploy.interrupts import at_the_end

LOCK = ".lock"
DEEPEST = 3
"""Most folders from a file or bundle of a run up to the run: ``checks/whole/emulator.json``."""

OF_RESULTS = ("splits", "points", "networks", "table2.json", "sweep.json", "*-[0-9]*.json")
"""Names of files and folders that benchmarks and sweeps write, and that runs do not have."""


def run_around(path) -> Path | None:
    """The folder of the run that a file or bundle is in, or None."""
    above = list(Path(path).absolute().parents)[:DEEPEST]
    return next((folder for folder in above if (folder / "experiment.toml").is_file()), None)


def refuse_results(path: Path):
    """Make sure that a folder is not that of a benchmark or sweep.

    Parameters
    ----------
    path : Path

    Raises
    ------
    UserError
        It has results of one, and no ``dataset.json``, which every run has.
    """
    if (path / "dataset.json").exists():
        return
    found = [entry.name for pattern in OF_RESULTS for entry in path.glob(pattern)]
    if found:
        raise UserError(
            f"{path}: is the folder of a benchmark or sweep (it has {found[0]!r}), not of a run; "
            "give another folder as RUN"
        )


def refuse_other_folders(path: Path, of_results: bool = False):
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
        The folder is a bundle or in one, has files that are not those of a run, or is a run where
        results of a benchmark are meant, or the other way round.
    """
    for folder in path.absolute().parents:
        if (folder / "MANIFEST.json").is_file() and (folder / "network.json").is_file():
            raise UserError(
                f"{path}: is in a bundle, {folder}, which may have no other files; "
                "give another folder as RUN"
            )
    if of_results and (path / "dataset.json").is_file():
        raise UserError(
            f"{path}: is a run, whose settings would be replaced; give another folder for "
            "the results"
        )
    if not of_results:
        refuse_results(path)
    if not path.is_dir() or (path / "experiment.toml").exists():
        return
    found = sorted(entry.name for entry in path.iterdir() if not entry.name.startswith("."))
    if "MANIFEST.json" in found:
        run = path.absolute().parent
        meant = f"give its run, {path.parent}" if (run / "experiment.toml").exists() else ""
        raise UserError(f"{path}: is a bundle, not a run; {meant or 'give another folder as RUN'}")
    if found and not of_results:
        raise UserError(
            f"{path}: is not a run (it has no experiment.toml) and not empty "
            f"(it has {found[0]!r}); give a new folder as RUN"
        )


@contextlib.contextmanager
def nothing_left_of_a_failure(path: Path):
    """Remove the folder of a new run if the block fails before anything is saved."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    had_lock = (path / LOCK).exists()

    def leave():
        with contextlib.suppress(OSError):
            if {entry.name for entry in path.iterdir()} <= {LOCK} and not had_lock:
                (path / LOCK).unlink(missing_ok=True)
            for folder in made:
                folder.rmdir()  # an OSError if something is in it

    try:
        with at_the_end(leave):
            yield
    except BaseException:
        leave()
        raise


def similar_run(path: Path) -> Path | None:
    """An existing run with a similar name, which may be the one that the user meant."""
    if path.exists() or not path.parent.is_dir():
        return None
    names = [entry.parent.name for entry in path.parent.glob("*/experiment.toml")]
    found = difflib.get_close_matches(path.name, names, n=1, cutoff=0.75)
    return path.parent / found[0] if found else None
