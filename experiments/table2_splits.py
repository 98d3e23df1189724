"""The models of the paper's Table 2 on one split: the origin of a result, and its measurement.

A result of a model on a split is an artifact of its own, so that a benchmark that was interrupted
continues with the results that are missing.  The models of a split share its trained networks.  The
number of a split is its seed, so that benchmarks with other first seeds share splits.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.targets.registry import answer
from experiments.slayer import Slayer, train_slayer
from pipeline import stages
from pipeline.artifacts import Origin
from pipeline.data.dataset import dataset_origin
from pipeline.data.splits import draw_check_samples
from pipeline.paper import TABLE2
from pipeline.results.study import Task, on_input, on_split, silent
from pipeline.roads.origins import bundle_origin, cnn_origin, rates_origin, threshold_origin
from pipeline.settings import Settings
from pipeline.training.checkpoint import Checkpoint
from pipeline.training.history import read_history, write_history

SCHEMA = "stmnist-table2-split/1"
LOIHI_TARGET = "fast"
"""The target that replaces the chip; bit-identical to NengoLoihi's emulator."""


@dataclass(frozen=True)
class Model:
    """A row of the table.

    Attributes
    ----------
    name : str
    title : str
        As printed.
    recipe : str or None
        Recipe of :class:`pipeline.settings.SNN`; None without a rate-based network.
    """

    name: str
    title: str
    recipe: str | None = None

    @property
    def paper(self) -> tuple | None:
        """Mean and SD in the paper's Table 2, or None."""
        return TABLE2.get(self.name)


MODELS = {
    model.name: model
    for model in (
        Model("cnn", "CNN"),
        Model("ann-snn", "ANN-SNN", "paper"),
        Model("loihi", "ANN-SNN on Loihi", "paper"),
        Model("slayer", "SNN-SLAYER"),
        Model("slayer-small", "SNN-SLAYER, smaller initial weights"),
        Model("own-ann-snn", "ANN-SNN, own recipe", "loihi"),
        Model("own-loihi", "ANN-SNN on Loihi, own recipe", "loihi"),
        Model("events", "SNN on events, own recipe"),
        Model("events-loihi", "SNN on events on Loihi, own recipe"),
    )
}

ON_EVENTS = ("events", "events-loihi")
"""Models of the network trained on events."""

WITH_SLAYER = ("slayer", "slayer-small")
"""Models trained with SLAYER: with the initial weights of its authors' code, and of a tenth."""

ON_REQUEST = (*ON_EVENTS, "slayer-small")
"""Models that are not in the paper's table and take long."""

SMALL_CONV_SCALE = 10.0
"""``conv_scale`` of ``slayer-small``."""

SECONDS_PER_SAMPLE = 1.5e-3
"""Processor time that an epoch of SLAYER takes for each training sample, on an AMD EPYC."""


@dataclass(frozen=True)
class Benchmark:
    """The results to be measured.

    Attributes
    ----------
    settings : Settings
    source_sha256 : str
        SHA-256 of the recordings that the settings name.
    folder : Path
        Folder of the results; on a cluster one that all workers can access.
    kinds : tuple of str
        ``"random"``, ``"writers"``.
    splits : int
        Number of splits of each kind, with the seeds from the settings' own on.
    models : tuple of str
        Keys of :data:`MODELS`.
    on_events : Settings, optional
        The settings of models on events, if these need another presentation.
    """

    settings: Settings
    source_sha256: str
    folder: Path
    kinds: tuple
    splits: int
    models: tuple
    on_events: Settings | None = None

    def groups(self) -> list:
        """The requested results in groups that share trained networks.

        Returns
        -------
        list of list of Task
            Models on images first, then on events, then SLAYER, which takes longest.
        """
        groups = []
        images = tuple(name for name in MODELS if name not in (*ON_EVENTS, *WITH_SLAYER))
        for together in (images, ON_EVENTS, *((name,) for name in WITH_SLAYER)):
            asked = [name for name in together if name in self.models]
            for kind in self.kinds:
                groups += [
                    [self.task(kind, seed, name) for name in asked] for seed in self.seeds if asked
                ]
        return groups

    @property
    def seeds(self) -> range:
        """Seeds of the requested splits."""
        return range(self.settings.seed, self.settings.seed + self.splits)

    def task(self, kind: str, seed: int, model: str) -> Task:
        """The result of a model on a split."""
        settings = on_split(self.settings_of(model), seed)
        origin = result_origin(settings, dataset_origin(settings, self.source_sha256, kind), model)
        name, file = f"{model}, {kind} split {seed}", split_file(kind, seed, model)
        more = {"split": kind, "subject": model}
        return Task.of(self.folder, file, name, origin, settings, self.source_sha256, **more)

    def settings_of(self, model: str) -> Settings:
        """The settings with the input and the recipe of a model."""
        settings = self.settings
        if model in ON_EVENTS and self.on_events is not None:
            settings = self.on_events
        settings = on_input(settings, input_of(model))
        if recipe := MODELS[model].recipe:
            settings = replace(settings, snn=replace(settings.snn, recipe=recipe))
        return settings

    def results(self, kind: str, model: str) -> list:
        """The current results of a model, whether requested now or earlier.

        Those of splits before the first requested one are left out.
        """
        found = []
        paths = self.folder.glob(split_file(kind, "*", model))
        for seed in sorted(int(path.parent.name.rsplit("-", 1)[1]) for path in paths):
            state = self.task(kind, seed, model).artifact.state()
            if state.is_current and seed >= self.settings.seed:
                found.append({**state.record, "seed": seed})
        return found


