"""The report of a run: one self-contained HTML file."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from importlib import resources

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from deploy import __version__
from deploy.check.bundle import Bundle
from deploy.check.energy import estimate_energy
from deploy.check.intervals import wilson_interval
from deploy.network.responses import seconds_per_sample
from deploy.tables import p_text
from deploy.targets.registry import TARGETS
from pipeline.data import table1
from pipeline.data.events import Recordings
from pipeline.data.images import growing, normalise
from pipeline.data.steps import EventTable
from pipeline.data.words import are_digits
from pipeline.paper import TABLE1
from pipeline.results.ladder import confusion_matrix, ladder_json, points_text
from pipeline.results.report import charts
from pipeline.results.report.matrix import confusion_shares
from pipeline.results.report.over_time import final_probabilities
from pipeline.roads.answers import NETWORKS, REFERENCES
from pipeline.settings import Settings

ZERO_MEANS = {
    "data.samples_per_digit": "0: the published numbers",
    **{f"snn.{name}": "0: the recipe's own" for name in ("epochs", "batch_size", "learning_rate")},
}
FRAMES = 6
"""Number of pictures of the growing tactile image."""


@dataclass(frozen=True)
class Inputs:
    """The data of a report.

    Attributes
    ----------
    name : str
        The run's folder.
    settings : Settings
    recordings : Recordings
    bundle : Bundle
    results : list of dict
        Check results of the bundle, in the order of the ladder.
    metrics : dict of str to dict
        ``metrics.json`` of ``cnn`` and ``snn``.
    histories : dict of str to list of dict
        Rows with one epoch each, for each trained network.
    plan : dict or None
        The plan of the placement, as plain values.
    replays : dict of int to Replay
        Spikes of the samples in the report, by their index in the check.
    beside : dict or None
        Check result of a run on images with the same recordings.
    outdated : dict of str to str
        Outdated artifacts, with the reasons.
    over_time : dict of int to ndarray
        Probabilities of the classes at each step of the samples of the browser; see
        :mod:`pipeline.results.report.over_time`.
    others : list of dict
        Check results of the bundle on other recordings.
    rates : dict of str to list of (float, float)
        For each layer rates of neurons in the trained network and on the chip, in spikes per
        second; see :func:`pipeline.roads.diagnosis.rate_points`.
    """

    name: str
    settings: Settings
    recordings: Recordings
    bundle: Bundle
    results: list
    metrics: dict
    histories: dict
    plan: dict | None
    replays: dict
    beside: dict | None = None
    outdated: dict = field(default_factory=dict)
    over_time: dict = field(default_factory=dict)
    others: list = field(default_factory=list)
    rates: dict = field(default_factory=dict)


def render(inputs: Inputs, now: datetime.datetime | None = None) -> str:
    """Write the report.

    Parameters
    ----------
    inputs : Inputs
    now : datetime, optional
        Time that is printed in the header.

    Returns
    -------
    str
        HTML that includes its style and pictures; without scripts and external files.
    """
    environment = Environment(
        loader=PackageLoader("pipeline.results.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["p"] = p_text
    environment.filters["percent"] = lambda share: f"{100 * share:.1f} %"
    now = now or datetime.datetime.now(datetime.UTC)
    return environment.get_template("report.html.j2").render(
        style=resources.files("pipeline.results.report")
        .joinpath("report.css")
        .read_text(encoding="utf-8"),
        made=now.strftime("%Y-%m-%d %H:%M UTC"),
        package=__version__,
        settings=inputs.settings.flat(),
        relevant=inputs.settings.relevant(),
        defaults=ZERO_MEANS,
        name=inputs.name,
        classes=inputs.recordings.sensor.classes,
        of_digits=_of_digits(inputs.recordings),
        what=_word(inputs.recordings),
        summary=class_summary(inputs.recordings),
        network=_network(inputs),
        browser=_browser(inputs),
        others=inputs.others,
        rates=_rate_charts(inputs.rates),
        source=inputs.recordings.source,
        n_recordings=len(inputs.recordings),
        n_taxels=len(inputs.recordings.taxels),
        trained_title=trained_title(inputs.settings),
        bundle=inputs.bundle,
        steps=inputs.bundle.spec.presentation.steps,
        metrics=inputs.metrics,
        plan=inputs.plan,
        ladder=_ladder(inputs),
        table1=_table1(inputs.recordings),
        anytime=_anytime(inputs),
        written=_while_written(inputs),
        curves=_learning_curves(inputs.histories),
        matrices=_confusions(inputs),
        stories=_stories(inputs),
        energy=_energy(inputs),
        outdated=inputs.outdated,
        activity=_activity(inputs),
        versions={k: v for result in inputs.results for k, v in result["versions"].items()},
    )


def choose_samples(result: dict, stream_length: int) -> list:
    """Indices of a sample with a correct answer and of one with a wrong answer, if any.

    Samples early in their streams are preferred, because a replay starts with the stream.
    """
    chosen = []
    for right in (True, False):
        candidates = [
            index
            for index, sample in enumerate(result["samples"])
            if (sample["label"] == sample["prediction"]) == right
        ]
        if candidates:
            chosen.append(min(candidates, key=lambda index: (index % stream_length, index)))
    return chosen


def _of_digits(recordings):
    """True if recordings are written digits in the layout of ST-MNIST, not from a camera."""
    return are_digits(recordings.sensor.classes) and not recordings.source.time_unit


def _word(recordings):
    return "writing" if _of_digits(recordings) else "recording"


BROWSED_WRONG, BROWSED_RIGHT = 16, 8
"""Maximum number of samples of the browser."""


def browsed_samples(result: dict) -> list:
    """Indices of samples for the sample browser: wrong answers first, then some right ones."""
    right = [sample["label"] == sample["prediction"] for sample in result["samples"]]
    wrong = [index for index, is_right in enumerate(right) if not is_right]
    others = [index for index, is_right in enumerate(right) if is_right]
    return wrong[:BROWSED_WRONG] + others[:BROWSED_RIGHT]


def class_summary(recordings: Recordings) -> list:
    """Name, number of recordings, mean events and mean seconds of each class."""
    events, n = recordings.events, len(recordings)
    on = np.bincount(recordings.sample_of_event, events.polarity > 0, n)
    off = np.bincount(recordings.sample_of_event, events.polarity <= 0, n)
    lasts = EventTable.of(recordings).duration_ms / 1000 if len(events) else np.zeros(n)
    return [
        {
            "name": name,
            "n": int(mine.sum()),
            "on": float(on[mine].mean()) if mine.any() else 0.0,
            "off": float(off[mine].mean()) if mine.any() else 0.0,
            "seconds": float(lasts[mine].mean()) if mine.any() else 0.0,
        }
        for label, name in enumerate(recordings.sensor.classes)
        for mine in [recordings.labels == label]
    ]


def _network(inputs):
    """The layers in the order of the data flow: shape, neurons, cores."""
    spec, plan = inputs.bundle.spec, inputs.plan
    cores = [core["layer"] for core in plan["cores"]] if plan else []
    shape = "x".join(map(str, spec.input_shape))
    boxes = [{"name": "input", "shape": shape, "neurons": int(np.prod(spec.input_shape)),
              "where": "host"}]  # fmt: skip
    for layer in spec.layers:
        n = cores.count(layer.name)
        where = f"{n} core{'' if n == 1 else 's'}" if n else "host"
        size = "x".join(map(str, np.atleast_1d(layer.shape)))
        kind = f"{layer.kernel}x{layer.kernel} convolution" if layer.kind == "conv" else "dense"
        boxes.append(
            {"name": f"{layer.name}, {kind}", "shape": size, "where": where,
             "neurons": layer.size if layer.neurons is not None else None}
        )  # fmt: skip
    return boxes


def _browser(inputs):
    """Samples one by one: image, events over time, probabilities over time, the decision."""
    if not inputs.over_time:
        return []
    result, spec = inputs.results[-1], inputs.bundle.spec
    classes, recordings = inputs.recordings.sensor.classes, inputs.recordings
    position = {name: index for index, name in enumerate(recordings.ids)}
    step_ms, start = 1000 * spec.stimulus.step_seconds, spec.presentation.readout_start
    shown = []
    for index, chances in inputs.over_time.items():
        sample = result["samples"][index]
        recording = position[sample["id"]]
        decided = sample["decided_at"]  # the step of an early decision may be of another class
        top = list(np.argsort(-chances[-1], kind="stable")[:SHOWN_CLASSES])
        if sample["label"] not in top:
            top[-1] = sample["label"]
        drawn = drawn_steps(len(chances))
        at_ms = tuple((start + 1 + drawn) * step_ms)
        series = [
            charts.Series(classes[label], at_ms, tuple(chances[drawn, label].round(4)))
            for label in top
        ]
        shown.append(
            {
                "id": sample["id"],
                "right": sample["label"] == sample["prediction"],
                "shown": classes[sample["label"]],
                "answered": classes[sample["prediction"]],
                "probability": float(chances[-1, sample["prediction"]]),
                "decided_ms": decided * step_ms,
                "image": _frames(inputs, recording, 1)[0]["chart"],
                "events": _events_chart(recordings, recording),
                "chances": charts.line_chart(
                    series,
                    "milliseconds since the start of the presentation",
                    "probability",
                    (0.0, 1.0),
                    f"Probability of the classes over time, sample {sample['id']}",
                    mark=decided * step_ms,
                ),
                "legend": charts.legend([s.name for s in series]),
            }
        )
    return shown


def drawn_steps(n: int) -> np.ndarray:
    """The steps of a curve that are drawn: at most about 200, and always the last one."""
    every = max(1, n // 100)
    return np.append(np.arange(0, n - 1, every), n - 1)


SHOWN_CLASSES = 4
"""Number of classes whose probability is drawn: the most likely at the end, and the right one."""


def _events_chart(recordings, recording):
    events = recordings[recording]
    return charts.raster(
        [
            (name, events.time_ns[mask] / 1e9, events.taxel[mask])
            for name, mask in (("on", events.polarity > 0), ("off", events.polarity < 0))
        ],
        max(float(events.time_ns.max(initial=0)) / 1e9, 0.1),
        "seconds",
        "taxel",
        f"Events of the {len(recordings.taxels)} taxels, ON and OFF",
        len(recordings.taxels),
    )


def _named(stage):
    """Title and note of a network or target."""
    if stage in NETWORKS:
        return NETWORKS[stage]
    return TARGETS[stage].title, TARGETS[stage].note


def _title(stage):
    return _named(stage)[0]


def trained_title(settings: Settings) -> str:
    """The name of the network that was trained for the chip."""
    return NETWORKS[REFERENCES[settings.network][:2][-1]][0]


def _ladder(inputs):
    rows = ladder_json(inputs.results)["rows"]
    for row in rows:
        row["title"] = _title(row["stage"])
        row["note"] = _named(row["stage"])[1]
    chart = charts.interval_chart(
        [(row["title"], row["accuracy"], row["accuracy_ci95"], None) for row in rows],
        "accuracy, with 95 % interval",
        "Accuracy of each stage from CNN to chip",
    )
    lost = points_text(100 * (rows[0]["accuracy"] - rows[-1]["accuracy"]))
    return {"rows": rows, "chart": chart, "n": inputs.results[0]["n_samples"], "lost": lost}


def _table1(recordings):
    """Table 1, with the paper's figures only if they are for the same recordings."""
    ours = table1.table(recordings)
    against_paper = table1.is_st_mnist(recordings)

    def row(title, name, places, pair=lambda value: value):
        cells = [
            {
                "ours": pair(mine[name]),
                "paper": against_paper and pair(TABLE1[digit][name]),
            }
            for digit, mine in ours.items()
        ]
        return {"title": title, "cells": cells, "places": places}

    return {
        "classes": [recordings.sensor.classes[digit] for digit in ours],
        "against_paper": against_paper,
        "rows": [
            *(
                row(table1.LABELS[name], name, 0 if name in ("on", "off") else 2)
                for name in table1.MEASURES
            ),
            row("Sample size", "samples", 0, lambda value: (value, None)),
        ],
    }


