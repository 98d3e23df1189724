"""What conversion and chip cost, on the whole test split and over seeds.

The yardstick is the stronger of two CNNs of one architecture: the paper's recipe, and the annealed
one that the spiking network is trained with (:data:`pipeline.training.networks.RECIPES`).
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from deploy.network.operations import multiply_accumulates
from deploy.tables import aligned
from deploy.targets.registry import answer
from pipeline.experiments.resampling import estimate
from pipeline.experiments.study import Findings, SplitJob, Workers, over_splits
from pipeline.paper import points_lost
from pipeline.run.folder import RunFolder
from pipeline.settings import Settings

SCHEMA = "stmnist-losses/2"
STEPS = (100, 50)
PAPERS = {"spiking-lif": "ann-snn", "chip-100": "loihi"}
"""Stages that are models of the paper's Table 2."""


def measure_losses(
    folder: RunFolder, settings: Settings, seeds: int, workers: Workers, say
) -> Findings:
    """Measure what is not there yet; see :func:`pipeline.experiments.study.over_splits`.

    Raises
    ------
    UserError
        The settings read the output later than the shortest presentation lasts, or as there.
    """
    for steps in STEPS:
        settings.with_values({"presentation": {"steps": steps}}, "benchmark losses")
    return over_splits(
        "losses", measure, summarise, folder, settings, seeds, workers, say, (SCHEMA,)
    )


def measure(job: SplitJob) -> dict:
    """Train and test everything for one seed.

    Parameters
    ----------
    job : SplitJob

    Returns
    -------
    dict
        ``accuracy`` of each stage on the whole test split, ``disagreements`` with the rate-based
        network as shares, ``operations`` as multiples of the CNN's multiply-accumulates.
    """
    from pipeline.run.conversion import deployed
    from pipeline.training import nengodl  # TensorFlow, in the process that needs it
    from pipeline.training import networks as training

    begun = time.perf_counter()
    settings, seed = job.settings, job.seed
    dataset = job.dataset()
    train, (shown, labels) = dataset.part("train"), dataset.part("test")

    def predictions(logits):
        return np.argmax(logits, axis=1)

    paper = training.train_cnn(settings, train, seed)
    annealed = training.train_cnn(settings, train, seed, recipe=training.RECIPES["loihi"])
    rate = training.train_rate_network(settings, train, seed, paper.weights)
    found = {
        "cnn": predictions(paper.logits(shown)),
        "cnn-annealed": predictions(annealed.logits(shown)),
        "rate-lif": predictions(rate.logits(shown)),
        "spiking-lif": nengodl.predict(
            replace(settings, seed=seed), rate.weights, shown, max(STEPS)
        ),
    }
    spec = deployed(settings, rate.weights, {}, train)
    operations, decided = {}, {}
    for steps in STEPS:
        responses = answer(spec.with_presentation(steps=steps), shown, "fast", seed)
        stage = f"chip-{steps}"
        found[stage] = responses.predictions
        total = sum(counts.mean() for counts in responses.operations.values())
        operations[stage] = float(total / sum(multiply_accumulates(spec).values()))
        decided[stage] = float(np.median(responses.decided_at))
    return {
        "schema": SCHEMA,
        "seed": seed,
        "n_train": len(train[1]),
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
    stronger = max(("cnn", "cnn-annealed"), key=lambda stage: accuracy[stage].mean())

    def interval(values):
        found = estimate(values, results[0]["n_train"], results[0]["n_test"])
        return {
            "mean": found.mean,
            "ci95": list(found.interval) if found.interval else None,
            "values": list(map(float, values)),
        }

    def over_seeds(name):
        return {key: interval([r[name][key] for r in results]) for key in results[0][name]}

    return {
        "schema": SCHEMA,
        "simulated": simulated,
        "seeds": [r["seed"] for r in results],
        "n_train": results[0]["n_train"],
        "n_test": results[0]["n_test"],
        "accuracy": over_seeds("accuracy"),
        "stronger_cnn": stronger,
        "loss": {
            stage: interval(accuracy[stronger] - accuracy[stage])
            for stage in stages
            if not stage.startswith("cnn")
        },
        "disagreements": over_seeds("disagreements"),
        "operations": over_seeds("operations"),
        "decided_at_median": over_seeds("decided_at_median"),
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
    lost = ", ".join(f"{points_lost(model):.0f} to {stage}" for stage, model in PAPERS.items())
    lines = [
        f"Mean over {len(summary['seeds'])} seeds (95 % interval), each on the whole test split of "
        f"{summary['n_test']} {what}",
        "",
        "accuracy in %",
        *table(summary["accuracy"]),
        f"points lost from the stronger CNN ({summary['stronger_cnn']}); in the paper {lost}",
        *table(summary["loss"]),
        "predictions that differ from the rate-based network's, in %",
        *table(summary["disagreements"]),
        "synaptic operations an inference, in multiples of the CNN's multiply-accumulates",
        *table(summary["operations"], 1),
        "step from which half the samples are decided for good",
        *table(summary["decided_at_median"], 1, 0),
    ]
    return "\n".join(lines)
