"""The steps of a run: artifacts, such as a trained network, and how each of them is made.

A kind of network lists its steps (:meth:`pipeline.kinds.kind.NetworkKind.steps`), and one loop
makes those that are missing or outdated (:meth:`pipeline.workflow.opening.OpenedRun.make`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipeline.recordings.dataset import Dataset
from pipeline.settings import Settings
from pipeline.storage.artifacts import Artifact


@dataclass(frozen=True)
class Step:
    """An artifact from which a bundle or a reference stage is made, and the function that makes it.

    Attributes
    ----------
    name : str
    folder : str
        Name of its folder in a run.
    files : tuple of str
        Names of its files, beginning with that of the record, which is written last.
    reads : tuple of str
        Settings and groups of settings that are read to make it, in addition to those of the steps
        that it uses.
    make : callable
        ``make(inputs, artifact)`` writes the files into ``artifact.folder`` and returns the content
        of the record; ``inputs`` is a :class:`StepInputs`.
    uses : tuple of str
        Names of the steps from which it is made; without one it is made from the recordings.
    action : str
        What the user is told: ``"training"``, ``"choosing"`` or ``"reading"``.
    temporary : tuple of str
        Files that are deleted when the step is complete.
    measures : str
        Name of the step whose network has the accuracy in this step's record, if that is another
        step, which then has no accuracy in its own record.
    """

    name: str
    folder: str
    files: tuple
    reads: tuple
    make: Callable
    uses: tuple = ()
    action: str = "training"
    temporary: tuple = ()
    measures: str = ""


@dataclass(frozen=True)
class StepInputs:
    """What a step may read.

    Attributes
    ----------
    settings : Settings
        Only the settings that the step declares; reading another one is an error.
    dataset : Dataset
    find_artifact : callable
        ``find_artifact(name)``: the :class:`pipeline.storage.artifacts.Artifact` of a step that it
        uses.
    read_weights : callable
        ``read_weights(name)``: the trained arrays of a step that is used, by their names.
    say : callable
        Called with a line for the user.
    """

    settings: Settings
    dataset: Dataset
    find_artifact: Callable[[str], Artifact]
    read_weights: Callable[[str], dict]
    say: Callable[[str], None] = print