def _step(inputs):
    """The duration of a step of the presentation, in words."""
    return f"steps of {1000 * inputs.bundle.spec.stimulus.step_seconds:g} ms"


def _anytime(inputs):
    shown = [r for r in inputs.results if len(r["anytime_accuracy"]) > 1][-4:]
    if not shown:
        return None
    start = inputs.bundle.spec.presentation.readout_start
    series = [
        charts.Series(
            _title(r["target"]),
            tuple(range(start + 1, len(r["anytime_accuracy"]) + 1)),
            tuple(r["anytime_accuracy"][start:]),
        )
        for r in shown
    ]
    return {
        "chart": charts.line_chart(
            series,
            f"{_step(inputs)} since the start of the presentation",
            "accuracy",
            description="Accuracy if the decision were taken at each step",
        ),
        "legend": charts.legend([s.name for s in series]),
        "median": shown[-1]["decided_at_median"],
        "median_ms": 1000
        * inputs.bundle.spec.stimulus.step_seconds
        * shown[-1]["decided_at_median"],
        "target": _title(shown[-1]["target"]),
    }


def _while_written(inputs):
    """Accuracy against the share of the writing; for networks on events only."""
    result = inputs.results[-1]
    while_written = result.get("while_written")
    if not while_written:
        return None
    n, what = result["n_samples"], _word(inputs.recordings)
    series = [
        charts.Series(
            _title(result["target"]),
            tuple(100 * share for share in while_written["shares"]),
            tuple(while_written["accuracy"]),
            tuple(wilson_interval(round(n * a), n) for a in while_written["accuracy"]),
        )
    ]
    if inputs.beside:
        series.append(
            charts.Series(
                f"on images: {_title(inputs.beside['target'])}",
                (100,),
                (inputs.beside["accuracy"],),
                (tuple(inputs.beside["accuracy_ci95"]),),
            )
        )
    return {
        "chart": charts.line_chart(
            series,
            f"share of the {what}, %",
            "accuracy",
            description=f"Accuracy after each share of the {what}, with 95 % intervals",
        ),
        "legend": charts.legend([s.name for s in series]),
        "target": _title(result["target"]),
        "by_itself": _early(while_written.get("by_itself")),
        "waits": while_written.get("by_itself", {}).get("confidence") == 1,
        "end": result["accuracy"],
        "beside": inputs.beside,
    }


