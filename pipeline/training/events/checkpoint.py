"""Train epoch by epoch, and store the state after each epoch."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deploy.files import read_arrays, reporting_damage, write_arrays

# The remedy for a damaged checkpoint.
FROM_THE_START = "delete it to train from the start"


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
    train, epochs: int, state: dict, checkpoint: Checkpoint | None = None, watch=None, advance=None
) -> list:
    """Train, and store the state after each epoch.

    Parameters
    ----------
    train : callable
        ``train(epoch) -> dict``, ``loss`` and ``accuracy`` of an epoch, counted from 0.
    epochs : int
    state : dict of str to ndarray or tf.Variable
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
    history = [] if checkpoint is None else _resume(checkpoint, state, epochs)
    if advance is not None and history:
        advance(len(history), _make_note(history))
    for epoch in range(len(history), epochs):
        begun = time.perf_counter()
        row = {"epoch": epoch + 1, **train(epoch), "seconds": time.perf_counter() - begun}
        history.append(row | (watch() if watch else {}))
        if checkpoint is not None:
            _store(checkpoint, state, history)
        if advance is not None:
            advance(1, _make_note(history))
    return history


def _store(checkpoint, state, history):
    arrays = {name: np.asarray(variable) for name, variable in state.items()}
    key = np.array(checkpoint.key)
    text = np.array(json.dumps(history))
    write_arrays(checkpoint.path, key=key, history=text, **arrays)


def _resume(checkpoint, state, epochs):
    """The history of an earlier session, after restoring its state."""
    path = checkpoint.path
    if not path.exists():
        return []
    kept = read_arrays(path, FROM_THE_START)
    with reporting_damage(path, FROM_THE_START):
        if "key" not in kept or str(kept["key"]) != checkpoint.key:
            return []
        history = json.loads(str(kept["history"]))
        if len(history) > epochs:
            return []
        if [row["epoch"] for row in history] != list(range(1, len(history) + 1)):
            raise ValueError("epochs that do not follow each other")
        _make_note(history)
        for name, variable in state.items():
            if isinstance(variable, np.ndarray):
                variable[...] = kept[name]
            else:
                variable.assign(kept[name])
        return history


def _make_note(history):
    return f"accuracy {history[-1]['accuracy']:.3f}" if history else ""
