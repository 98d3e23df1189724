"""The stages of a run: each reads what the one before wrote, and is redone only if out of date."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
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
from pipeline.inputs.dataset import TOO_SMALL, Dataset
from pipeline.inputs.splits import draw_check_samples
from pipeline.progress import progress
from pipeline.run.answers import STAGES as REFERENCES
from pipeline.run.answers import reference_result, training_versions
from pipeline.run.diagnosis import activity, fastest_rate, training_lines
from pipeline.run.folder import RunFolder, is_current, stamp_of
from pipeline.run.history import write_history
from pipeline.settings import Settings

REMEDY = "delete its folder and run the command again"
REMEDY_CHECK = "delete it and run the command again"


def open_dataset(run: RunFolder, settings: Settings, jobs: int = 2, warn=None) -> Dataset:
    """Load, split and draw the recordings of a run; keep its settings; write ``dataset.json``.

    The settings are kept only now that the recordings are there and enough: a mistaken path or
    number of samples must not stick to the run.

    Raises
    ------
    UserError
        The source cannot be read, or is too small for the split or the check.
    """
    dataset = Dataset.of(settings, jobs, warn)
    recordings, split = dataset.recordings, dataset.split
    try:
        draw_check_samples(split.test, settings.check.samples, settings.seed)
    except ValueError as error:
        raise UserError(f"{settings.data.source}: {error}; {TOO_SMALL}") from error
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


def train(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the CNN, unless it is there already; return its metrics."""
    stamp = cnn_stamp(settings, dataset)
    if done := _done("cnn", run.cnn, stamp, say):
        return done
    from pipeline.training.networks import train_cnn  # TensorFlow: seconds that _done can spare

    def train_it(advance):
        data, watched = dataset.part("train"), dataset.part("validation")
        return train_cnn(settings, data, settings.seed, watched, advance)

    return _train("cnn", run.cnn, stamp, settings.cnn.epochs, train_it, dataset, say)


def train_rates(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the rate-based LIF network, unless it is there already; return its metrics."""
    stamp = snn_stamp(settings, dataset)
    if done := _done("rate-lif", run.snn, stamp, say):
        return done
    from pipeline.training.networks import snn_recipe, train_rate_network

    start, data = read_weights(run.cnn, settings), dataset.part("train")

    def train_it(advance):
        watched = dataset.part("validation")
        return train_rate_network(settings, data, settings.seed, start, watched, advance)

    def neurons_of(trained):
        return {"neurons": _neurons(settings, trained, data[0])}

    epochs = snn_recipe(settings.snn).epochs
    metrics = _train("rate-lif", run.snn, stamp, epochs, train_it, dataset, say, neurons_of)
    for line in training_lines(metrics["neurons"]):
        say(f"rate-lif: {line}")
    return metrics


def make_bundle(run: RunFolder, settings: Settings, jobs: int = 1, say=print) -> tuple:
    """Do what is missing of a run up to its bundle; return the dataset and the bundle."""
    dataset = open_dataset(run, settings, jobs, say)
    train(run, settings, dataset, say)
    train_rates(run, settings, dataset, say)
    return dataset, convert(run, settings, dataset, say)


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
    return CheckSet(dataset.inputs[chosen], recordings.labels[chosen], ids, settings.seed)


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


def _neurons(settings, trained, inputs):
    """Shares of silent and saturated neurons of each convolution on the training samples."""
    fastest = fastest_rate(settings.snn.tau_ref)
    outputs = trained.activations(inputs)
    return {
        name: asdict(activity(output * settings.snn.max_rate(index), fastest))
        for index, (name, output) in enumerate(outputs.items())
    }


def _done(name, folder, stamp, say):
    """The metrics of a network that was trained from the same, or None."""
    path = folder / "metrics.json"
    if not is_current(path, stamp, folder / "weights.npz"):
        return None
    say(f"{name}: up to date ({folder})")
    return read_json(path, REMEDY)


def _train(name, folder, stamp, epochs, train_it, dataset, say, more=lambda trained: {}):
    """Train, judge and write a network; return its metrics, with ``more`` of the network."""
    begun = time.perf_counter()
    with progress(f"train {name}", epochs) as advance:
        trained = train_it(advance)
    seconds = time.perf_counter() - begun
    right = np.argmax(trained.logits(dataset.inputs), axis=1) == dataset.labels
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
        **more(trained),
        "versions": training_versions(),
    }
    # The metrics come last: they say that the rest is there.
    (folder / "metrics.json").unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    write_history(folder / "history.csv", trained.history)
    write_json(folder / "metrics.json", metrics)
    say(f"{name}: {judge} accuracy {accuracy[judge]:.3f} on {n_judged} samples, {seconds:.0f} s")
    return metrics