def _early(by_itself):
    """Results of early decisions, unless the network always decides at the end."""
    return by_itself if by_itself and by_itself["confidence"] < 1 else None


def _rate_charts(rates):
    """Chart for each layer: rates of neurons in the trained network and on the chip."""
    return [
        {
            "title": layer,
            "n": len(points),
            "chart": charts.scatter(
                points,
                "trained network, spikes per second",
                "on the chip",
                f"Rates of {len(points)} neurons of {layer}, trained against on the chip",
            ),
        }
        for layer, points in rates.items()
        if points
    ]


def _learning_curves(histories):
    """Accuracy and loss of each network on training and held-out samples."""
    parts = {"": "training", "val_": "validation", "test_": "test, not used in training"}
    curves = []
    for name, rows in histories.items():
        for measure in ("accuracy", "loss"):
            series = [
                charts.Series(
                    title,
                    tuple(row["epoch"] for row in rows),
                    tuple(row[part + measure] for row in rows),
                )
                for part, title in parts.items()
                if part + measure in rows[0]
            ]
            if series:
                chart = charts.line_chart(
                    series, "epoch", measure, description=f"Learning curve of {name}, {measure}"
                )
                legend = charts.legend([s.name for s in series])
                curves.append({"title": f"{name}: {measure}", "chart": chart, "legend": legend})
    return curves


