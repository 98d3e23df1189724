"""The paper's Table 2: its four models on the same splits, and this project's recipe beside them.

One job is several splits for the models on tactile images, whose networks are so small that they
train faster together than one after another; and one split for SLAYER, which takes a hundred times
as long.  Each answer of a model to a split is a file, so that a benchmark that was interrupted goes
on with the splits that are missing.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.errors import UserError
from deploy.files import write_json
from deploy.targets.registry import TARGETS, answer
from pipeline.inputs.images import tactile_images
from pipeline.inputs.library import recordings_of
from pipeline.inputs.splits import Split, draw_check_samples, random_split, writer_split
from pipeline.run.folder import read_stamped, stamp_of
from pipeline.run.history import write_history
from pipeline.settings import Settings

SCHEMA = "stmnist-table2-split/1"
KINDS = ("random", "writers")
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
    paper : tuple of float or None
        Mean and SD in the paper's Table 2.
    recipe : str or None
        Of :class:`pipeline.settings.SNN`; None where no rate-based network takes part.
    """

    name: str
    title: str
    paper: tuple | None
    recipe: str | None = None


MODELS = {
    model.name: model
    for model in (
        Model("cnn", "CNN", (0.89, 0.01)),
        Model("ann-snn", "ANN-SNN", (0.87, 0.01), "paper"),
        Model("loihi", "ANN-SNN on Loihi", (0.86, 0.02), "paper"),
        Model("slayer", "SNN-SLAYER", (0.81, 0.01)),
        Model("own-ann-snn", "ANN-SNN, own recipe", None, "loihi"),
        Model("own-loihi", "ANN-SNN on Loihi, own recipe", None, "loihi"),
    )
}


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
class Job:
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


def split_of(recordings, settings: Settings, kind: str, seed: int) -> Split:
    """The split of a job.

    Raises
    ------
    ValueError
        Too few samples, or writers that are not known.
    """
    if kind == "writers":
        return writer_split(recordings.writers, seed, settings.split.test_fraction)
    return random_split(len(recordings), seed, settings.split.test_fraction)


def loihi_target() -> str:
    """What stands in for the chip: the fast emulator where there is one, else NengoLoihi's."""
    return "fast" if "fast" in TARGETS else "emulator"


