"""The stages of a run: each reads what the one before wrote, and is redone only if out of date."""

from __future__ import annotations

import importlib.metadata
import time
from dataclasses import asdict, dataclass

import numpy as np

from deploy import __version__
from deploy.bundle import Bundle, CheckSet, read_bundle, write_bundle
from deploy.checks import run_check
from deploy.errors import UserError
from deploy.files import read_arrays, read_json, write_arrays, write_json
from deploy.presentation import Responses
from deploy.results import read_result, result_of
from deploy.statistics import wilson_interval
from models.notation import parse
from pipeline.images import tactile_images
from pipeline.progress import progress
from pipeline.recordings import Recordings
from pipeline.run_folder import RunFolder, is_current, stamp_of
from pipeline.settings import Settings
from pipeline.sources import load_recordings
from pipeline.splits import Split, draw_check_samples, random_split

REMEDY = "delete its folder and run the command again"
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
    data = settings.data
    recordings = load_recordings(
        data.source, data.simulation_seed, data.samples_per_digit, data.skip_bad, jobs, warn
    )
    try:
        split = random_split(
            len(recordings),
            settings.seed,
            settings.split.test_fraction,
            settings.split.validation_fraction,
        )
        draw_check_samples(split.test, settings.check.samples, settings.seed)
    except ValueError as error:
        raise UserError(
            f"{data.source}: {error}; ask for fewer (SAMPLES, or check.samples) or give more data"
        ) from error
    run.save_settings(settings)
    write_json(
        run.dataset,
        {
            "source": recordings.source.name,
            "sha256": recordings.source.sha256,
            "simulated": recordings.source.simulated,
            "samples": len(recordings),
            "samples_per_digit": np.bincount(recordings.labels, minlength=10).tolist(),
            "train": len(split.train),
            "validation": len(split.validation),
            "test": len(split.test),
        },
    )
    images = tactile_images(recordings, settings.image.aggregation, settings.image.normalisation)
    return Dataset(recordings, images, split)


