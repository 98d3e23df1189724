"""Completion of option values in the shell."""

from __future__ import annotations

import tomllib
from pathlib import Path

from deploy.files import open_regular

RUNS = 50
"""Maximum number of runs whose recordings are suggested."""


def data_sets(incomplete: str = "") -> list:
    """Recordings that can be given as ``--data``, for the text typed so far.

    Parameters
    ----------
    incomplete : str

    Returns
    -------
    list of str
        ``"simulated"``, the recordings of the runs in ``runs/``, and the zips and folders in the
        folder that is being typed.
    """
    used = {source for path in sorted(Path("runs").glob("*/experiment.toml"))[:RUNS]
            if (source := _source(path))}  # fmt: skip
    here = Path(incomplete if incomplete.endswith("/") else Path(incomplete).parent)
    try:
        near = [
            f"{path}/" if path.is_dir() else str(path)
            for path in sorted(here.iterdir())
            if not path.name.startswith(".") and (path.is_dir() or path.suffix == ".zip")
        ]
    except OSError:
        near = []
    offered = dict.fromkeys(["simulated", *sorted(used), *near])
    return [name for name in offered if name.startswith(incomplete)]


def _source(path):
    """The recordings of a run; empty where its settings cannot be read."""
    try:
        with open_regular(path) as file:
            return str(tomllib.load(file)["data"]["source"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