def input_of(model: str) -> str:
    """The ``input.kind`` of a model's settings."""
    return "events" if model in ON_EVENTS else "image"


def result_origin(settings: Settings, dataset: Origin, model: str) -> Origin:
    """The origin of the result of a model on a split.

    Parameters
    ----------
    settings : Settings
        From :meth:`Benchmark.settings_of`.
    dataset : Origin
    model : str
    """
    schema = {"schema": SCHEMA}
    if model in WITH_SLAYER:
        contents = {**schema, "slayer": repr(recipe_of(model))}
        return Origin.of(settings, ["seed"], [dataset], contents)
    if model.endswith("loihi"):
        contents = {**schema, "target": LOIHI_TARGET}
        return Origin.of(settings, uses=[bundle_origin(settings, dataset)], contents=contents)
    if model == "events":
        return Origin.of(settings, uses=[threshold_origin(settings, dataset)], contents=schema)
    if model == "cnn":
        return Origin.of(settings, uses=[cnn_origin(settings, dataset)], contents=schema)
    reads = ["deployment.synapse", "presentation.steps", "presentation.readout_start"]
    return Origin.of(settings, reads, [rates_origin(settings, dataset)], schema)


def split_file(kind: str, seed, model: str) -> str:
    """The file of the result of a model on a split, or for ``"*"`` the pattern of all of them."""
    number = seed if seed == "*" else f"{seed:02d}"
    return f"splits/{kind}-{number}/{model}.json"


def measure(task: Task) -> dict:
    """Train and test a model on a split.

    Returns
    -------
    dict
        ``accuracy`` on ``n_test`` samples, their numbers (``samples``), ``labels`` and
        ``predictions``, the training's ``history`` and ``seconds``.
    """
    begun = time.perf_counter()
    dataset, model = task.dataset(), task.subject
    if model in WITH_SLAYER:
        indices, predictions, history = _slayer(task, dataset)
    else:
        indices, predictions, history = _on_chip_or_before(task, dataset)
    labels, source = dataset.labels[indices], dataset.recordings.source
    return {
        "schema": SCHEMA,
        "model": model,
        "split": task.split,
        "seed": task.seed,
        "simulated": source.simulated,
        "source_sha256": source.sha256,
        "n_train": len(dataset.split.train),
        "n_test": len(indices),
        "accuracy": float(np.mean(predictions == labels)),
        "samples": [int(i) for i in indices],
        "labels": [int(label) for label in labels],
        "predictions": [int(label) for label in predictions],
        "history": history,
        "seconds": time.perf_counter() - begun,
    }


def _on_chip_or_before(task, dataset):
    """Test samples, predictions and training history of a model that a run also has."""
    settings, model, test = task.settings, task.subject, dataset.split.test
    if model == "cnn":
        name = "cnn"
        stages.train(name, task.networks, settings, dataset, silent)
    else:
        name = "events" if settings.on_events else "rate-lif"
        task.trained(dataset)
    network = stages.network_artifact(name, task.networks, settings, dataset.origin)
    history = read_history(network.folder / "history.csv")
    if model.endswith("loihi"):
        indices = draw_check_samples(test, settings.check.drawn(len(test)), settings.seed)
        spec = stages.spec_of(task.networks, settings, dataset, {})
        answers = answer(spec, dataset.inputs[indices], LOIHI_TARGET, settings.seed)
        return indices, answers.predictions, history
    weights = stages.read_weights(network.folder, settings)
    images = dataset.inputs[test]
    if model == "cnn":
        from pipeline.training.networks import TrainedCNN  # TensorFlow, where it is needed

        return test, TrainedCNN(settings, weights).logits(images).argmax(1), history
    if model == "events":
        from pipeline.training.events import TrainedOnEvents

        return test, TrainedOnEvents.of(settings, weights).logits(images).argmax(1), history
    from pipeline.training import nengodl

    return test, nengodl.predict(settings, weights, images, settings.steps), history


def recipe_of(model: str) -> Slayer:
    """The recipe of a model with SLAYER."""
    return Slayer(conv_scale=SMALL_CONV_SCALE) if model == "slayer-small" else Slayer()


def checkpoint_of(task: Task) -> Checkpoint:
    """The state of a training with SLAYER, which more epochs continue."""
    file = task.artifact.record.with_suffix(".npz")
    return Checkpoint(file, task.origin.key)


def _slayer(task, dataset):
    from pipeline.data.frames import bin_events

    slayer, recordings = recipe_of(task.subject), dataset.recordings
    checkpoint = checkpoint_of(task)
    trained = train_slayer(
        slayer,
        bin_events(recordings, slayer.bins),
        recordings.labels,
        dataset.split.train,
        dataset.split.test,
        task.seed,
        checkpoint,
        duration_s=recordings.sensor.duration_s,
    )
    write_history(checkpoint.path.with_suffix(".csv"), trained.history)
    return dataset.split.test, trained.counts.argmax(1), trained.history