def train(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the CNN, unless it is there already; return its metrics."""
    stamp = _cnn_stamp(settings, dataset)
    weights, metrics = run.cnn / "weights.npz", run.cnn / "metrics.json"
    if is_current(metrics, stamp, weights):
        say(f"cnn: up to date ({metrics.parent})")
        return read_json(metrics, REMEDY)
    from pipeline import training  # imports TensorFlow: ten seconds that a finished stage can spare

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
    stamp = _snn_stamp(settings, dataset)
    weights, metrics = run.snn / "weights.npz", run.snn / "metrics.json"
    if is_current(metrics, stamp, weights):
        say(f"rate-lif: up to date ({metrics.parent})")
        return read_json(metrics, REMEDY)
    from pipeline import training

    cnn_weights = _weights(run.cnn, settings)
    begun = time.perf_counter()
    epochs = training.snn_recipe(settings.snn).epochs
    with progress("train rate-lif", epochs) as advance:
        trained = training.train_rate_network(
            settings,
            dataset.part("train"),
            settings.seed,
            cnn_weights,
            dataset.part("validation"),
            advance,
        )
    seconds = time.perf_counter() - begun
    logits = training.rate_logits(settings, trained.weights, dataset.images)
    return _finish(run.snn, stamp, trained, logits, dataset, seconds, say, "rate-lif")


def convert(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> Bundle:
    """Write the bundle, and what CNN, rate-based and NengoDL's spiking network answer to its check.

    Returns
    -------
    Bundle
        The one that is there, if it is up to date.
    """
    stamp = stamp_of(
        _snn_stamp(settings, dataset),
        asdict(settings.deployment),
        asdict(settings.presentation),
        asdict(settings.check),
    )
    references = [run.check(stage) for stage in ("cnn", "rate-lif", "spiking-lif")]
    if run.bundle.exists():
        bundle = read_bundle(run.bundle)
        current = bundle.spec.provenance.get("made_from") == stamp
        if current and all(_answers(path, bundle) for path in references):
            say(f"bundle: up to date ({run.bundle})")
            return bundle
    from pipeline import nengodl, training
    from pipeline.conversion import to_spec

    weights, cnn_weights = _weights(run.snn, settings), _weights(run.cnn, settings)
    chosen = draw_check_samples(dataset.split.test, settings.check.samples, settings.seed)
    recordings = dataset.recordings
    images = dataset.images[chosen]
    provenance = {
        "made_from": stamp,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "seed": settings.seed,
        "recipe": settings.snn.recipe,
        "package": __version__,
    }
    logits = None
    if settings.deployment.readout == "chip":
        logits = training.rate_logits(settings, weights, dataset.part("train")[0])
    spec = to_spec(settings, weights, provenance, logits)
    checks = CheckSet(
        images, recordings.labels[chosen], tuple(recordings.ids[i] for i in chosen), settings.seed
    )
    bundle = write_bundle(run.bundle, spec, checks)
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")

    cnn = training.cnn_logits(settings, cnn_weights, images)
    rate = training.rate_logits(settings, weights, images)
    answers = {"cnn": cnn[:, None], "rate-lif": rate[:, None]}
    begun = time.perf_counter()
    spiking = nengodl.run(settings, weights, images, settings.presentation.steps)
    seconds = time.perf_counter() - begun
    start = settings.presentation.readout_start
    counts = np.arange(1, spiking.shape[1] - start + 1)[:, None]
    answers["spiking-lif"] = np.cumsum(spiking[:, start:], axis=1) / counts
    for stage, path in zip(answers, references, strict=True):
        samples = _samples(bundle, answers[stage])
        extra = {"versions": _training_versions()}
        wall = seconds if stage == "spiking-lif" else 0.0
        write_json(path, result_of(bundle, stage, settings.seed, samples, wall, extra))
    return bundle


def check(run: RunFolder, settings: Settings, bundle: Bundle, target: str, say=print) -> dict:
    """Let a target answer the bundle's check, unless it has; return the result."""
    path = run.check(target)
    if _answers(path, bundle):
        say(f"{target}: up to date ({path})")
        return read_result(path, REMEDY_CHECK)
    with progress(f"check {target}", len(bundle.checks)) as advance:
        return run_check(bundle, target, path, settings.seed, advance)


def _answers(path, bundle):
    """True if there is a result of this bundle."""
    return path.exists() and read_result(path, REMEDY_CHECK)["bundle"] == bundle.id


def _weights(folder, settings):
    """The trained arrays in a folder, made sure to fit the architecture."""
    path = folder / "weights.npz"
    weights = read_arrays(path, REMEDY)
    shapes = parse(settings.cnn.architecture).weight_shapes
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(f"{path}: not the weights of {settings.cnn.architecture}; {REMEDY}")
    return weights


def _cnn_stamp(settings, dataset):
    parts = (settings.data, settings.image, settings.split, settings.cnn)
    source = dataset.recordings.source.sha256
    return stamp_of(__version__, source, settings.seed, *map(asdict, parts))


def _snn_stamp(settings, dataset):
    # The price of spikes is for those of a whole presentation.
    steps = settings.presentation.steps if settings.snn.spike_penalty else None
    return stamp_of(_cnn_stamp(settings, dataset), asdict(settings.snn), steps)


def _finish(folder, stamp, trained, logits, dataset, seconds, say, name):
    """Write a trained network's files, the metrics last: they say that the rest is there."""
    from pipeline.training import write_history

    right = np.argmax(logits, axis=1) == dataset.recordings.labels
    accuracy = {
        part: float(right[getattr(dataset.split, part)].mean())
        for part in ("train", "validation", "test")
        if len(getattr(dataset.split, part))
    }
    n_test = len(dataset.split.test)
    correct = int(right[dataset.split.test].sum())
    metrics = {
        "made_from": stamp,
        "simulated": dataset.recordings.source.simulated,
        "accuracy": accuracy,
        "test_accuracy_ci95": list(wilson_interval(correct, n_test)),
        "n_test": n_test,
        "epochs": len(trained.history),
        "seconds": seconds,
        "versions": _training_versions(),
    }
    (folder / "metrics.json").unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    write_history(folder / "history.csv", trained.history)
    write_json(folder / "metrics.json", metrics)
    say(f"{name}: test accuracy {accuracy['test']:.3f} on {n_test} samples, {seconds:.0f} s")
    return metrics


def _samples(bundle, logits):
    """Samples of a check result from logits at each step, shape (n, steps, classes)."""
    steps = bundle.spec.presentation.steps if logits.shape[1] > 1 else 1
    decisions = np.full((len(logits), steps), -1)
    decisions[:, steps - logits.shape[1] :] = np.argmax(logits, axis=2)
    responses = Responses(logits[:, -1], decisions, {}, {})
    return [
        {
            "id": bundle.checks.ids[i],
            "label": int(bundle.checks.labels[i]),
            "prediction": int(responses.predictions[i]),
            "scores": [float(score) for score in responses.scores[i]],
            "decided_at": int(responses.decided_at[i]),
            "decisions": decisions[i].tolist(),
            "spikes": {},
            "operations": {},
        }
        for i in range(len(logits))
    ]


def _training_versions():
    names = ("tensorflow", "nengo-dl")
    return {name.replace("-", "_"): importlib.metadata.version(name) for name in names}