def _confusions(inputs):
    matrices, classes = [], inputs.recordings.sensor.classes
    for result in (inputs.results[0], inputs.results[-1]):
        answers = [[s[key] for s in result["samples"]] for key in ("label", "prediction")]
        title = f"{_title(result['target'])}, the check's {len(answers[0])} samples"
        matrix = confusion_matrix(*answers, len(classes))
        matrices.append({"title": title, **confusion_cells(matrix, classes)})
    return matrices


def confusion_cells(matrix, classes) -> dict:
    """A confusion matrix for the page: shaded cells, or the most frequent confusions.

    Parameters
    ----------
    matrix : ndarray of int, shape (classes, classes)
    classes : sequence of str

    Returns
    -------
    dict
        ``rows`` of (name, cells), each cell a count, the opacity of its shade in percent and its
        kind; None if there are more classes than :data:`MOST_IN_A_MATRIX`.  ``common``: (count,
        class, answer) of the most frequent confusions.
    """
    matrix = np.asarray(matrix)
    shares = confusion_shares(matrix)
    rows = None
    if len(classes) <= MOST_IN_A_MATRIX:
        rows = []
        for label, name in enumerate(classes):
            cells = []
            for answer, count in enumerate(matrix[label].tolist()):
                # Errors are few: the square root makes one in a hundred visible.
                share = shares[label, answer]
                shade = 55 * share if label == answer else 75 * share**0.5
                kind = "on" if label == answer else "off"
                cells.append({"count": count, "shade": round(float(shade)), "kind": kind})
            rows.append((name, cells))
    wrong = [
        (int(count), classes[label], classes[answer])
        for (label, answer), count in np.ndenumerate(matrix)
        if label != answer and count
    ]
    return {"rows": rows, "common": sorted(wrong, key=lambda entry: -entry[0])[:5]}


