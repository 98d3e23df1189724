"""Training of a run's networks, unless they are current."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import read_arrays, understood, write_arrays
from deploy.network.decision import Judge
from models.architecture import parse
from pipeline.artifacts import Artifact, Origin
from pipeline.inputs.dataset import Dataset
from pipeline.progress import progress
from pipeline.run import nir_conversion, nir_training
from pipeline.run.answers import training_versions
from pipeline.run.diagnosis import activity, fastest_rate, training_lines
from pipeline.run.folder import DELETE_ITS_FOLDER, NetworkLibrary, RunFolder
from pipeline.run.history import write_history
from pipeline.run.origins import (
    cnn_origin,
    events_origin,
    nir_origin,
    rates_origin,
    threshold_origin,
)
from pipeline.run.stages.own_model import take_over
from pipeline.settings import Settings
from pipeline.training.threads import one_thread_each

Place = RunFolder | NetworkLibrary
"""The folders in which trained networks are stored."""


def train_all(place: Place, settings: Settings, dataset: Dataset, say=print):
    """Train what the bundle is made from, unless it is current."""
    if settings.nir.file:
        take_over_nir(place, settings, dataset, say)
    if settings.network == "nir":
        return
    if settings.on_events:
        train_on_events(place, settings, dataset, say)
    else:
        train(place, settings, dataset, say)
        train_rates(place, settings, dataset, say)


def take_over_nir(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Make the user's NIR graph the run's network, unless it is current; return its metrics."""
    origin = nir_origin(settings, dataset.origin)
    artifact = nir_artifact(place, settings, origin)
    if (done := _current(artifact, origin, say, "reading")) is not None:
        return done
    view = origin.view(settings)
    folder = artifact.record.parent
    metrics = nir_conversion.take_over(folder, view, dataset.seen_by(view), say)
    return artifact.write(origin, metrics)


