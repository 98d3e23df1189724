"""What conversion and chip cost, on the whole test split and over seeds.

The yardstick is the stronger of two CNNs of one architecture: the paper's recipe, and the annealed
one that the spiking network is trained with (:data:`pipeline.training.RECIPES`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy import stats

from deploy.operations import multiply_accumulates
from deploy.targets import answer
from pipeline.images import tactile_images
from pipeline.settings import Settings
from pipeline.sources import load_recordings
from pipeline.splits import random_split

SCHEMA = "stmnist-losses/1"
STEPS = (100, 50)
PAPER = {"spiking-lif": 0.02, "chip-100": 0.03}
"""Accuracy that the paper loses from CNN to spiking network and to Loihi (Table 2)."""


@dataclass(frozen=True)
class Job:
    """One seed: of the split and of every training.

    Attributes
    ----------
    settings : Settings
    seed : int
    """

    settings: Settings
    seed: int


def measure(job: Job) -> dict:
    """Train and test everything for one seed.

    Returns
    -------
    dict
        ``accuracy`` of each stage on the whole test split, ``disagreements`` with the rate-based
        network as shares, ``operations`` as multiples of the CNN's multiply-accumulates.
    """
    from pipeline import nengodl, training  # TensorFlow, in the process that needs it
    from pipeline.conversion import deployed

    begun = time.perf_counter()
    settings, data = job.settings, job.settings.data
    recordings = load_recordings(
        data.source, data.simulation_seed, data.samples_per_digit, data.skip_bad, jobs=1
    )
    split = random_split(len(recordings), job.seed, settings.split.test_fraction)
    images = tactile_images(recordings, settings.image.aggregation, settings.image.normalisation)
    train = images[split.train], recordings.labels[split.train]
    shown, labels = images[split.test], recordings.labels[split.test]

    def predictions(logits):
        return np.argmax(logits, axis=1)

    paper = training.train_cnn(settings, train, job.seed)
    annealed = training.train_cnn(settings, train, job.seed, recipe=training.RECIPES["loihi"])
    rate = training.train_rate_network(settings, train, job.seed, paper.weights)
    found = {
        "cnn": predictions(training.cnn_logits(settings, paper.weights, shown)),
        "cnn-annealed": predictions(training.cnn_logits(settings, annealed.weights, shown)),
        "rate-lif": predictions(training.rate_logits(settings, rate.weights, shown)),
    }
    spiking = nengodl.run(settings, rate.weights, shown, max(STEPS))
    start = settings.presentation.readout_start
    found["spiking-lif"] = predictions(spiking[:, start:].mean(axis=1))
    spec = deployed(settings, rate.weights, {}, train[0])
    operations, decided = {}, {}
    for steps in STEPS:
        responses = answer(spec.with_presentation(steps=steps), shown, "fast", job.seed)
        stage = f"chip-{steps}"
        found[stage] = responses.predictions
        total = sum(counts.mean() for counts in responses.operations.values())
        operations[stage] = float(total / sum(multiply_accumulates(spec).values()))
        decided[stage] = float(np.median(responses.decided_at))
    return {
        "schema": SCHEMA,
        "seed": job.seed,
        "n_test": len(labels),
        "accuracy": {stage: float(np.mean(p == labels)) for stage, p in found.items()},
        "disagreements": {
            stage: float(np.mean(found[stage] != found["rate-lif"]))
            for stage in ("spiking-lif", *operations)
        },
        "operations": operations,
        "decided_at_median": decided,
        "seconds": time.perf_counter() - begun,
    }


def summarise(results, simulated: bool) -> dict:
    """Means over seeds, with 95 % intervals by Student's t; losses are paired by seed.

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
    stronger = max(("cnn", "cnn-annealed"), key=lambda stage: accuracy[stage].mean())

    def over_seeds(name):
        keys = results[0][name]
        return {key: _interval([r[name][key] for r in results]) for key in keys}

    return {
        "schema": SCHEMA,
        "simulated": simulated,
        "seeds": [r["seed"] for r in results],
        "n_test": results[0]["n_test"],
        "accuracy": over_seeds("accuracy"),
        "stronger_cnn": stronger,
        "loss": {
            stage: _interval(accuracy[stronger] - accuracy[stage])
            for stage in stages
            if not stage.startswith("cnn")
        },
        "disagreements": over_seeds("disagreements"),
        "operations": over_seeds("operations"),
        "decided_at_median": over_seeds("decided_at_median"),
    }


def _interval(values):
    values = np.asarray(values, float)
    entry = {"mean": float(values.mean()), "values": values.tolist()}
    if len(values) > 1:
        half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
        entry["ci95"] = [entry["mean"] - float(half), entry["mean"] + float(half)]
    return entry


def losses_text(summary: dict) -> str:
    """The summary as a table."""

    def shown(entry, scale=100, digits=2):
        low, high = entry.get("ci95", (float("nan"),) * 2)
        mean, low, high = (scale * value for value in (entry["mean"], low, high))
        return f"{mean:7.{digits}f}  ({low:.{digits}f} to {high:.{digits}f})"

    what = "simulated samples" if summary["simulated"] else "samples"
    lines = [
        f"Mean over {len(summary['seeds'])} seeds (95 % interval), each on the whole test split of "
        f"{summary['n_test']} {what}",
        "",
        "accuracy in %",
        *(f"  {stage:<22}{shown(entry)}" for stage, entry in summary["accuracy"].items()),
        f"points lost from the stronger CNN ({summary['stronger_cnn']}); in the paper "
        + ", ".join(f"{100 * lost:.0f} to {stage}" for stage, lost in PAPER.items()),
        *(f"  {stage:<22}{shown(entry)}" for stage, entry in summary["loss"].items()),
        "predictions that differ from the rate-based network's, in %",
        *(f"  {stage:<22}{shown(entry)}" for stage, entry in summary["disagreements"].items()),
        "synaptic operations an inference, in multiples of the CNN's multiply-accumulates",
        *(f"  {stage:<22}{shown(entry, 1)}" for stage, entry in summary["operations"].items()),
        "step from which half the samples are decided for good",
        *(
            f"  {stage:<22}{shown(entry, 1, 0)}"
            for stage, entry in summary["decided_at_median"].items()
        ),
    ]
    return "\n".join(lines)
