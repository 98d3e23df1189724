"""Losses of accuracy by conversion and chip, on the complete test split and over seeds.

The reference is the stronger of two CNNs of one architecture: the paper's recipe, and the annealed
one that the spiking network is trained with (:data:`pipeline.training.networks.RECIPES`).  With
events as input the network that is trained on them replaces the conversion.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from deploy.network.operations import multiply_accumulates
from deploy.tables import aligned
from deploy.targets.registry import answer
from pipeline import stages
from pipeline.artifacts import Origin
from pipeline.paper import CNN_MACS, points_lost
from pipeline.results.resampling import estimate
from pipeline.results.study import (
    CNN_SETTINGS,
    Experiment,
    Task,
    accuracies,
    counted,
    silent,
    summary_of_splits,
)
from pipeline.roads.origins import trained_origin
from pipeline.settings import Settings

SCHEMA = "stmnist-losses/2"
STEPS = (100, 50)
CNNS = ("cnn", "cnn-annealed")
TRAINED = {"image": "rate-lif", "events": "trained"}
"""Name of the network that is trained for the chip, by the kind of input."""

PAPERS = {"spiking-lif": "ann-snn", "chip-100": "loihi"}
"""Stages that are models of the paper's Table 2."""


def refuse(settings: Settings):
    """Refuse settings that read the output later than the shortest presentation lasts.

    Raises
    ------
    UserError
    """
    for steps in () if settings.on_events else STEPS:
        settings.with_values({"presentation": {"steps": steps}}, "benchmark losses")


def result_origin(settings: Settings, dataset: Origin, subject: str = "") -> Origin:
    """The origin of the result of a split."""
    reads = [*CNN_SETTINGS, "deployment", "presentation"]
    return Origin.of(settings, reads, [trained_origin(settings, dataset)], {"schema": SCHEMA})


def measure(task: Task) -> dict:
    """Train and test everything for one seed.

    Parameters
    ----------
    task : Task

    Returns
    -------
    dict
        ``accuracy`` of each stage on the whole test split, ``disagreements`` with the network that
        was trained for the chip (:data:`TRAINED`) as shares, ``operations`` as multiples of the
        CNN's multiply-accumulates.
    """
    begun = time.perf_counter()
    dataset, kind = task.dataset(), task.settings.input.kind
    labels = dataset.part("test")[1]
    measured = _on_events if kind == "events" else _on_images
    networks, chips, cnn_operations = measured(task, dataset)
    found = {**networks, **{stage: responses.predictions for stage, responses in chips.items()}}
    return {
        "schema": SCHEMA,
        **counted(task, dataset),
        "accuracy": accuracies(found, labels),
        "disagreements": {
            stage: float(np.mean(predictions != found[TRAINED[kind]]))
            for stage, predictions in found.items()
            if stage not in (*CNNS, TRAINED[kind])
        },
        "operations": {
            stage: float(sum(n.mean() for n in responses.operations.values()) / cnn_operations)
            for stage, responses in chips.items()
        },
        "stable_after_median": {
            stage: responses.stable_after_median for stage, responses in chips.items()
        },
        "seconds": time.perf_counter() - begun,
    }


def _on_images(task, dataset):
    """Predictions of the networks, responses of the chip by its stage, the CNN's operations."""
    from pipeline.training import nengodl, networks  # TensorFlow, in the process that needs it

    settings, inputs = task.settings, dataset.part("test")[0]
    task.trained(dataset)
    found = _cnns(task, dataset, settings)
    weights = task.weights("rate-lif", dataset)
    found["rate-lif"] = networks.TrainedRates(settings, weights).logits(inputs).argmax(1)
    found["spiking-lif"] = nengodl.predict(settings, weights, inputs, max(STEPS))
    spec = stages.spec_of(task.networks, settings, dataset, {})
    chips = {
        f"chip-{steps}": answer(spec.with_presentation(steps=steps), inputs, "fast", task.seed)
        for steps in STEPS
    }
    return found, chips, sum(multiply_accumulates(spec).values())


