"""Cross-validation over writers: networks for people whose handwriting was not used before.

The people of a file of pen trajectories are divided into folds.  For each fold the model of
handwriting is estimated from all other people, a network is trained on recordings simulated with
it, and the fold's own trajectories are pressed on the same simulated skin.  The simulation's
calibration is the built-in one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import sha256_of
from experiments.adaptation import METHODS, Plan, Subjects, methods_text, summary_of
from pipeline import stages
from pipeline.artifacts import Origin
from pipeline.data.dataset import Dataset, dataset_origin
from pipeline.data.events import Recordings, Source
from pipeline.data.library import simulated
from pipeline.data.splits import split_of
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.results.study import Findings, Task, Workers, concluded, study, successful
from pipeline.roads.origins import bundle_origin
from pipeline.run import RunFolder
from pipeline.settings import SIMULATED, Settings
from pipeline.skin import handwriting, parameters, unipen
from pipeline.skin.simulate import source_of
from pipeline.training.adaptation import with_rehearsal

SCHEMA = "stmnist-rotation/1"

NETWORK = ("fold", "fitted", "accuracy", "n_train", "n_test", "training_sha256", "people_sha256")
"""Values of the summary for the network of each fold."""


@dataclass(frozen=True)
class Fold:
    """Some people of a file, and the training data of a network for them.

    Attributes
    ----------
    index : int
    traces : tuple of Trace
        The pen trajectories of the fold's people.
    parameters : Parameters
        Parameters of the simulation, with the model of handwriting of the other people.
    fitted : int
        Number of people from whom the model was estimated.
    """

    index: int
    traces: tuple
    parameters: parameters.Parameters
    fitted: int

    def source(self, settings: Settings) -> Source:
        """Name and hash of :meth:`training`, without simulating it."""
        return source_of(*_training(settings), parameters=self.parameters)

    def training(self, settings: Settings) -> Dataset:
        """Recordings simulated with the model of the other people's handwriting, and their split.

        Parameters
        ----------
        settings : Settings
            The number of recordings is ``data.samples_per_digit``, the seed
            ``data.simulation_seed``.
        """
        recordings = simulated(*_training(settings), 1, parameters=self.parameters)
        shares = settings.split.test_fraction, settings.split.validation_fraction
        split = split_of(recordings, settings.seed, *shares)
        origin = dataset_origin(settings, recordings.source.sha256)
        return Dataset(recordings, split, origin, settings)

    def people_source(self, settings: Settings) -> Source:
        """Name and hash of :meth:`people`, without simulating them."""
        seed, counts = self._pressed(settings)
        return source_of(seed, counts, parameters=self.parameters, traces=self.traces)

    def people(self, settings: Settings) -> Recordings:
        """The fold's trajectories, each pressed on the skin once."""
        seed, counts = self._pressed(settings)
        return simulated(seed, counts, 1, parameters=self.parameters, traces=self.traces)

    def _pressed(self, settings):
        counts = np.bincount([trace.digit for trace in self.traces], minlength=10)
        return settings.data.simulation_seed, counts


def fold_of(pen: Path, index: int, folds: int, most: int = 0) -> Fold:
    """Fold number ``index`` of the people of a file: every ``folds``-th of them.

    Parameters
    ----------
    pen : Path
        UNIPEN file.
    index, folds : int
    most : int
        Maximum number of other people from whom the model is estimated, the first ones; 0 for
        all.

    Raises
    ------
    UserError
        The file cannot be read, or too few people remain to estimate the model from.
    """
    traces = unipen.read(pen)
    writers = sorted({trace.writer for trace in traces if trace.writer >= 0})
    people = set(writers[index::folds])
    others = [writer for writer in writers if writer not in people]
    others = set(others[: most or None])
    try:
        shapes = handwriting.estimate([trace for trace in traces if trace.writer in others])
    except ValueError as error:
        raise UserError(
            f"{pen}: {error} of the {len(others)} writers that fold {index} leaves; "
            "give a file of more people, or more folds"
        ) from error
    return Fold(
        index,
        tuple(trace for trace in traces if trace.writer in people),
        replace(parameters.load(), shapes=shapes),
        len(others),
    )


def _training(settings):
    """Seed and counts of the training recordings."""
    each = settings.data.samples_per_digit
    return settings.data.simulation_seed, [each] * 10 if each else list(SAMPLES_PER_DIGIT)