def train(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the CNN, or read the user's own, unless it is current; return its metrics."""
    one_thread_each()
    origin = cnn_origin(settings, dataset.origin)
    artifact = cnn_artifact(place, origin)
    if (done := _current(artifact, origin, say)) is not None:
        return done
    view = origin.view(settings)
    seen = dataset.seen_by(view)
    if settings.cnn.model:
        trained, notes = take_over(view, seen)
        for note in notes:
            say(f"cnn: {note}")
        seconds = 0.0
    else:
        from pipeline.training.networks import train_cnn  # TensorFlow takes seconds to import

        data, watched = seen.part("train"), _watched(seen)
        with _timed("cnn", view.cnn.epochs) as timed:
            trained = train_cnn(view, data, view.seed, watched, timed.advance)
        seconds = timed.seconds
    _write_network(artifact.record.parent, _told(trained, seen))
    metrics = _metrics(trained, seen, seconds)
    _say_accuracy("cnn", metrics, say)
    return artifact.write(origin, metrics)


def train_rates(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the rate-based LIF network, unless it is current; return its metrics."""
    one_thread_each()
    cnn = cnn_origin(settings, dataset.origin)
    origin = rates_origin(settings, cnn)
    artifact = rates_artifact(place, origin)
    if (done := _current(artifact, origin, say)) is not None:
        return done
    from pipeline.training.networks import snn_recipe, train_rate_network

    view = origin.view(settings)
    seen = dataset.seen_by(view)
    start = read_weights(place.network("cnn", cnn), view)
    data, watched = seen.part("train"), _watched(seen)
    with _timed("rate-lif", snn_recipe(view.snn).epochs) as timed:
        trained = train_rate_network(view, data, view.seed, start, watched, timed.advance)
    _write_network(artifact.record.parent, _told(trained, seen))
    metrics = _metrics(trained, seen, timed.seconds)
    metrics["neurons"] = _neurons(view, trained, data[0])
    _say_accuracy("rate-lif", metrics, say)
    for line in training_lines(metrics["neurons"]):
        say(f"rate-lif: {line}")
    return artifact.write(origin, metrics)


def train_on_events(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the network on events and choose its threshold, unless they are current.

    Returns
    -------
    dict
        The metrics of :func:`choose_threshold`.
    """
    train_event_network(place, settings, dataset, say)
    return choose_threshold(place, settings, dataset, say)


def train_event_network(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the network on events, unless it is current; return the record of its training.

    An interrupted training continues after its last completed epoch.
    """
    origin = events_origin(settings, dataset.origin)
    artifact = events_artifact(place, origin)
    if (done := _current(artifact, origin, say)) is not None:
        return done
    from pipeline.run import event_training  # TensorFlow takes seconds to import

    view = origin.view(settings)
    samples = event_training.set_apart(dataset.seen_by(view), view.seed)
    folder = artifact.record.parent
    checkpoint = event_training.Checkpoint(folder / "checkpoint.npz", origin.key)
    start = None
    if view.network == "retrained":
        graph = nir_artifact(place, view, nir_origin(settings, dataset.origin)).record.parent
        start, lines = nir_training.start(graph, view, samples)
        for line in lines:
            say(f"nir: {line}")
    with _timed("events", view.events.epochs) as timed:
        trained = event_training.train(view, samples, view.seed, checkpoint, timed.advance, start)
    _write_network(folder, trained)
    training = {"epochs": len(trained.history), "seconds": timed.seconds}
    written = artifact.write(origin, {**training, "versions": training_versions()})
    checkpoint.path.unlink(missing_ok=True)
    return written


def choose_threshold(place: Place, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Choose the confidence for early decisions of the network on events; measure its accuracy.

    Both depend on the presentation, unlike the training, and are therefore a separate artifact.

    Returns
    -------
    dict
        ``accuracy`` on each part of the split, and ``decides_by_itself``.
    """
    trained_from = events_origin(settings, dataset.origin)
    origin = threshold_origin(settings, trained_from)
    artifact = threshold_artifact(place, origin)
    if (done := _current(artifact, origin, say, "choosing")) is not None:
        return done
    from pipeline.run import event_training

    view = origin.view(settings)
    seen = dataset.seen_by(view)
    folder = place.network("snn", trained_from)
    trained = event_training.trained_network(view, read_weights(folder, view))
    samples = event_training.set_apart(seen, view.seed)
    chosen = event_training.choose(view, samples, trained, view.seed)
    training = events_artifact(place, trained_from)
    with understood(training.record, DELETE_ITS_FOLDER):
        record = training.state(trained_from).record
        seconds, epochs = float(record["seconds"]), int(record["epochs"])
    metrics = _metrics(trained, seen, seconds)
    metrics["epochs"] = epochs
    metrics["decides_by_itself"] = {**chosen._asdict(), "samples": len(samples.held)}
    _say_accuracy("events", metrics, say)
    if chosen.confidence < 1:
        say(
            f"threshold: early decision at a confidence of {chosen.confidence:.4f}, after "
            f"{chosen.share:.0%} of a recording on {len(samples.held)} held-out samples"
        )
    else:
        fewest = event_training.FEWEST_HELD
        few = len(samples.held) < fewest
        say(
            "threshold: no early decisions, the network decides at the end of each recording"
            + few
            * f", since {len(samples.held)} held-out samples are fewer than the {fewest} on "
            "which a confidence may be chosen (more: split.validation_fraction)"
        )
    return artifact.write(origin, metrics)


def cnn_artifact(place: Place, origin: Origin) -> Artifact:
    """Weights, history and metrics of the CNN."""
    folder = place.network("cnn", origin)
    return Artifact("cnn", folder / "metrics.json", (folder / "weights.npz",))


def nir_artifact(place: Place, settings: Settings, origin: Origin) -> Artifact:
    """A copy of the NIR graph, and its metrics; beside the network that is trained from it."""
    folder = place.network("snn" if settings.network == "nir" else "nir", origin)
    return Artifact("nir", folder / "metrics.json", (nir_conversion.kept_graph(folder),))


def rates_artifact(place: Place, origin: Origin) -> Artifact:
    """Weights, history and metrics of the rate-based network."""
    folder = place.network("snn", origin)
    return Artifact("rate-lif", folder / "metrics.json", (folder / "weights.npz",))


def events_artifact(place: Place, origin: Origin) -> Artifact:
    """Weights and history of the network trained on events."""
    folder = place.network("snn", origin)
    return Artifact("events", folder / "training.json", (folder / "weights.npz",))


def threshold_artifact(place: Place, origin: Origin) -> Artifact:
    """Threshold and accuracy of the network trained on events."""
    return Artifact("threshold", place.network("threshold", origin) / "metrics.json")


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
        shapes = parsed.event_weight_shapes | Judge.shapes(parsed.outputs)
    else:
        architecture = settings.cnn.architecture
        shapes = parse(architecture).weight_shapes
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(f"{path}: not the weights of {architecture}; {DELETE_ITS_FOLDER}")
    return weights


def _current(artifact, origin, say, action="training"):
    """The record of a current artifact; otherwise None, after a message with the reason."""
    state = artifact.state(origin)
    if state.is_current:
        say(f"{artifact.name}: up to date ({artifact.record.parent})")
        return state.record
    if (line := state.announcement(action)) is not None:
        say(line)
    return None


class _timed:
    """A progress bar for a training, which also measures its duration."""

    def __init__(self, name, epochs):
        self._bar = progress(f"train {name}", epochs)

    def __enter__(self):
        self._begun = time.perf_counter()
        self.advance = self._bar.__enter__()
        return self

    def __exit__(self, *error):
        self.seconds = time.perf_counter() - self._begun
        return self._bar.__exit__(*error)


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


def _told(trained, dataset):
    """A network with a note in its history if it was evaluated on test samples."""
    if len(dataset.split.validation):
        return trained
    rows = [{k.replace("val_", "test_"): v for k, v in row.items()} for row in trained.history]
    return replace(trained, history=rows)


def _write_network(folder, trained):
    """Write weights and history; delete the records first, because they mark them as complete."""
    for record in ("metrics.json", "training.json"):
        (folder / record).unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    write_history(folder / "history.csv", trained.history)


def _metrics(trained, dataset, seconds):
    """Accuracy of a network on each part of the split."""
    right = np.argmax(trained.logits(dataset.inputs), axis=1) == dataset.labels
    parts = {part: getattr(dataset.split, part) for part in ("train", "validation", "test")}
    accuracy = {part: float(right[index].mean()) for part, index in parts.items() if len(index)}
    part = list(accuracy)[-1]  # the validation samples if there is no test split, as in a sweep
    n_samples = len(parts[part])
    return {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": accuracy,
        f"{part}_accuracy_ci95": list(wilson_interval(int(right[parts[part]].sum()), n_samples)),
        f"n_{part}": n_samples,
        "epochs": len(trained.history),
        "seconds": seconds,
        "versions": training_versions(),
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
        name: asdict(activity(output * settings.snn.max_rate(index), fastest))
        for index, (name, output) in enumerate(outputs.items())
    }
