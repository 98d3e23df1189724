"""The stages of a run: each reads what the one before wrote, and is redone only if out of date."""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from deploy import __version__
from deploy.check.bundle import Bundle, CheckSet, read_bundle, write_bundle
from deploy.check.intervals import wilson_interval
from deploy.check.results import read_result
from deploy.check.run import answered, open_check, run_check
from deploy.errors import UserError
from deploy.files import read_arrays, read_json, sha256_of, write_arrays, write_json
from deploy.network.decision import Judge
from deploy.network.spec import NetworkSpec
from deploy.targets.registry import TARGETS
from models.architecture import parse
from models.own import ModelFileError, read_own_model
from pipeline.inputs.dataset import (
    TOO_SMALL,
    Dataset,
    event_warnings,
    images_fit,
    recordings_fit,
)
from pipeline.inputs.splits import draw_check_samples
from pipeline.jobs import Failure, run_jobs
from pipeline.progress import hidden, progress
from pipeline.recordings.facts import facts_of
from pipeline.run.answers import REFERENCES, reference_result, training_versions
from pipeline.run.diagnosis import activity, fastest_rate, training_lines
from pipeline.run.folder import RunFolder, is_current, stamp_of
from pipeline.run.history import write_history
from pipeline.settings import SIMULATED, Settings
from pipeline.training.threads import one_thread_each

REMEDY = "delete its folder and run the command again"
LEAST_KNOWN = 0.15
"""Share of the way from chance to always right that an own model must have gone.  Of 30 networks of
three layers with Keras's first weights the best had gone 0.06 of it by luck, on ten classes."""

REMEDY_CHECK = "delete it and run the command again"


def open_dataset(
    run: RunFolder,
    settings: Settings,
    jobs: int = 2,
    warn=None,
    check: bool = True,
    dataset: Dataset | None = None,
) -> Dataset:
    """Load, split and draw the recordings of a run; keep its settings; write ``dataset.json``.

    The settings are kept only now that the recordings are there and enough: a mistaken path or
    number of samples must not stick to the run.

    Parameters
    ----------
    run, settings
    jobs : int
        Processes.
    warn : callable, optional
        Called with a line for each thing that the user should know.
    check : bool
        Whether samples of a check will be drawn and shown; training alone needs none.
    dataset : Dataset, optional
        Of the same settings, in the place of their recordings; see :meth:`Dataset.of_arrays`.

    Raises
    ------
    UserError
        The source cannot be read, is too small for the split or the check, or cannot be shown.
    """
    if dataset is None:
        dataset = Dataset.of(settings, jobs, warn)
    elif dataset.is_of_arrays and dataset.recordings.source.name != settings.data.source:
        raise UserError(
            f"{settings.data.source}: other settings than the arrays were taken with; give "
            f"'data.source' {dataset.recordings.source.name!r}"
        )
    else:
        recordings_fit(dataset.recordings, settings)
    recordings, split = dataset.recordings, dataset.split
    if check:
        try:
            draw_check_samples(split.test, settings.check.samples, settings.seed)
        except ValueError as error:
            remedy = TOO_SMALL
            if settings.data != run.resolve_settings(None, {}).data:
                remedy += "; nothing was kept: name the data (--data) in the next command too"
            raise UserError(f"{settings.data.source}: {error}; {remedy}") from error
        if not settings.on_events:
            images_fit(dataset.inputs, settings)
    if warn is not None:
        for line in _notes(run, settings, recordings):
            warn(line)
    run.save_settings(settings)
    write_json(
        run.dataset,
        {
            **facts_of(recordings),
            "train": len(split.train),
            "validation": len(split.validation),
            "test": len(split.test),
        },
    )
    return dataset


def _notes(run, settings, recordings):
    """What should not pass without a word, such as simulated data that nobody asked for."""
    if settings.on_events:
        yield from event_warnings(settings, recordings)
    if not run.experiment.exists():
        if settings.data.source == SIMULATED:
            yield f"{run.path}: a new run, on simulated recordings (others: --data)"
    elif (before := run.resolve_settings(None, {}).input.kind) != settings.input.kind:
        yield (
            f"{run.path}: was a run of input.kind {before!r}; its network and bundle are replaced "
            "(name another folder to keep both)"
        )
    classes = recordings.sensor.classes
    missing = sorted(set(range(len(classes))) - set(recordings.labels.tolist()))
    if missing:
        names = ", ".join(classes[label] for label in missing)
        yield f"{settings.data.source}: no recordings of {names}; their outputs learn nothing"


