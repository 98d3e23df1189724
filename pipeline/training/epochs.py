"""Training epoch by epoch, such that an interruption costs at most one epoch; learning curves.

A learning curve is a CSV file with one row per epoch.
"""

from __future__ import annotations

import csv
import io
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deploy import limits
from deploy.errors import UserError
from deploy.files import open_regular, read_arrays, replacing, reporting_damage, write_arrays

REMEDY = "delete it to train from the start"
MAKE_AGAIN = "delete it and make it again"


@dataclass(frozen=True)
class Checkpoint:
    """The file that stores the state of a training after each epoch.

    Attributes
    ----------
    path : Path
    key : str
        Identifies the training, such as the key of the origin of the network that is trained.  A
        checkpoint with another key is overwritten.
    """

    path: Path
    key: str


def train_epochs(
    train,
    epochs: int,
    state: dict,
    checkpoint: Checkpoint | None = None,
    watch=None,
    advance=None,
) -> list:
    """Train, and store the state after each epoch.

    Parameters
    ----------
    train : callable
        ``train(epoch) -> dict``, ``loss`` and ``accuracy`` of an epoch, counted from 0.
    epochs : int
    state : dict of str to tf.Variable or ndarray
        All values that the next epoch depends on.
    checkpoint : Checkpoint, optional
        If it has the state of this training, the training resumes from it; the result is the same
        as without the interruption.
    watch : callable, optional
        ``watch() -> dict``, further values of the epoch, on samples that are not trained on.
    advance : callable, optional
        ``advance(1, note)`` after each epoch, including those of an earlier session.

    Returns
    -------
    list of dict
        The history, one row per epoch: ``epoch``, the values of ``train``, ``seconds``, the values
        of ``watch``.

    Raises
    ------
    UserError
        The checkpoint is damaged.
    """
    history = [] if checkpoint is None else _resumed(checkpoint, state, epochs)
    if advance is not None and history:
        advance(len(history), _note(history))
    for epoch in range(len(history), epochs):
        begun = time.perf_counter()
        row = {"epoch": epoch + 1, **train(epoch), "seconds": time.perf_counter() - begun}
        history.append(row | (watch() if watch else {}))
        if checkpoint is not None:
            arrays = {name: np.asarray(variable) for name, variable in state.items()}
            text = {"key": checkpoint.key, "history": json.dumps(history)}
            texts = {name: np.array(value) for name, value in text.items()}
            write_arrays(checkpoint.path, **texts, **arrays)
        if advance is not None:
            advance(1, _note(history))
    return history


def _resumed(checkpoint, state, epochs):
    """The history of an earlier session, after restoring its state."""
    path = checkpoint.path
    if not path.exists():
        return []
    kept = read_arrays(path, REMEDY)
    with reporting_damage(path, REMEDY):
        if "key" not in kept or str(kept["key"]) != checkpoint.key:
            return []
        history = json.loads(str(kept["history"]))
        if len(history) > epochs:
            return []
        if [row["epoch"] for row in history] != list(range(1, len(history) + 1)):
            raise ValueError("epochs that do not follow each other")
        _note(history)
        for name, variable in state.items():
            if isinstance(variable, np.ndarray):
                variable[...] = kept[name]
            else:
                variable.assign(kept[name])
        return history


def _note(history):
    return f"accuracy {history[-1]['accuracy']:.3f}" if history else ""


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
        raise UserError(f"{path}: cannot read ({error.strerror or error}); {MAKE_AGAIN}") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path}: not a learning curve ({error}); {MAKE_AGAIN}") from error
    finite = all(math.isfinite(value) for row in rows for value in row.values())
    if not (rows and finite and {"epoch", "accuracy"} <= set(rows[0])):
        raise UserError(f"{path}: not a learning curve, or one with gaps; {MAKE_AGAIN}")
    return rows