def plan(benchmark: Benchmark, processes: int = 1) -> list:
    """Jobs whose results are not there yet, SLAYER's last.

    Parameters
    ----------
    benchmark : Benchmark
    processes : int
        That the splits of one kind are shared among; as many as splits for one split a job.

    Returns
    -------
    list of Job
    """
    jobs, slayer = [], []
    for kind in benchmark.kinds:
        groups = {}
        for index in range(benchmark.splits):
            missing = [
                name
                for name in benchmark.models
                if read_split(benchmark, kind, index, name) is None
            ]
            if "slayer" in missing:
                slayer.append(Job(benchmark, kind, (index,), ("slayer",)))
                missing.remove("slayer")
            if missing:
                groups.setdefault(tuple(missing), []).append(index)
        for models, indices in groups.items():
            size = min(TOGETHER, -(-len(indices) // processes))
            jobs += [
                Job(benchmark, kind, tuple(indices[start : start + size]), models)
                for start in range(0, len(indices), size)
            ]
    return jobs + slayer


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


def of_this_version(job: Job, results: list) -> bool:
    """Whether a worker's results are what this package would have made."""
    return all(result["made_from"] == stamp(job.benchmark, result["model"]) for result in results)


def write_splits(job: Job, results: list):
    """Write what :func:`run` returned, and each training's learning curve beside it."""
    for result in results:
        path = split_path(job.benchmark.folder, job.kind, result["index"], result["model"])
        write_history(path.with_suffix(".csv"), result["history"])
        write_json(path, result)


def run(job: Job) -> list:
    """Do a job: train and test its models on its splits.

    Each result is written as soon as it is there, so that an interruption loses little.

    Returns
    -------
    list of dict
        One a model and split; for :func:`write_splits` where a worker has not the same disk.
    """
    settings = job.benchmark.settings
    recordings = recordings_of(settings.data)
    if recordings.source.sha256 != job.benchmark.source_sha256:
        raise UserError(f"{settings.data.source}: the worker has other recordings there")
    splits = [split_of(recordings, settings, job.kind, seed) for seed in job.seeds]
    work = _run_slayer if job.models == ("slayer",) else _run_on_images
    results = []
    for position, *rest in work(job, recordings, splits):
        results.append(_result(job, recordings, splits[position], position, *rest))
        write_splits(job, results[-1:])
    return results


def _run_on_images(job, recordings, splits):
    from pipeline.training import networks as training
    from pipeline.training import (  # TensorFlow, in the process that needs it
        stacked as joint_training,
    )

    settings, count = job.benchmark.settings, len(splits)
    images = tactile_images(recordings, settings.image.aggregation, settings.image.normalisation)
    data = images, recordings.labels
    parts = [split.train for split in splits]
    recipes = {MODELS[name].recipe for name in job.models}
    cnns = [None] * count
    if recipes & {None, "loihi"}:
        begun = time.perf_counter()
        cnns = joint_training.train_cnns(settings, data, parts, job.seeds)
        seconds = (time.perf_counter() - begun) / count
    if "cnn" in job.models:
        for position, (split, cnn) in enumerate(zip(splits, cnns, strict=True)):
            logits = training.cnn_logits(settings, cnn.weights, images[split.test])
            yield position, "cnn", split.test, logits.argmax(1), cnn.history, seconds
    for recipe in ("paper", "loihi"):
        names = [name for name in job.models if MODELS[name].recipe == recipe]
        if not names:
            continue
        of_recipe = replace(settings, snn=replace(settings.snn, recipe=recipe))
        begun = time.perf_counter()
        nets = joint_training.train_rate_networks(
            of_recipe, data, parts, job.seeds, [cnn and cnn.weights for cnn in cnns]
        )
        trained = (time.perf_counter() - begun) / count
        for position, (split, net) in enumerate(zip(splits, nets, strict=True)):
            for name in names:
                begun = time.perf_counter()
                answers = _spiking_answers if name.endswith("ann-snn") else _loihi_answers
                shown, predictions = answers(
                    of_recipe, net.weights, images, split, job.seeds[position]
                )
                seconds = trained + time.perf_counter() - begun
                yield position, name, shown, predictions, net.history, seconds


def _spiking_answers(settings, weights, images, split, seed):
    """All test samples, by NengoDL with spiking neurons."""
    from pipeline.training import nengodl

    steps = settings.presentation.steps
    return split.test, nengodl.predict(settings, weights, images[split.test], steps)


def _loihi_answers(settings, weights, images, split, seed):
    """As many test samples as the check has, by what stands in for the chip."""
    from pipeline.run.conversion import deployed

    shown = draw_check_samples(split.test, settings.check.samples, seed)
    spec = deployed(settings, weights, {}, images[split.train])
    return shown, answer(spec, images[shown], loihi_target(), seed).predictions


def _run_slayer(job, recordings, splits):
    from pipeline.inputs.frames import bin_events
    from pipeline.training.slayer import train_slayer

    slayer = job.benchmark.settings.slayer
    frames = bin_events(recordings, slayer.bins)
    for position, (split, index) in enumerate(zip(splits, job.indices, strict=True)):
        path = split_path(job.benchmark.folder, job.kind, index, "slayer")
        trained = train_slayer(
            slayer,
            frames,
            recordings.labels,
            split.train,
            split.test,
            job.seeds[position],
            path.with_suffix(".npz"),
        )
        seconds = sum(row["seconds"] for row in trained.history)
        predictions = trained.counts.argmax(1)
        yield position, "slayer", split.test, predictions, trained.history, seconds


def _result(job, recordings, split, position, model, shown, predictions, history, seconds):
    labels = recordings.labels[shown]
    return {
        "schema": SCHEMA,
        "model": model,
        "split": job.kind,
        "index": job.indices[position],
        "seed": job.seeds[position],
        "simulated": recordings.source.simulated,
        "source_sha256": recordings.source.sha256,
        "made_from": stamp(job.benchmark, model),
        "n_train": len(split.train),
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
    parts = [asdict(settings.image), asdict(settings.cnn)]
    if MODELS[model].recipe:
        parts += [
            {**asdict(settings.snn), "recipe": MODELS[model].recipe},
            asdict(settings.deployment),
            asdict(settings.presentation),
        ]
    if model.endswith("loihi"):
        parts += [asdict(settings.check), loihi_target()]
    return stamp_of(*common, *parts)
