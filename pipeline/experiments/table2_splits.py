"""The models of the paper's Table 2 on one split: training, answers, and where they are kept.

One job is several splits for the models on tactile images, whose networks are so small that they
train faster together than one after another; one split for the network on events, which takes
minutes; and one for SLAYER, which takes a hundred times as long.  Each answer of a model to a split
is a file, so that a benchmark that was interrupted goes on with the splits that are missing.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.errors import UserError
from deploy.files import write_json
from deploy.targets.registry import answer
from models.architecture import parse
from pipeline.experiments.study import dataset_for
from pipeline.inputs.splits import draw_check_samples
from pipeline.paper import TABLE2
from pipeline.run.folder import read_stamped, stamp_of
from pipeline.run.history import write_history
from pipeline.settings import Settings

SCHEMA = "stmnist-table2-split/1"
LOIHI_TARGET = "fast"
"""What stands in for the chip; its answers are those of NengoLoihi's emulator, bit for bit."""

TOGETHER = 5
"""Splits of a job at most: more of them train no faster, and an interruption loses more."""


@dataclass(frozen=True)
class Model:
    """A row of the table.

    Attributes
    ----------
    name : str
    title : str
        As printed.
    recipe : str or None
        Of :class:`pipeline.settings.SNN`; None where no rate-based network takes part.
    """

    name: str
    title: str
    recipe: str | None = None

    @property
    def paper(self) -> tuple | None:
        """Mean and SD in the paper's Table 2, if it is there."""
        return TABLE2.get(self.name)


MODELS = {
    model.name: model
    for model in (
        Model("cnn", "CNN"),
        Model("ann-snn", "ANN-SNN", "paper"),
        Model("loihi", "ANN-SNN on Loihi", "paper"),
        Model("slayer", "SNN-SLAYER"),
        Model("own-ann-snn", "ANN-SNN, own recipe", "loihi"),
        Model("own-loihi", "ANN-SNN on Loihi, own recipe", "loihi"),
        Model("events", "SNN on events, own recipe"),
        Model("events-loihi", "SNN on events on Loihi, own recipe"),
    )
}

ON_EVENTS = ("events", "events-loihi")
"""Of one training on the skin's own events."""

SLOW = (*ON_EVENTS, "slayer")
"""Models that are not run unless asked for."""


@dataclass(frozen=True)
class Benchmark:
    """What is to be measured.

    Attributes
    ----------
    settings : Settings
    source_sha256 : str
        Of the recordings that the settings name.
    folder : Path
        Of the results; on a cluster one that all workers see.
    kinds : tuple of str
        ``"random"``, ``"writers"``.
    splits : int
        Of each kind.
    models : tuple of str
        Keys of :data:`MODELS`.
    """

    settings: Settings
    source_sha256: str
    folder: Path
    kinds: tuple
    splits: int
    models: tuple


@dataclass(frozen=True)
class Batch:
    """What one process does at a time.

    Attributes
    ----------
    benchmark : Benchmark
    kind : str
    indices : tuple of int
        Numbers of the splits.
    models : tuple of str
    """

    benchmark: Benchmark
    kind: str
    indices: tuple
    models: tuple

    @property
    def seeds(self) -> list:
        """Of each split, its training and its choice of samples."""
        return [self.benchmark.settings.seed + index for index in self.indices]


