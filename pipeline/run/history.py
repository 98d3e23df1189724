"""Learning curves as CSV, one row an epoch: for a spreadsheet, a plot, the report."""

from __future__ import annotations

import csv

from deploy.files import replacing


def write_history(path, history: list):
    """Write a training's history.

    Parameters
    ----------
    path : path-like
    history : list of dict
        One an epoch, all with the same keys.
    """
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, fieldnames=list(history[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(history)


def read_history(path) -> list:
    """The inverse of :func:`write_history`; every value as a float."""
    with open(path, newline="", encoding="utf-8") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
