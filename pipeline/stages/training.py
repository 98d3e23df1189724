"""Training of a run's networks, unless they are current."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import copy_file, read_arrays, reporting_damage, write_arrays
from deploy.network.decision import Estimator
from models.architecture import parse
from pipeline.artifacts import Artifact, Library, Origin
from pipeline.data.dataset import Dataset
from pipeline.data.images import sliced_counts, typical_duration_ms
from pipeline.progress import progress
from pipeline.roads import nir_import
from pipeline.roads.answers import BASELINE, training_versions
from pipeline.roads.diagnosis import activity, fastest_rate, training_lines
from pipeline.roads.event_training import FEWEST, choose, event_samples
from pipeline.roads.given_networks import split_note
from pipeline.roads.nir_settings import GRAPH
from pipeline.roads.origins import (
    cnn_origin,
    counts_origin,
    events_origin,
    nir_origin,
    rates_origin,
    threshold_origin,
)
from pipeline.roads.own_model import copy_of_model, take_over
from pipeline.run import DELETE_ITS_FOLDER, RunFolder
from pipeline.settings import Settings
from pipeline.training.checkpoint import Checkpoint
from pipeline.training.history import write_history
from pipeline.training.threads import one_thread_each

Place = RunFolder | Library
"""The folders in which trained networks are stored."""

ARTIFACTS = {
    "image": ("cnn", "rate-lif"),
    "events": ("events", "threshold"),
    "nir": ("nir",),
}
"""Names of the artifacts from which a bundle is made, in order, by :attr:`Settings.network`.  The
ladder also needs those of :data:`pipeline.roads.answers.LADDER_ONLY`."""

CHECKPOINT = "checkpoint.npz"
"""State of a training on events that is not complete."""


def network_artifact(name: str, place: Place, settings: Settings, dataset: Origin) -> Artifact:
    """One of :data:`ARTIFACTS`, or of those that only the ladder needs.

    Parameters
    ----------
    name : str
    place : RunFolder or Library
    settings : Settings
    dataset : Origin
    """
    make_origin, folder, record, *files = {
        "counts": (counts_origin, "counts", "metrics.json", "scores.npz"),
        "cnn": (cnn_origin, "cnn", "metrics.json", "weights.npz"),
        "rate-lif": (rates_origin, "snn", "metrics.json", "weights.npz"),
        "events": (events_origin, "snn", "training.json", "weights.npz"),
        "threshold": (threshold_origin, "threshold", "metrics.json"),
        "nir": (nir_origin, "snn", "metrics.json", GRAPH),
    }[name]
    origin = make_origin(settings, dataset)
    path = place.folder(folder, origin)
    return Artifact(name, path / record, origin, tuple(path / file for file in files))


def train_all(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Make all that the bundle is made from, unless it is current; return the last metrics."""
    for name in ARTIFACTS[settings.network]:
        metrics = train(name, place, settings, dataset, say)
    return metrics