@dataclass(frozen=True)
class Rotation:
    """Measurements on the people of a file.

    Attributes
    ----------
    pen : Path
        UNIPEN file.
    plan : Plan
    folds : int
    most : int
        See :func:`fold_of`.
    methods : tuple of str
        Keys of :data:`experiments.adaptation.METHODS`.
    """

    pen: Path
    plan: Plan
    folds: int = 3
    most: int = 0
    methods: tuple = ("readout",)


def measure_rotation(
    rotation: Rotation, folder: RunFolder, settings: Settings, workers: Workers, say
) -> Findings:
    """Measure missing or outdated folds, and write the summary over all people.

    Parameters
    ----------
    rotation : Rotation
    folder : RunFolder
        Folder of the results, locked.
    settings : Settings
        Settings of the networks, on simulated recordings.
    workers, say
        As in :func:`pipeline.results.study.study`.

    Raises
    ------
    UserError
        The file cannot be read or has too few people.
    CheckFailed
        Every fold failed.
    """
    if settings.data.source != SIMULATED:
        raise UserError(
            "the networks are trained on simulated recordings; leave out data.source, or give "
            "RUN and --data to measure a network that there is"
        )
    groups = []
    for index in range(rotation.folds):
        fold = fold_of(rotation.pen, index, rotation.folds, rotation.most)
        tasks = [
            _task(rotation, fold, method, folder, settings)
            for method in rotation.methods
            if METHODS[method].chosen_on != index
        ]
        groups.append(tasks)
    folder.save_settings(settings)
    results = study("adapt", partial(_measure, rotation), groups, workers, say)
    whole, failed = successful(results)
    summary = {
        "schema": SCHEMA,
        "pen_sha256": sha256_of(rotation.pen),
        "simulated": True,
        "input": settings.input.kind,
        "folds": rotation.folds,
        "seed": rotation.plan.seed,
        "networks": [
            {name: value for name, value in result.items() if name in NETWORK}
            for result in whole
            if result["method"] == whole[0]["method"]
        ],
        "methods": {
            method: summary_of(
                [row for result in whole if result["method"] == method for row in result["rows"]]
            )
            for method in dict.fromkeys(result["method"] for result in whole)
        },
    }
    return concluded(folder, "adapt", summary, failed)


def _task(rotation, fold, method, folder, settings):
    plan = rotation.plan
    source = fold.source(settings).sha256
    contents = {
        "schema": SCHEMA,
        "people": fold.people_source(settings).sha256,
        "method": method,
        "plan": json.dumps([plan.each, plan.draws, plan.seed]),
    }
    if how := METHODS[method].how:
        contents["how"] = how
    made = bundle_origin(settings, dataset_origin(settings, source))
    origin = Origin.of(settings, uses=[made], contents=contents)
    name, file = f"{method}, fold {fold.index}", f"{method}-{fold.index}.json"
    subject = f"{fold.index} {method}"
    return Task.of(folder.path, file, name, origin, settings, source, subject=subject)


def _measure(rotation, task):
    """Fit the network of a fold to the fold's people, which all methods of the fold share."""
    index, method = task.subject.split()
    origin = bundle_origin(task.settings, dataset_origin(task.settings, task.recordings))
    key = origin.key, rotation.pen, int(index)
    if key not in _PREPARED:
        _PREPARED.clear()
        _PREPARED[key] = _prepared(rotation, task, int(index))
    about, subjects = _PREPARED[key]
    return {
        "schema": SCHEMA,
        "method": method,
        **about,
        "rows": subjects.measured(rotation.plan, METHODS[method]),
    }


_PREPARED = {}


def _prepared(rotation, task, index):
    """Train the network of a fold, unless it exists, and run it on the fold's people."""
    fold = fold_of(rotation.pen, index, rotation.folds, rotation.most)
    settings, dataset = task.settings, fold.training(task.settings)
    metrics = task.trained(dataset)
    train = dataset.split.train
    spec = stages.spec_of(task.networks, settings, dataset, {})
    spec = with_rehearsal(spec, dataset.inputs, dataset.labels, train, settings.seed)
    people = fold.people(settings)
    about = {
        "fold": fold.index,
        "fitted": fold.fitted,
        "accuracy": metrics["accuracy"],
        "n_train": len(train),
        "n_test": len(dataset.split.test),
        "training_sha256": dataset.recordings.source.sha256,
        "people_sha256": people.source.sha256,
    }
    return about, Subjects.of(spec, dataset.part("test"), people, rotation.plan)


def rotation_text(summary: dict) -> str:
    """The result of :func:`measure_rotation` as tables."""
    return f"{methods_text(summary)}\nreal pen trajectories pressed on the simulated skin"
