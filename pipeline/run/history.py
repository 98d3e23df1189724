"""Learning curves as CSV, one row an epoch: for a spreadsheet, a plot, the report."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from deploy import limits
from deploy.errors import UserError
from deploy.files import open_regular, replacing

REMEDY = "delete it and make it again"


def write_history(path, history: list):
    """Write a training's history.

    Parameters
    ----------
    path : path-like
    history : list of dict
        One an epoch, all with the same keys.  Of a network that was not trained here there is none:
        then no file is there afterwards, nor that of a training before.
    """
    if not history:
        Path(path).unlink(missing_ok=True)
        return
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, fieldnames=list(history[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(history)


def read_history(path) -> list:
    """The inverse of :func:`write_history`; every value as a float.

    Raises
    ------
    UserError
        It cannot be read, or is not a table of numbers with an accuracy of at least one epoch.
    """
    try:
        with open_regular(path, "r", newline="", encoding="utf-8") as file:
            text = file.read(limits.SETTINGS_BYTES * 16)
        rows = [
            {key: float(value) for key, value in row.items()}
            for row in csv.DictReader(io.StringIO(text, newline=""), strict=True)
        ]
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror or error}); {REMEDY}") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path}: not a learning curve ({error}); {REMEDY}") from error
    sound = (
        rows and {"epoch", "accuracy"} <= set(rows[0]) and all(map(math.isfinite, _values(rows)))
    )
    if not sound:
        raise UserError(f"{path}: not a learning curve, or one with gaps; {REMEDY}")
    return rows


def _values(rows):
    return (value for row in rows for value in row.values())