def _on_events(task, dataset):
    """As :func:`_on_images`, for the network on events, and CNNs on images of the same samples."""
    from pipeline.training.events import TrainedOnEvents

    settings = task.settings
    # The CNNs' training makes TensorFlow compute in one thread, which changes the last digits of
    # what this process trains after it.  So the network on events comes first.
    task.trained(dataset)
    on_images = replace(settings, input=replace(settings.input, kind="image"))
    found = _cnns(task, dataset.seen_by(on_images), on_images)
    trained = TrainedOnEvents.of(settings, task.weights("events", dataset))
    inputs = dataset.part("test")[0]
    found["trained"] = trained.logits(inputs).argmax(1)
    spec = stages.spec_of(task.networks, settings, dataset, {})
    return found, {"chip": answer(spec, inputs, "fast", task.seed)}, CNN_MACS


def _cnns(task, dataset, settings):
    """Predictions of both CNNs on the test images."""
    from pipeline.training import networks

    stages.train("cnn", task.networks, settings, dataset, silent)
    weights = stages.weights_of("cnn", task.networks, settings, dataset.origin)
    paper = networks.TrainedCNN(settings, weights)
    recipe = networks.RECIPES["loihi"]
    annealed = networks.train_cnn(settings, dataset.part("train"), task.seed, recipe=recipe)
    inputs = dataset.part("test")[0]
    return {
        stage: network.logits(inputs).argmax(1)
        for stage, network in zip(CNNS, (paper, annealed), strict=True)
    }


def summarise(results, simulated: bool) -> dict:
    """Means over seeds, with 95 % intervals for overlapping splits; losses are paired by seed.

    Parameters
    ----------
    results : sequence of dict
        From :func:`measure`.
    simulated : bool

    Returns
    -------
    dict
    """
    stages = list(results[0]["accuracy"])
    accuracy = {stage: np.array([r["accuracy"][stage] for r in results]) for stage in stages}
    stronger = max(CNNS, key=lambda stage: accuracy[stage].mean())

    def interval(values):
        found = estimate(values, results[0]["n_train"], results[0]["n_test"])
        return {**found.to_json(), "values": list(map(float, values))}

    def over_seeds(name):
        return {key: interval([r[name][key] for r in results]) for key in results[0][name]}

    return {
        "schema": SCHEMA,
        **summary_of_splits(results, simulated),
        "accuracy": over_seeds("accuracy"),
        "stronger_cnn": stronger,
        "loss": {
            stage: interval(accuracy[stronger] - accuracy[stage])
            for stage in stages
            if stage not in CNNS
        },
        "disagreements": over_seeds("disagreements"),
        "operations": over_seeds("operations"),
        "stable_after_median": over_seeds("stable_after_median"),
    }


def losses_text(summary: dict) -> str:
    """The summary as a table."""

    def table(entries, scale=100, digits=2):
        rows = []
        for stage, entry in entries.items():
            bounds = [f"{scale * value:.{digits}f}" for value in entry["ci95"] or ()]
            interval = f"({' to '.join(bounds)})" if bounds else ""
            rows.append([stage, f"{scale * entry['mean']:.{digits}f}", interval])
        return [f"  {line}" for line in aligned(rows)]

    what = "simulated samples" if summary["simulated"] else "samples"
    lost = ", ".join(
        f"{points_lost(model):.0f} to {stage}"
        for stage, model in PAPERS.items()
        if stage in summary["loss"]
    )
    lost = f"; in the paper {lost}" if lost else ""
    trained = "trained" if TRAINED["events"] in summary["accuracy"] else "rate-based"
    lines = [
        f"Mean over {len(summary['seeds'])} seeds (95 % interval), each on the whole test split of "
        f"{summary['n_test']} {what}",
        "",
        "accuracy in %",
        *table(summary["accuracy"]),
        f"points lost from the stronger CNN ({summary['stronger_cnn']}){lost}",
        *table(summary["loss"]),
        f"predictions that differ from the {trained} network's, in %",
        *table(summary["disagreements"]),
        "synaptic operations per inference, in multiples of the CNN's multiply-accumulates",
        *table(summary["operations"], 1),
        "median step after which the answer did not change",
        *table(summary["stable_after_median"], 1, 0),
    ]
    return "\n".join(lines)


EXPERIMENT = Experiment(
    *("losses", measure, summarise, result_origin, losses_text),
    refuse=refuse,
    other_inputs=("image",),  # of the CNNs with which a network on events is compared
)