def train(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Train the CNN, or read the user's own, unless it is there already; return its metrics."""
    one_thread_each()  # of a run on images all that follows in this process, trained before or not
    stamp = cnn_stamp(settings, dataset)
    if done := _done("cnn", run.cnn, stamp, say):
        return done
    if settings.cnn.model:
        return _take_over(run, settings, dataset, stamp, say)
    from pipeline.training.networks import train_cnn  # TensorFlow: seconds that _done can spare

    def train_it(advance):
        data, watched = dataset.part("train"), dataset.part("validation")
        return train_cnn(settings, data, settings.seed, watched, advance)

    return _train("cnn", run.cnn, stamp, settings.cnn.epochs, train_it, dataset, say)


def read_model(path: Path) -> tuple:
    """A user's Keras model, and the SHA-256 of its file.

    Returns
    -------
    OwnModel, str

    Raises
    ------
    UserError
        The file cannot be read, is no Keras model, or one that no chip can hold.
    """
    try:
        return read_own_model(path), sha256_of(path)
    except ModelFileError as error:
        raise UserError(str(error)) from error


def settings_of_model(path: Path, retrain: bool = False) -> dict:
    """Changes of the settings that put a user's Keras model in the place of the CNN.

    Parameters
    ----------
    path : path-like
    retrain : bool
        Train it on with rate-based LIF neurons.

    Raises
    ------
    UserError
        As :func:`read_model`.
    """
    path = Path(path)
    model, sha256 = read_model(path)
    rates = Settings().snn.max_rates[: max(len(model.architecture.spiking), 1)]
    return {
        "input": {"kind": "image"},
        "cnn": {
            "model": str(path.absolute()),
            "model_sha256": sha256,
            "architecture": str(model.architecture),
        },
        "snn": {"recipe": "loihi" if retrain else "as-is", "max_rates": rates},
    }


def _take_over(run, settings, dataset, stamp, say):
    """Put the user's model in the place of the CNN; it must know more than chance."""
    path = Path(settings.cnn.model)
    model, sha256 = read_model(path)
    if sha256 != settings.cnn.model_sha256 or str(model.architecture) != settings.cnn.architecture:
        raise UserError(f"{path}: has changed; give it again with 'stmnist convert RUN --model'")
    from pipeline.training.networks import TrainedCNN

    taken = TrainedCNN(settings, model.weights)
    images, labels = dataset.part("train")
    right = int((taken.logits(images).argmax(1) == labels).sum())
    likeliest = np.bincount(labels).max() / len(labels)
    if wilson_interval(right, len(labels))[0] <= likeliest + LEAST_KNOWN * (1 - likeliest):
        raise UserError(
            f"{path}: hardly better than chance on this run's training samples (accuracy "
            f"{right / len(labels):.3f}, {likeliest:.3f} by always answering the same): never "
            "trained, trained on other inputs than tactile images as [image] in the settings makes "
            "them, or with the classes in another order"
        )
    for note in model.notes:
        say(f"cnn: {note}")
    return _train("cnn", run.cnn, stamp, 0, lambda advance: taken, dataset, say)


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


def make_bundle(
    run: RunFolder, settings: Settings, jobs: int = 1, say=print, dataset: Dataset | None = None
) -> tuple:
    """Do what is missing of a run up to its bundle; return the dataset and the bundle.

    ``dataset`` is as in :func:`open_dataset`.
    """
    dataset = open_dataset(run, settings, jobs, say, dataset=dataset)
    train_all(run, settings, dataset, say)
    return dataset, convert(run, settings, dataset, say)


def train_all(run: RunFolder, settings: Settings, dataset: Dataset, say=print):
    """Train what the bundle is made from, unless it is there already."""
    if settings.on_events:
        train_on_events(run, settings, dataset, say)
    else:
        train(run, settings, dataset, say)
        train_rates(run, settings, dataset, say)


def convert(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> Bundle:
    """Write the bundle with the samples of its check.

    Returns
    -------
    Bundle
        The one that is there, if it is up to date.
    """
    on_events = settings.on_events
    stamp = stamp_of(
        trained_stamp(settings, dataset),
        asdict(settings.deployment),
        asdict(settings.presentation),
        asdict(settings.check),
    )
    if run.bundle.exists():
        bundle = read_bundle(run.bundle)
        if bundle.spec.provenance.get("made_from") == stamp:
            say(f"bundle: up to date ({run.bundle})")
            return bundle
    if not on_events:
        read_weights(run.cnn, settings)  # damaged ones are found now, not once the bundle is there
    chosen = draw_check_samples(dataset.split.test, settings.check.samples, settings.seed)
    recordings = dataset.recordings
    provenance = {
        "made_from": stamp,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "classes": list(recordings.sensor.classes),
        "seed": settings.seed,
        "recipe": "events" if on_events else settings.snn.recipe,
        "image": asdict(settings.image),
        "package": __version__,
    }
    spec = spec_of(run, settings, dataset, provenance)
    bundle = write_bundle(run.bundle, spec, _check_set(settings, dataset, chosen))
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")
    return bundle


def spec_of(run: RunFolder, settings: Settings, dataset: Dataset, provenance: dict) -> NetworkSpec:
    """The network that was trained in a run, as the chip gets it."""
    weights = read_weights(run.snn, settings)
    if not settings.on_events:
        from pipeline.run.conversion import deployed

        return deployed(settings, weights, provenance, dataset.part("train"))
    from pipeline.run.event_conversion import deployed_on_events

    early = read_json(run.snn / "metrics.json", REMEDY)["decides_by_itself"]
    return deployed_on_events(settings, weights, early["confidence"], provenance)


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
        One of :data:`pipeline.run.answers.REFERENCES`, or a target.
    say : callable
    whole : bool
        The samples are those of :func:`on_test_split`.
    """
    path = run.whole_check(stage) if whole else run.check(stage)
    if _answers(path, bundle):
        say(f"{stage}: up to date ({path})")
        return read_result(path, REMEDY_CHECK)
    with progress(f"check {stage}", len(bundle.checks)) as advance:
        if stage not in REFERENCES[settings.input.kind]:
            return run_check(bundle, stage, path, settings.seed, advance)
        weights = read_weights(run.cnn if stage == "cnn" else run.snn, settings)
        result = reference_result(stage, settings, weights, bundle, advance)
        write_json(path, result)
        return result


def answer_all(
    run: RunFolder,
    settings: Settings,
    bundle: Bundle,
    asked,
    jobs: int = 1,
    say=print,
    whole: bool = False,
) -> list:
    """:func:`answer` of several stages; targets in processes, the networks meanwhile in this one.

    What processes share are streams, not targets: no core is idle while the last target is at work.

    Parameters
    ----------
    run, settings, bundle, say, whole
        As in :func:`answer`.
    asked : sequence of str
    jobs : int
        Processes.

    Returns
    -------
    list of dict
        In the order that was asked for.

    Raises
    ------
    UserError
        A target failed; those that did not are kept.
    """
    networks = REFERENCES[settings.input.kind]
    paths = {stage: run.whole_check(stage) if whole else run.check(stage) for stage in asked}
    results = {}
    targets = [s for s in asked if s not in networks and not _answers(paths[s], bundle)]
    if jobs > 1 and any(TARGETS[name].slow for name in targets):
        here = [stage for stage in asked if stage not in targets]
        with progress("check", len(asked) * len(bundle.checks)) as advance:

            def answer_here():
                for stage in here:
                    with hidden():
                        results[stage] = answer(run, settings, bundle, stage, say, whole)
                    advance(len(bundle.checks), stage)

            wanted = {name: paths[name] for name in targets}
            results |= _shared(bundle, wanted, settings.seed, jobs, advance, answer_here)
    for stage in asked:
        if stage not in results:
            results[stage] = answer(run, settings, bundle, stage, say, whole)
    return [results[stage] for stage in asked]


def _shared(bundle, paths, seed, jobs, advance, meanwhile):
    """Results of targets, by name: each stream that is left is a job, wherever one takes long."""
    checks, failures = {}, {}
    with contextlib.ExitStack() as opened:
        for name, path in paths.items():
            tell = partial(advance, note=name)
            checks[name] = opened.enter_context(open_check(bundle, name, path, seed, tell))
        work = [job for check in checks.values() for job in _work(check)]
        for job, records in run_jobs(_answered, work, jobs, meanwhile=meanwhile):
            if isinstance(records, Failure):
                failures.setdefault(job.target, records)
            else:
                for record in records:
                    checks[job.target].take(record)
        results = {name: checks[name].finish() for name in checks if name not in failures}
    for name, failure in failures.items():
        failure.raise_again(f"target {name}")
    return results


def _work(check):
    parts = [[part] for part in check.left] if check.target.slow else [check.left]
    return [check.work(streams) for streams in parts if streams]


def _answered(work):
    return list(answered(work))


def read_weights(folder: Path, settings: Settings) -> dict:
    """The trained arrays in a network's folder.

    Raises
    ------
    UserError
        They are not there, damaged, or do not fit the architecture.
    """
    path = folder / "weights.npz"
    weights = read_arrays(path, REMEDY)
    if settings.on_events:
        architecture = settings.events.architecture
        parsed = parse(architecture)
        shapes = parsed.event_weight_shapes | Judge.shapes(parsed.outputs)
    else:
        architecture = settings.cnn.architecture
        shapes = parse(architecture).weight_shapes
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(f"{path}: not the weights of {architecture}; {REMEDY}")
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
    cnn = asdict(settings.cnn)
    if cnn.pop("model"):  # whose content counts, wherever it lies; nothing is trained
        cnn = {name: cnn[name] for name in ("architecture", "model_sha256")}
    parts = map(asdict, (settings.data, settings.skin, settings.image, settings.split))
    source = dataset.recordings.source.sha256
    return stamp_of(__version__, source, settings.seed, *parts, cnn)


def snn_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the rate-based network's training depends on."""
    return stamp_of(cnn_stamp(settings, dataset), asdict(settings.snn))


def events_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the training on events depends on."""
    parts = (settings.data, settings.input, settings.split, settings.events)
    recordings = dataset.recordings
    judge = Judge.shapes(len(recordings.sensor.classes))
    return stamp_of(
        __version__, recordings.source.sha256, settings.seed, *map(asdict, parts), judge
    )


def trained_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the training of the network for the chip depends on."""
    return (events_stamp if settings.on_events else snn_stamp)(settings, dataset)


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