MOST_IN_A_MATRIX = 20
"""Largest number of classes for which a confusion matrix is drawn."""


def _stories(inputs):
    result, stories, classes = inputs.results[-1], [], inputs.recordings.sensor.classes
    position = {name: index for index, name in enumerate(inputs.recordings.ids)}
    for index, replay in inputs.replays.items():
        sample = result["samples"][index]
        recording = position[sample["id"]]
        events = inputs.recordings[recording]
        rasters = [
            _layer_raster(layer, steps[steps >= 0], neurons[steps >= 0], replay, _step(inputs))
            for layer, (steps, neurons) in replay.spikes.items()
        ]
        stories.append(
            {
                "sample": sample,
                "shown": classes[sample["label"]],
                "answered": classes[sample["prediction"]],
                "right": sample["label"] == sample["prediction"],
                "frames": _frames(inputs, recording),
                "events": _events_chart(inputs.recordings, recording),
                "n_events": len(events),
                "layers": rasters,
                "scores": _scores(inputs.bundle.spec, sample, classes),
                "target": _title(result["target"]),
            }
        )
    return stories


def _layer_raster(layer, steps, neurons, replay, step):
    size = replay.neurons[layer]
    return {
        "title": f"{layer}: {size} neurons, {len(steps)} spikes",
        "chart": charts.raster(
            [("s1", steps, neurons)],
            replay.steps,
            step,
            "neuron",
            f"Spikes of {layer}",
            size,
        ),
    }


def _frames(inputs, recording, number=FRAMES):
    """The tactile image as it grows, up to the last event."""
    recordings, image = inputs.recordings, inputs.settings.image
    whole = recordings[recording]
    end = int(whole.time_ns[-1]) + 1 if len(whole) else 1
    ends = [end * part // number for part in range(1, number + 1)]
    grown = growing(whole, recordings.taxels, ends, image.aggregation, recordings.sensor)
    frames = []
    for until, pixels in zip(ends, normalise(grown, image.normalisation), strict=True):
        caption = f"{until / 1e9:.2f} s"
        frames.append(
            {"chart": charts.image(pixels, f"Tactile image at {caption}"), "caption": caption}
        )
    return frames


def _scores(spec, sample, classes):
    """Bars of the classes' probabilities at the end, the highest first."""
    chances = final_probabilities(spec, sample["scores"])
    return [
        {
            "name": classes[label],
            "score": float(chances[label]),
            "width": float(100 * chances[label]),
            "written": label == sample["label"],
        }
        for label in np.argsort(-chances, kind="stable")[:MOST_BARS]
    ]


MOST_BARS = 20
"""Classes whose probability at the end is drawn as a bar."""


def _energy(inputs):
    counted = [r for r in inputs.results if r["spikes"]]
    if not counted:
        return None
    got = estimate_energy(inputs.bundle.spec, counted[-1])
    chip = [layer for layer in got.layers if layer.on_chip]
    products = sum(layer.multiply_accumulates for layer in got.layers)
    return {
        "operations": sum(layer.synaptic_operations for layer in chip),
        "updates": sum(layer.neuron_updates for layer in chip),
        "products": products,
        "microjoules": {
            "Loihi, layers on the chip": 1e6 * got.chip_joules,
            "CNN on a CPU": 1e6 * got.cnn_joules("cpu"),
            "CNN on a GPU, in large batches": 1e6 * got.cnn_joules("gpu"),
        },
    }


def _activity(inputs):
    counted = [r for r in inputs.results if r["spikes"]]
    if not counted:
        return None
    result = counted[-1]
    sizes = {layer.name: layer.size for layer in inputs.bundle.spec.layers}
    sizes["input"] = int(np.prod(inputs.bundle.spec.input_shape))
    seconds = seconds_per_sample(inputs.bundle.spec)
    return [
        {
            "layer": layer,
            "neurons": sizes[layer],
            "spikes": spikes / result["n_samples"],
            "rate": spikes / result["n_samples"] / sizes[layer] / seconds,
        }
        for layer, spikes in result["spikes"].items()
    ]