def plan(benchmark: Benchmark, processes: int = 1) -> list:
    """Jobs whose results are not there yet: on images, on events, SLAYER's last.

    Parameters
    ----------
    benchmark : Benchmark
    processes : int
        That the splits of one kind are shared among; as many as splits for one split a job.

    Returns
    -------
    list of Batch
    """
    jobs, apart = [], {ON_EVENTS: [], ("slayer",): []}
    for kind in benchmark.kinds:
        groups = {}
        for index in range(benchmark.splits):
            missing = [
                name
                for name in benchmark.models
                if read_split(benchmark, kind, index, name) is None
            ]
            for together, batches in apart.items():
                if alone := tuple(name for name in missing if name in together):
                    batches.append(Batch(benchmark, kind, (index,), alone))
            if rest := tuple(name for name in missing if name not in SLOW):
                groups.setdefault(rest, []).append(index)
        for models, indices in groups.items():
            size = min(TOGETHER, -(-len(indices) // processes))
            jobs += [
                Batch(benchmark, kind, tuple(indices[start : start + size]), models)
                for start in range(0, len(indices), size)
            ]
    return jobs + [batch for batches in apart.values() for batch in batches]


def split_path(folder: Path, kind: str, index: int, model: str) -> Path:
    """Where the result of a model on a split is."""
    return Path(folder) / "splits" / f"{kind}-{index:02d}" / f"{model}.json"


def splits_there(folder: Path, kind: str, model: str) -> list:
    """Numbers of the splits that have a result of a model, of whatever settings."""
    paths = (Path(folder) / "splits").glob(f"{kind}-*/{model}.json")
    return sorted(int(path.parent.name.rsplit("-", 1)[1]) for path in paths)


def read_split(benchmark: Benchmark, kind: str, index: int, model: str) -> dict | None:
    """The result of a model on a split, or None if it is missing or of other settings."""
    path = split_path(benchmark.folder, kind, index, model)
    return read_stamped(path, stamp(benchmark, model))


def write_splits(batch: Batch, results: list):
    """Write what :func:`measure` returned, and each training's learning curve beside it."""
    for result in results:
        path = split_path(batch.benchmark.folder, batch.kind, result["index"], result["model"])
        write_history(path.with_suffix(".csv"), result["history"])
        write_json(path, result)


def measure(batch: Batch) -> list:
    """Train and test the models of a batch on its splits.

    Each result is written as soon as it is there, so that an interruption loses little.

    Returns
    -------
    list of dict
        One a model and split; for :func:`write_splits` where a worker has not the same disk.
    """
    work, kind = _measure_on_images, "image"
    if batch.models == ("slayer",):
        work = _measure_slayer
    elif set(batch.models) <= set(ON_EVENTS):
        work, kind = _measure_on_events, "events"
    settings = batch.benchmark.settings
    settings = replace(settings, input=replace(settings.input, kind=kind))
    batch = replace(batch, benchmark=replace(batch.benchmark, settings=settings))
    dataset = dataset_for(settings, batch.benchmark.source_sha256)
    fraction = settings.split.test_fraction
    divided = [dataset.divided(seed, fraction, batch.kind) for seed in batch.seeds]
    results = []
    for position, *rest in work(batch, divided):
        results.append(_result(batch, divided[position], position, *rest))
        write_splits(batch, results[-1:])
    return results


def _measure_on_images(batch, divided):
    from pipeline.training import stacked  # TensorFlow, in the process that needs it

    settings, count = batch.benchmark.settings, len(divided)
    data = divided[0].inputs, divided[0].labels
    parts = [dataset.split.train for dataset in divided]
    recipes = {MODELS[name].recipe for name in batch.models}
    cnns = [None] * count
    if recipes & {None, "loihi"}:
        begun = time.perf_counter()
        cnns = stacked.train_cnns(settings, data, parts, batch.seeds)
        seconds = (time.perf_counter() - begun) / count
    if "cnn" in batch.models:
        for position, (dataset, cnn) in enumerate(zip(divided, cnns, strict=True)):
            predictions = cnn.logits(dataset.part("test")[0]).argmax(1)
            yield position, "cnn", dataset.split.test, predictions, cnn.history, seconds
    for recipe in ("paper", "loihi"):
        names = [name for name in batch.models if MODELS[name].recipe == recipe]
        if not names:
            continue
        of_recipe = replace(settings, snn=replace(settings.snn, recipe=recipe))
        begun = time.perf_counter()
        nets = stacked.train_rate_networks(
            of_recipe, data, parts, batch.seeds, [cnn and cnn.weights for cnn in cnns]
        )
        trained = (time.perf_counter() - begun) / count
        for position, (dataset, net) in enumerate(zip(divided, nets, strict=True)):
            for name in names:
                begun = time.perf_counter()
                answers = _spiking_answers if name.endswith("ann-snn") else _loihi_answers
                seed = batch.seeds[position]
                shown, predictions = answers(of_recipe, net.weights, dataset, seed)
                seconds = trained + time.perf_counter() - begun
                yield position, name, shown, predictions, net.history, seconds


def _spiking_answers(settings, weights, dataset, seed):
    """All test samples, by NengoDL with spiking neurons."""
    from pipeline.training import nengodl

    settings = replace(settings, seed=seed)
    shown = dataset.part("test")[0]
    return dataset.split.test, nengodl.predict(settings, weights, shown, settings.steps)


def _loihi_answers(settings, weights, dataset, seed):
    """As many test samples as the check has, by what stands in for the chip."""
    from pipeline.run.conversion import deployed

    shown = draw_check_samples(dataset.split.test, settings.check.samples, seed)
    spec = deployed(settings, weights, {}, dataset.part("train"))
    return shown, answer(spec, dataset.inputs[shown], LOIHI_TARGET, seed).predictions


def _measure_on_events(batch, divided):
    from pipeline.run.event_training import train_for_chip

    settings = batch.benchmark.settings
    for position, (dataset, index) in enumerate(zip(divided, batch.indices, strict=True)):
        seed, test = batch.seeds[position], dataset.split.test
        path = split_path(batch.benchmark.folder, batch.kind, index, "events")
        checkpoint = path.with_suffix(".npz")
        begun = time.perf_counter()
        net, spec = train_for_chip(settings, dataset, seed, checkpoint)
        trained = time.perf_counter() - begun
        for name in batch.models:
            begun = time.perf_counter()
            if name == "events":
                shown, predictions = test, net.logits(dataset.inputs[test]).argmax(1)
            else:
                shown = draw_check_samples(test, settings.check.samples, seed)
                predictions = answer(spec, dataset.inputs[shown], LOIHI_TARGET, seed).predictions
            seconds = trained + time.perf_counter() - begun
            yield position, name, shown, predictions, net.history, seconds
        checkpoint.unlink(missing_ok=True)


def _measure_slayer(batch, divided):
    from pipeline.inputs.frames import bin_events
    from pipeline.training.slayer import train_slayer

    slayer, recordings = batch.benchmark.settings.slayer, divided[0].recordings
    frames = bin_events(recordings, slayer.bins)
    architecture, classes = parse(slayer.architecture), len(recordings.sensor.classes)
    if (architecture.input_shape, architecture.outputs) != (frames.shape[2:], classes):
        size = "x".join(map(str, frames.shape[2:]))
        raise UserError(
            f"{recordings.source.name}: 'slayer.architecture' must be for {size}, a channel for "
            f"each polarity, and {classes} classes, not {slayer.architecture}"
        )
    for position, (dataset, index) in enumerate(zip(divided, batch.indices, strict=True)):
        path = split_path(batch.benchmark.folder, batch.kind, index, "slayer")
        trained = train_slayer(
            slayer,
            frames,
            recordings.labels,
            dataset.split.train,
            dataset.split.test,
            batch.seeds[position],
            path.with_suffix(".npz"),
            duration_s=recordings.sensor.duration_s,
        )
        seconds = sum(row["seconds"] for row in trained.history)
        predictions = trained.counts.argmax(1)
        yield position, "slayer", dataset.split.test, predictions, trained.history, seconds


def _result(batch, dataset, position, model, shown, predictions, history, seconds):
    labels, source = dataset.labels[shown], dataset.recordings.source
    return {
        "schema": SCHEMA,
        "model": model,
        "split": batch.kind,
        "index": batch.indices[position],
        "seed": batch.seeds[position],
        "simulated": source.simulated,
        "source_sha256": source.sha256,
        "made_from": stamp(batch.benchmark, model),
        "n_train": len(dataset.split.train),
        "n_test": len(shown),
        "accuracy": float(np.mean(predictions == labels)),
        "samples": [int(i) for i in shown],
        "labels": [int(digit) for digit in labels],
        "predictions": [int(digit) for digit in predictions],
        "history": history,
        "seconds": seconds,
    }


def stamp(benchmark: Benchmark, model: str) -> str:
    """Hash of all that a model's result depends on, and of nothing else."""
    settings = benchmark.settings
    common = (__version__, benchmark.source_sha256, settings.seed, settings.split.test_fraction)
    if model == "slayer":
        return stamp_of(*common, asdict(settings.slayer))
    if model in ON_EVENTS:
        shown = settings.input  # whose kind is of the run, and images' by default
        parts = [
            (shown.step, shown.refractory),
            asdict(settings.events),
            asdict(settings.presentation),
        ]
        if model == "events-loihi":
            parts.append(settings.deployment.pop_type)
    else:
        parts = [asdict(settings.image), asdict(settings.cnn)]
    if MODELS[model].recipe:
        parts += [
            {**asdict(settings.snn), "recipe": MODELS[model].recipe},
            asdict(settings.deployment),
            asdict(settings.presentation),
        ]
    if model.endswith("loihi"):
        parts += [asdict(settings.check), LOIHI_TARGET]
    return stamp_of(*common, *parts)
