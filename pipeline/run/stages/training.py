"""The networks of a run, trained unless they are there already."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import read_arrays, read_json, write_arrays, write_json
from deploy.network.decision import Judge
from models.architecture import parse
from pipeline.inputs.dataset import Dataset
from pipeline.progress import progress
from pipeline.run.answers import training_versions
from pipeline.run.diagnosis import activity, fastest_rate, training_lines
from pipeline.run.folder import DELETE_ITS_FOLDER, RunFolder, is_current
from pipeline.run.history import write_history
from pipeline.run.stages.own_model import take_over
from pipeline.run.stages.stamps import cnn_stamp, events_stamp, snn_stamp
from pipeline.settings import Settings
from pipeline.training.threads import one_thread_each


def train_all(run: RunFolder, settings: Settings, dataset: Dataset, say=print):
    """Train what the bundle is made from, unless it is there already."""
    if settings.on_events:
        train_on_events(run, settings, dataset, say)
    else:
        train(run, settings, dataset, say)
        train_rates(run, settings, dataset, say)


def train(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the CNN, or read the user's own, unless it is there already; return its metrics."""
    one_thread_each()  # of a run on images all that follows in this process, trained before or not
    stamp = cnn_stamp(settings, dataset)
    if done := _done("cnn", run.cnn, stamp, say):
        return done
    if settings.cnn.model:
        taken, notes = take_over(settings, dataset)
        for note in notes:
            say(f"cnn: {note}")
        return _train("cnn", run.cnn, stamp, 0, lambda advance: taken, dataset, say)
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


def train_on_events(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the spiking network on events, unless it is there already; return its metrics.

    An interrupted training goes on after its last whole epoch.
    """
    stamp = events_stamp(settings, dataset)
    if done := _done("events", run.snn, stamp, say):
        return done
    from pipeline.run import event_training  # TensorFlow: seconds that _done can spare

    samples = event_training.set_apart(dataset, settings.seed)
    checkpoint = run.snn / "checkpoint.npz"

    def train_it(advance):
        return event_training.train(settings, samples, settings.seed, checkpoint, advance)

    def decision_of(trained):
        chosen = event_training.choose(settings, samples, trained, settings.seed)
        return {"decides_by_itself": {**chosen._asdict(), "samples": len(samples.held)}}

    epochs = settings.events.epochs
    metrics = _train("events", run.snn, stamp, epochs, train_it, dataset, say, decision_of)
    checkpoint.unlink(missing_ok=True)
    chosen = metrics["decides_by_itself"]
    say(
        f"events: decides by itself at a confidence of {chosen['confidence']:.4f}, after "
        f"{chosen['share']:.0%} of the writing on {chosen['samples']} held-out samples"
    )
    return metrics


def read_weights(folder: Path, settings: Settings) -> dict:
    """The trained arrays in a network's folder.

    Raises
    ------
    UserError
        They are not there, damaged, or do not fit the architecture.
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


def _done(name, folder, stamp, say):
    """The metrics of a network that was trained from the same, or None."""
    path = folder / "metrics.json"
    if not is_current(path, stamp, folder / "weights.npz"):
        return None
    say(f"{name}: up to date ({folder})")
    return read_json(path, DELETE_ITS_FOLDER)


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


def _neurons(settings, trained, inputs):
    """Shares of silent and saturated neurons of each convolution on the training samples."""
    fastest = fastest_rate(settings.snn.tau_ref)
    outputs = trained.activations(inputs)
    return {
        name: asdict(activity(output * settings.snn.max_rate(index), fastest))
        for index, (name, output) in enumerate(outputs.items())
    }
