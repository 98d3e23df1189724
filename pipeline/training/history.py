"""Learning curves as CSV files with one row per epoch."""

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
    """Write the history of a training.

    Parameters
    ----------
    path : path-like
    history : list of dict
        One dict per epoch, all with the same keys.  If it is empty, as for a network that was not
        trained here, an existing file is deleted.
    """
    if not history:
        Path(path).unlink(missing_ok=True)
        return
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, fieldnames=list(history[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(history)


def read_history(path) -> list:
    """Read the file of :func:`write_history`; all values are floats.

    Raises
    ------
    UserError
        The file cannot be read, or is not a table of numbers with an accuracy and at least one row.
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
    finite = all(math.isfinite(value) for row in rows for value in row.values())
    if not (rows and finite and {"epoch", "accuracy"} <= set(rows[0])):
        raise UserError(f"{path}: not a learning curve, or one with gaps; {REMEDY}")
    return rows