def train(name: str, place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Make an artifact of :func:`network_artifact`, unless it is current.

    Parameters
    ----------
    name : str
    place : RunFolder or Library
        Contains the artifacts from which this one is made.
    settings, dataset, say

    Returns
    -------
    dict
        Its record: accuracy on each part of the split and other metrics; for ``"events"`` only the
        epochs and the seconds.
    """
    make, action = {
        "counts": (_fit_counts, "fitting"),
        "cnn": (_train_cnn, "training"),
        "rate-lif": (_train_rates, "training"),
        "events": (_train_on_events, "training"),
        "threshold": (_choose_threshold, "choosing"),
        "nir": (_read_graph, "reading"),
    }[name]
    if name in ARTIFACTS["image"]:
        one_thread_each()
    artifact = network_artifact(name, place, settings, dataset.origin)
    state = artifact.state()
    if state.is_current:
        say(f"{name}: up to date ({artifact.folder})")
        return state.record
    if (line := state.announcement(action)) is not None:
        say(line)
    given = {"nir": settings.nir.file, "cnn": settings.cnn.model}.get(name, "")
    if (line := split_note(state, given)) is not None:
        say(line)
    view = artifact.origin.view(settings)
    record = artifact.write(make(artifact, place, view, dataset.seen_by(view), say))
    if name == "events":
        (artifact.folder / CHECKPOINT).unlink(missing_ok=True)  # the training is complete
    return record


def _fit_counts(artifact, place, settings, dataset, say):
    """Fit the classifier of event counts; keep its scores of the test samples."""
    from pipeline.training.baseline import SLICES, fit_baseline

    recordings, split = dataset.recordings, dataset.split
    begun = time.perf_counter()
    if dataset.is_of_arrays:  # there are no events: the pixels take their place
        counts = dataset.inputs[:, None]
    else:
        duration = typical_duration_ms(recordings.part(split.train))
        n = max(SLICES) if _features(recordings) * max(SLICES) <= MOST_FEATURES else 1
        counts = sliced_counts(recordings, n, duration)
    classes = len(recordings.sensor.classes)
    fitted = fit_baseline(counts, dataset.labels, split.train, classes, settings.seed)
    seconds = time.perf_counter() - begun
    ids = np.array([recordings.ids[index] for index in split.test], dtype=str)
    write_arrays(artifact.folder / "scores.npz", ids=ids, scores=fitted.scores[split.test])
    metrics = {
        **_accuracies(fitted.scores, dataset),
        "slices": fitted.slices,
        "strength": fitted.strength,
        "cross_validated_accuracy": fitted.cross_validated,
        "seconds": seconds,
        "versions": BASELINE,
    }
    _say_accuracy("counts", metrics, say)
    return metrics


def _features(recordings):
    return 2 * recordings.sensor.rows * recordings.sensor.columns


def _read_graph(artifact, place, settings, dataset, say):
    """Make the user's NIR graph the run's network."""
    return nir_import.take_over(artifact.folder, settings, dataset, say)


def _train_cnn(artifact, place, settings, dataset, say):
    """Train the CNN, or read the user's own."""
    if settings.cnn.model:
        path, trained, notes = take_over(artifact.folder, settings, dataset)
        for note in notes:
            say(f"cnn: {note}")
        copy = copy_of_model(artifact.folder, settings)
        if path != copy:
            copy_file(path, copy)
        seconds = 0.0
    else:
        from pipeline.training.networks import train_cnn  # TensorFlow takes seconds to import

        arguments = settings, dataset.part("train"), settings.seed, _watched(dataset)
        trained, seconds = _timed("cnn", settings.cnn.epochs, train_cnn, *arguments)
    _write_network(artifact.folder, trained, dataset)
    metrics = _metrics(trained, dataset, seconds)
    _say_accuracy("cnn", metrics, say)
    return metrics


def _train_rates(artifact, place, settings, dataset, say):
    """Train the rate-based LIF network, starting from the CNN."""
    from pipeline.training.networks import snn_recipe, train_rate_network

    start = weights_of("cnn", place, settings, dataset.origin)
    data, epochs = dataset.part("train"), snn_recipe(settings.snn).epochs
    arguments = settings, data, settings.seed, start, _watched(dataset)
    trained, seconds = _timed("rate-lif", epochs, train_rate_network, *arguments)
    _write_network(artifact.folder, trained, dataset)
    metrics = _metrics(trained, dataset, seconds)
    metrics["neurons"] = _neurons(settings, trained, data[0])
    _say_accuracy("rate-lif", metrics, say)
    for line in training_lines(metrics["neurons"]):
        say(f"rate-lif: {line}")
    return metrics


def _train_on_events(artifact, place, settings, dataset, say):
    """Train the network on events; an interrupted training continues after its last epoch."""
    from pipeline.training import events  # TensorFlow takes seconds to import

    samples = event_samples(dataset, settings.seed)
    checkpoint = Checkpoint(artifact.folder / CHECKPOINT, artifact.origin.key)
    table, labels, indices, _ = samples
    recipe = events.EventRecipe.of(settings).for_samples(len(indices))
    updates = recipe.epochs * -(-len(indices) // recipe.batch_size)
    say(f"events: {recipe.epochs} epochs, {updates:,} updates, on {len(indices):,} samples")
    arguments = recipe, table, labels, indices, settings.seed
    trained, seconds = _timed(
        "events", recipe.epochs, events.train_events, *arguments, checkpoint=checkpoint
    )
    _write_network(artifact.folder, trained, dataset)
    epochs = len(trained.history)
    return {"epochs": epochs, "seconds": seconds, "versions": training_versions()}


def _timed(name, epochs, function, *arguments, **more):
    """Run a training with a progress bar; return the network and the seconds that it took."""
    with progress(f"train {name}", epochs) as advance:
        begun = time.perf_counter()
        trained = function(*arguments, advance=advance, **more)
        return trained, time.perf_counter() - begun


def _choose_threshold(artifact, place, settings, dataset, say):
    """Choose the confidence for early decisions of the network on events; measure its accuracy.

    Both depend on the presentation, unlike the training, and are therefore a separate artifact.
    """
    from pipeline.training.events import TrainedOnEvents

    trained = TrainedOnEvents.of(settings, weights_of("events", place, settings, dataset.origin))
    samples = event_samples(dataset, settings.seed)
    chosen = choose(settings, samples, trained, settings.seed)
    training = network_artifact("events", place, settings, dataset.origin)
    with reporting_damage(training.record, DELETE_ITS_FOLDER):
        record = training.state().record
        seconds, epochs = float(record["seconds"]), int(record["epochs"])
    metrics = _metrics(trained, dataset, seconds)
    metrics["epochs"] = epochs
    metrics["decides_by_itself"] = {**chosen._asdict(), "samples": len(samples.held_out)}
    _say_accuracy("events", metrics, say)
    if chosen.confidence < 1:
        say(
            f"threshold: early decision at a confidence of {chosen.confidence:.4f}, after "
            f"{chosen.share:.0%} of a recording on {len(samples.held_out)} held-out samples"
        )
        return metrics
    why = ""
    if len(samples.held_out) < FEWEST:
        why = (
            f", since {len(samples.held_out)} held-out samples are fewer than the {FEWEST} on "
            "which a confidence may be chosen (more: split.validation_fraction)"
        )
    say(f"threshold: no early decisions, the network decides at the end of each recording{why}")
    return metrics


def weights_of(name: str, place: Place, settings: Settings, dataset: Origin) -> dict:
    """The trained arrays of one of :data:`ARTIFACTS`; see :func:`read_weights`."""
    return read_weights(network_artifact(name, place, settings, dataset).folder, settings)


def read_weights(folder: Path, settings: Settings) -> dict:
    """The trained arrays in a network's folder.

    Raises
    ------
    UserError
        The arrays are missing, damaged, or do not fit the architecture.
    """
    path = folder / "weights.npz"
    weights = read_arrays(path, DELETE_ITS_FOLDER)
    if settings.on_events:
        architecture = settings.events.architecture
        parsed = parse(architecture)
        parts = len(settings.part_starts)
        shapes = parsed.event_weight_shapes(parts) | Estimator.shapes(parsed.outputs)
    else:
        architecture = settings.cnn.architecture
        shapes = parse(architecture).weight_shapes
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(f"{path}: not the weights of {architecture}; {DELETE_ITS_FOLDER}")
    return weights


MOST_FEATURES = 20_000
"""Event counts of a sample, at most; a sensor with more has them in one slice of time."""

MOST_WATCHED = 500
"""Maximum number of test samples for the learning curve."""


def _watched(dataset):
    """Samples for the learning curve: validation samples or, without these, some test samples.

    No result depends on them.
    """
    if (validation := dataset.part("validation")) is not None:
        return validation
    index = dataset.split.test
    index = index[:: max(1, -(-len(index) // MOST_WATCHED))]
    return (dataset.inputs[index], dataset.labels[index]) if len(index) else None


def _write_network(folder, trained, dataset):
    """Write weights and history; delete the records first, because they mark them as complete."""
    for record in ("metrics.json", "training.json"):
        (folder / record).unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    history = trained.history
    if not len(dataset.split.validation):  # the learning curve is of test samples
        history = [{k.replace("val_", "test_"): v for k, v in row.items()} for row in history]
    write_history(folder / "history.csv", history)


def _metrics(trained, dataset, seconds):
    """Accuracy of a network on each part of the split, and its training."""
    return {
        **_accuracies(trained.logits(dataset.inputs), dataset),
        "epochs": len(trained.history),
        "seconds": seconds,
        "versions": training_versions(),
    }


def _accuracies(scores, dataset):
    """Accuracy of the scores of all samples on each part of the split."""
    right = np.argmax(scores, axis=1) == dataset.labels
    parts = {part: getattr(dataset.split, part) for part in ("train", "validation", "test")}
    accuracy = {part: float(right[index].mean()) for part, index in parts.items() if len(index)}
    part = list(accuracy)[-1]  # the validation samples if there is no test split, as in a sweep
    n_samples = len(parts[part])
    return {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": accuracy,
        f"{part}_accuracy_ci95": list(wilson_interval(int(right[parts[part]].sum()), n_samples)),
        f"n_{part}": n_samples,
    }


def _say_accuracy(name, metrics, say):
    part = list(metrics["accuracy"])[-1]
    say(
        f"{name}: {part} accuracy {metrics['accuracy'][part]:.3f} on {metrics[f'n_{part}']} "
        f"samples, {metrics['seconds']:.0f} s"
    )


def _neurons(settings, trained, inputs):
    """Shares of silent and saturated neurons of each layer on the training samples."""
    fastest = fastest_rate(settings.snn.tau_ref)
    outputs = trained.activations(inputs)
    return {
        name: activity(output * settings.snn.max_rate(index), fastest)
        for index, (name, output) in enumerate(outputs.items())
    }
