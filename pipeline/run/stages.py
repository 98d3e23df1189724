"""The stages of a run: each reads what the one before wrote, and is redone only if out of date."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.check.bundle import Bundle, CheckSet, read_bundle, write_bundle
from deploy.check.intervals import wilson_interval
from deploy.check.results import read_result
from deploy.check.run import run_check
from deploy.errors import UserError
from deploy.files import read_arrays, read_json, write_arrays, write_json
from models.architecture import parse
from pipeline.inputs.images import tactile_images
from pipeline.inputs.library import recordings_of
from pipeline.inputs.splits import Split, draw_check_samples, random_split
from pipeline.progress import progress
from pipeline.recordings.events import Recordings
from pipeline.run.answers import STAGES as REFERENCES
from pipeline.run.answers import rate_activations, reference_result, training_versions
from pipeline.run.diagnosis import activity, fastest_rate, training_lines
from pipeline.run.folder import RunFolder, is_current, stamp_of
from pipeline.run.history import write_history
from pipeline.settings import Settings

REMEDY = "delete its folder and run the command again"
REMEDY_SMALL = "ask for fewer (SAMPLES, or check.samples) or give more data"
REMEDY_CHECK = "delete it and run the command again"


@dataclass(frozen=True)
class Dataset:
    """Recordings as the networks see them.

    Attributes
    ----------
    recordings : Recordings
    images : ndarray, shape (n_samples, 10, 10, 1)
    split : Split
    """

    recordings: Recordings
    images: np.ndarray
    split: Split

    def part(self, name: str):
        """(images, labels) of ``"train"``, ``"validation"`` (None if empty) or ``"test"``."""
        index = getattr(self.split, name)
        return (self.images[index], self.recordings.labels[index]) if len(index) else None


def open_dataset(run: RunFolder, settings: Settings, jobs: int = 2, warn=None) -> Dataset:
    """Load, split and draw the recordings of a run; keep its settings; write ``dataset.json``.

    The settings are kept only now that the recordings are there and enough: a mistaken path or
    number of samples must not stick to the run.

    Raises
    ------
    UserError
        The source cannot be read, or is too small for the split or the check.
    """
    dataset = load_dataset(settings, jobs, warn)
    recordings, split = dataset.recordings, dataset.split
    try:
        draw_check_samples(split.test, settings.check.samples, settings.seed)
    except ValueError as error:
        raise UserError(f"{settings.data.source}: {error}; {REMEDY_SMALL}") from error
    run.save_settings(settings)
    write_json(
        run.dataset,
        {
            "source": recordings.source.name,
            "sha256": recordings.source.sha256,
            "simulated": recordings.source.simulated,
            "written": recordings.source.written,
            "samples": len(recordings),
            "samples_per_digit": np.bincount(recordings.labels, minlength=10).tolist(),
            "train": len(split.train),
            "validation": len(split.validation),
            "test": len(split.test),
        },
    )
    return dataset


def load_dataset(settings: Settings, jobs: int = 2, warn=None) -> Dataset:
    """Load and split recordings and make their tactile images.

    Raises
    ------
    UserError
        The source cannot be read, or is too small for the split.
    """
    data, parts = settings.data, settings.split
    recordings = recordings_of(data, jobs, warn)
    try:
        split = random_split(
            len(recordings), settings.seed, parts.test_fraction, parts.validation_fraction
        )
    except ValueError as error:
        raise UserError(f"{data.source}: {error}; {REMEDY_SMALL}") from error
    images = tactile_images(recordings, settings.image.aggregation, settings.image.normalisation)
    return Dataset(recordings, images, split)


def train(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the CNN, unless it is there already; return its metrics."""
    stamp = cnn_stamp(settings, dataset)
    weights, metrics = run.cnn / "weights.npz", run.cnn / "metrics.json"
    if is_current(metrics, stamp, weights):
        say(f"cnn: up to date ({metrics.parent})")
        return read_json(metrics, REMEDY)
    from pipeline.training import (
        networks as training,  # imports TensorFlow: ten seconds that a finished stage can spare
    )

    begun = time.perf_counter()
    with progress("train cnn", settings.cnn.epochs) as advance:
        trained = training.train_cnn(
            settings,
            dataset.part("train"),
            settings.seed,
            dataset.part("validation"),
            advance,
        )
    seconds = time.perf_counter() - begun
    logits = training.cnn_logits(settings, trained.weights, dataset.images)
    return _finish(run.cnn, stamp, trained, logits, dataset, seconds, say, "cnn")


