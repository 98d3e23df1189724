"""The value of timing: networks trained and tested on events with reduced information.

See :mod:`pipeline.data.variants`.  Separate networks are trained on each variant with
the recipe of the settings, and all are tested on the same samples on the target fast.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from pipeline.results.resampling import estimate

from deploy.check.intervals import mcnemar, wilson_interval
from deploy.network.decision import share_of_time
from deploy.tables import aligned, p_text
from deploy.targets.registry import answer
from pipeline import stages
from pipeline.artifacts import Origin
from pipeline.data.dataset import Dataset
from pipeline.data.steps import EventTable
from pipeline.data.variants import VARIANTS, durations_ns, vary
from pipeline.paper import CNN_MACS
from pipeline.results.study import Experiment, Task, counted
from pipeline.roads.origins import trained_origin
from pipeline.settings import Settings
from pipeline.training.history import read_history

SCHEMA = "stmnist-time/2"
AS_IS = "as-is"
"""The variant with which the others are compared."""

MEANS = ("operations", "spikes_in", "merged", "share", "accuracy_by_itself", "agreement", "trained")
"""Values that are averaged over seeds; see :func:`measure`."""


def result_origin(settings: Settings, dataset: Origin, subject: str) -> Origin:
    """The origin of the result of a variant (``subject``) on a split."""
    trained = trained_origin(settings, _of_variant(dataset, subject))
    reads = ["presentation"]
    return Origin.of(settings, reads, [trained], {"schema": SCHEMA})


def _of_variant(dataset, variant):
    """The origin of a data set whose events were changed."""
    return replace(dataset, contents={**dataset.contents, "variant": variant})


def dataset_of_variant(dataset: Dataset, variant: str, seed: int) -> Dataset:
    """A data set with its events changed.

    Recordings that are reduced to counts last as long as the median training sample.
    """
    lasts = float(np.median(durations_ns(dataset.recordings)[dataset.split.train]))
    varied = vary(dataset.recordings, variant, seed, lasts)
    origin = _of_variant(dataset.origin, variant)
    return Dataset(varied, dataset.split, origin, dataset.settings)


def measure(task: Task) -> dict:
    """Train on a variant with one seed, and test on its complete test split.

    Parameters
    ----------
    task : Task

    Returns
    -------
    dict
        On the chip (the target fast): ``predictions`` beside the ``labels``, at the end, in streams
        as the settings have them, and ``predictions_from_rest`` with a fresh network for each
        sample; mean synaptic ``operations`` as multiples of the paper's CNN's multiply-accumulates;
        ``accuracy_by_itself`` and mean ``share`` of the recording with early decisions.
        ``trained``: accuracy of the trained network, ``agreement``: share of samples with equal
        predictions of both.  ``spikes_in``: mean input spikes per sample, ``merged``: share of
        all events that are merged with another one into one spike.
    """
    from pipeline.training.events import TrainedOnEvents  # TensorFlow, where it is needed

    begun = time.perf_counter()
    settings, seed = task.settings, task.seed
    dataset = dataset_of_variant(task.dataset(), task.subject, seed)
    task.trained(dataset)
    network = stages.network_artifact("events", task.networks, settings, dataset.origin)
    spec = stages.spec_of(task.networks, settings, dataset, {})
    inputs, labels = dataset.part("test")
    expected = TrainedOnEvents.of(settings, task.weights("events", dataset)).answers(inputs)
    found = answer(spec, inputs, "fast", seed)
    alone = spec.with_presentation(stream_length=1)
    by_itself = found.decisions[np.arange(len(labels)), found.stopped_at - 1]
    meant = expected.outputs[:, -1].argmax(-1)
    return {
        "schema": SCHEMA,
        "variant": task.subject,
        **counted(task, dataset),
        "labels": labels.tolist(),
        "predictions": found.predictions.tolist(),
        "predictions_from_rest": answer(alone, inputs, "fast", seed).predictions.tolist(),
        "operations": float(sum(n.mean() for n in found.operations.values()) / CNN_MACS),
        "spikes_in": float(inputs.reshape(len(inputs), -1).sum(1, dtype=np.int64).mean()),
        "merged": EventTable.of(dataset.recordings).lost(settings.input.step, settings.input.rest),
        "confidence": spec.presentation.confidence,
        "share": float(share_of_time(found.stopped_at - 1, expected.last_step).mean()),
        "accuracy_by_itself": float(np.mean(by_itself == labels)),
        "agreement": float(np.mean(found.predictions == meant)),
        "trained": float(np.mean(meant == labels)),
        "history": read_history(network.folder / "history.csv"),
        "seconds": time.perf_counter() - begun,
    }


def summarise(results, simulated: bool) -> dict:
    """Means over seeds, the loss of each variant, and intervals.

    For one seed the interval is Wilson's and the p of the loss McNemar's, for the variation between
    test samples.  For several seeds both are for overlapping splits, and include the variation
    between trainings.

    Parameters
    ----------
    results : sequence of dict
        From :func:`measure`, of any variants and seeds.
    simulated : bool

    Returns
    -------
    dict
    """
    found = {name: {r["seed"]: r for r in results if r["variant"] == name} for name in VARIANTS}
    return {
        "schema": SCHEMA,
        "simulated": simulated,
        "n_train": results[0]["n_train"],
        "n_test": results[0]["n_test"],
        "variants": {
            name: {
                "seeds": sorted(of_seed),
                "accuracy": _accuracy(list(of_seed.values())),
                "loss": None if name == AS_IS else _loss(found[AS_IS], of_seed),
                **{key: float(np.mean([r[key] for r in of_seed.values()])) for key in MEANS},
            }
            for name, of_seed in found.items()
            if of_seed
        },
    }


def _accuracy(results):
    right = [_right(result) for result in results]
    got = estimate([r.mean() for r in right], results[0]["n_train"], results[0]["n_test"])
    if len(right) == 1:
        interval = wilson_interval(int(right[0].sum()), len(right[0]))
    else:
        interval = np.clip(got.interval, 0, 1)
    return {
        "mean": got.mean,
        "ci95": list(map(float, interval)),
        "values": [float(r.mean()) for r in right],
    }


def _loss(whole, varied):
    """Accuracy on unchanged events minus that on a variant, on common splits; None without any."""
    seeds = sorted(whole.keys() & varied.keys())
    if not seeds:
        return None
    pairs = [(_right(whole[seed]), _right(varied[seed])) for seed in seeds]
    first = whole[seeds[0]]
    values = [float(a.mean() - b.mean()) for a, b in pairs]
    got = estimate(values, first["n_train"], first["n_test"])
    return {
        **got.to_json(),
        "p_value": mcnemar(*pairs[0]) if len(pairs) == 1 else got.p_value,
        "values": values,
    }


def _right(result):
    return np.array(result["predictions"]) == np.array(result["labels"])


def events_text(summary: dict) -> str:
    """The summary as tables."""
    what = "simulated recordings" if summary["simulated"] else "recordings"
    seeds = max(len(row["seeds"]) for row in summary["variants"].values())
    heads = ["", "accuracy", "95 %", "points lost", "p"]
    accuracy = [heads, *([name, *_cells(row)] for name, row in summary["variants"].items())]
    heads = ["", "operations", "early at", "early right", "agree", "trained", "spikes in", "merged"]
    more = [heads, *([name, *_more(row)] for name, row in summary["variants"].items())]
    return "\n".join(
        [
            f"Value of timing: networks on events of {what}, {seeds} "
            f"seed{'s' if seeds > 1 else ''}, each on the whole test split of {summary['n_test']}",
            "",
            *aligned(accuracy),
            "",
            *aligned(more),
            "",
            *(f"{name}: {VARIANTS[name]}" for name in summary["variants"]),
            "accuracy: at the end, on the target fast, in %; points lost: as-is minus this variant",
            f"operations: synaptic, per inference, in multiples of the paper's CNN's {CNN_MACS:,}",
            "early at: share of the writing at the early decision, in %; early right: its accuracy",
            "agree: same answer of fast and the trained network, in %; trained: its accuracy",
            "spikes in: input spikes per sample; merged: events without a spike of their own, in %",
        ]
    )


def _cells(row):
    low, high = row["accuracy"]["ci95"]
    cells = [f"{100 * row['accuracy']['mean']:.2f}", f"{100 * low:.2f} to {100 * high:.2f}"]
    loss = row["loss"]
    if loss is None:
        return [*cells, "", ""]
    bounds = [f"{100 * bound:.2f}" for bound in loss["ci95"] or ()]
    interval = f" ({' to '.join(bounds)})" if bounds else ""
    return [*cells, f"{100 * loss['mean']:.2f}{interval}", p_text(loss["p_value"])]


def _more(row):
    return [
        f"{row['operations']:.2f}",
        *(
            f"{100 * row[key]:.1f}"
            for key in ("share", "accuracy_by_itself", "agreement", "trained")
        ),
        f"{row['spikes_in']:.0f}",
        f"{100 * row['merged']:.1f}",
    ]


EXPERIMENT = Experiment("events", measure, summarise, result_origin, events_text, tuple(VARIANTS))
"""The experiment; it needs settings with ``input.kind = "events"``."""