def train_rates(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the rate-based LIF network, unless it is there already; return its metrics."""
    stamp = snn_stamp(settings, dataset)
    weights, metrics = run.snn / "weights.npz", run.snn / "metrics.json"
    if is_current(metrics, stamp, weights):
        say(f"rate-lif: up to date ({metrics.parent})")
        return read_json(metrics, REMEDY)
    from pipeline.training import networks as training

    start = read_weights(run.cnn, settings)
    begun = time.perf_counter()
    epochs = training.snn_recipe(settings.snn).epochs
    with progress("train rate-lif", epochs) as advance:
        trained = training.train_rate_network(
            settings,
            dataset.part("train"),
            settings.seed,
            start,
            dataset.part("validation"),
            advance,
        )
    seconds = time.perf_counter() - begun
    logits = training.rate_logits(settings, trained.weights, dataset.images)
    neurons = _neurons(settings, trained.weights, dataset.part("train")[0])
    extra = {"neurons": neurons}
    metrics = _finish(run.snn, stamp, trained, logits, dataset, seconds, say, "rate-lif", extra)
    for line in training_lines(neurons):
        say(f"rate-lif: {line}")
    return metrics


def convert(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> Bundle:
    """Write the bundle with the samples of its check.

    Returns
    -------
    Bundle
        The one that is there, if it is up to date.
    """
    stamp = stamp_of(
        snn_stamp(settings, dataset),
        asdict(settings.deployment),
        asdict(settings.presentation),
        asdict(settings.check),
    )
    if run.bundle.exists():
        bundle = read_bundle(run.bundle)
        if bundle.spec.provenance.get("made_from") == stamp:
            say(f"bundle: up to date ({run.bundle})")
            return bundle
    from pipeline.run.conversion import deployed

    weights = read_weights(run.snn, settings)
    read_weights(run.cnn, settings)  # damaged ones are found now, not once the bundle is there
    chosen = draw_check_samples(dataset.split.test, settings.check.samples, settings.seed)
    recordings = dataset.recordings
    provenance = {
        "made_from": stamp,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "seed": settings.seed,
        "recipe": settings.snn.recipe,
        "image": asdict(settings.image),
        "package": __version__,
    }
    spec = deployed(settings, weights, provenance, dataset.part("train")[0])
    bundle = write_bundle(run.bundle, spec, _check_set(settings, dataset, chosen))
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")
    return bundle


def on_test_split(settings: Settings, dataset: Dataset, bundle: Bundle) -> Bundle:
    """The bundle with the whole test split as its check, in an order as random as the check's."""
    everything = draw_check_samples(dataset.split.test, len(dataset.split.test), settings.seed)
    return replace(bundle, checks=_check_set(settings, dataset, everything))


def answer(
    run: RunFolder, settings: Settings, bundle: Bundle, stage: str, say=print, whole: bool = False
) -> dict:
    """Let a network or target answer the bundle's samples, unless it has; return the result.

    Parameters
    ----------
    run, settings
    bundle : Bundle
        The run's own, or :func:`on_test_split` of it.
    stage : str
        One of :data:`pipeline.run.answers.STAGES`, or a target.
    say : callable
    whole : bool
        The samples are those of :func:`on_test_split`.
    """
    path = run.whole_check(stage) if whole else run.check(stage)
    if _answers(path, bundle):
        say(f"{stage}: up to date ({path})")
        return read_result(path, REMEDY_CHECK)
    with progress(f"check {stage}", len(bundle.checks)) as advance:
        if stage not in REFERENCES:
            return run_check(bundle, stage, path, settings.seed, advance)
        weights = read_weights(run.cnn if stage == "cnn" else run.snn, settings)
        result = reference_result(stage, settings, weights, bundle, advance)
        write_json(path, result)
        return result


def read_weights(folder: Path, settings: Settings) -> dict:
    """The trained arrays in a network's folder.

    Raises
    ------
    UserError
        They are not there, damaged, or do not fit the architecture.
    """
    path = folder / "weights.npz"
    weights = read_arrays(path, REMEDY)
    shapes = parse(settings.cnn.architecture).weight_shapes
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(f"{path}: not the weights of {settings.cnn.architecture}; {REMEDY}")
    return weights


def _check_set(settings, dataset, chosen):
    recordings = dataset.recordings
    ids = tuple(recordings.ids[i] for i in chosen)
    return CheckSet(dataset.images[chosen], recordings.labels[chosen], ids, settings.seed)


def _answers(path, bundle):
    """True if there is a result of this bundle."""
    return path.exists() and read_result(path, REMEDY_CHECK)["bundle"] == bundle.id


def cnn_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the CNN's training depends on."""
    parts = (settings.data, settings.image, settings.split, settings.cnn)
    source = dataset.recordings.source.sha256
    return stamp_of(__version__, source, settings.seed, *map(asdict, parts))


def snn_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the rate-based network's training depends on."""
    return stamp_of(cnn_stamp(settings, dataset), asdict(settings.snn))


def _neurons(settings, weights, images):
    """Shares of silent and saturated neurons of each convolution on the training images."""
    fastest = fastest_rate(settings.snn.tau_ref)
    outputs = rate_activations(settings, weights, images)
    return {
        name: asdict(activity(output * settings.snn.max_rate(index), fastest))
        for index, (name, output) in enumerate(outputs.items())
    }


def _finish(folder, stamp, trained, logits, dataset, seconds, say, name, extra=None):
    """Write a trained network's files, the metrics last: they say that the rest is there."""
    right = np.argmax(logits, axis=1) == dataset.recordings.labels
    parts = {part: getattr(dataset.split, part) for part in ("train", "validation", "test")}
    accuracy = {part: float(right[index].mean()) for part, index in parts.items() if len(index)}
    judge = list(accuracy)[-1]  # where settings are being chosen there is no test split
    n_judged = len(parts[judge])
    interval = wilson_interval(int(right[parts[judge]].sum()), n_judged)
    metrics = {
        "made_from": stamp,
        "simulated": dataset.recordings.source.simulated,
        "accuracy": accuracy,
        f"{judge}_accuracy_ci95": list(interval),
        f"n_{judge}": n_judged,
        "epochs": len(trained.history),
        "seconds": seconds,
        **(extra or {}),
        "versions": training_versions(),
    }
    (folder / "metrics.json").unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    write_history(folder / "history.csv", trained.history)
    write_json(folder / "metrics.json", metrics)
    say(f"{name}: {judge} accuracy {accuracy[judge]:.3f} on {n_judged} samples, {seconds:.0f} s")
    return metrics
