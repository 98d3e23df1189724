"""The report of a run as HTML; :mod:`pipeline.results.report.gather` reads what it shows."""

import datetime
from collections import defaultdict
from dataclasses import dataclass, field
from importlib import resources

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from deploy import __version__
from deploy.check.bundle import Bundle
from deploy.check.comparison import compare_results
from deploy.check.energy import MAC_JOULES, estimate_energy, format_joules
from deploy.check.intervals import compute_wilson_interval
from deploy.check.results import CheckResult
from deploy.network.provenance import read_classes, read_positions
from deploy.network.responses import compute_seconds_per_sample
from deploy.tables import SIGNIFICANCE, format_count, format_p, list_names
from deploy.targets.registry import TARGETS
from pipeline import look
from pipeline.kinds.registry import list_compared_stages, list_references
from pipeline.results.ladder import count_confusions, make_rows, select_deployed_result
from pipeline.results.report import charts, prose
from pipeline.settings import PATHS, Settings, format_automatic
from pipeline.workflow import list_network_settings

# Intervals of time of a small picture of a strip.
BINS = 40

# Largest number of classes for which a confusion matrix is drawn.
MAX_MATRIX_CLASSES = 40


@dataclass(frozen=True)
class ReportData:
    """The data of a report.

    Attributes
    ----------
    name : str
        The run's folder.
    settings : Settings
    bundle : Bundle
    results : list of CheckResult
        Results of the bundle, in the order of the ladder.
    metrics : dict of str to dict
        ``accuracy`` on ``n_test`` test samples of the trained networks, by title.
    histories : dict of str to list of dict
        Rows with one epoch each, for each trained network, by title.
    plan : dict
        The plan of the placement, as plain values.
    replays : dict of int to Replay
        Spikes and probabilities of some samples, by their index in the check.
    outdated : dict of str to str
        Outdated artifacts, with the reasons.
    others : list of CheckResult
        Results of the bundle on other recordings.
    """

    name: str
    settings: Settings
    bundle: Bundle
    results: list
    metrics: dict
    histories: dict
    plan: dict
    replays: dict
    outdated: dict = field(default_factory=dict)
    others: list = field(default_factory=list)

    @property
    def deployed_result(self) -> CheckResult:
        """The check result of the deployed network, which the report is about."""
        return select_deployed_result(self.results)

    @property
    def classes(self) -> list:
        """Names of the classes."""
        return list(read_classes(self.bundle.spec))


def render_report(inputs: ReportData, now: datetime.datetime | None = None) -> str:
    """Write the report.

    Parameters
    ----------
    inputs : ReportData
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
    environment.filters["p"] = format_p
    environment.filters["percent"] = charts.format_percent
    environment.filters["interval"] = prose.format_interval
    package = resources.files("pipeline.results.report")
    spec = inputs.bundle.spec
    result = inputs.deployed_result
    provenance = spec.provenance
    estimate = estimate_energy(spec, result) if result.synaptic_operations else None
    layers = make_layer_table(inputs.bundle, inputs.plan, result, estimate)
    groups = _group_samples(inputs)
    return environment.get_template("report.html.j2").render(
        vars(inputs),
        style=look.STYLE + package.joinpath("report.css").read_text(encoding="utf-8"),
        made=(now or datetime.datetime.now(datetime.UTC)).strftime("%Y-%m-%d %H:%M UTC"),
        package=__version__,
        classes=inputs.classes,
        source=provenance.source,
        source_sha256=provenance.source_sha256,
        simulated=provenance.simulated,
        warnings=_list_warnings(provenance, result),
        settings=_list_settings(inputs),
        seed=inputs.settings.seed,
        verdict=make_verdict(inputs.results, inputs.bundle),
        ladder=_make_ladder(inputs.results),
        time=_draw_over_time(inputs),
        per_class=make_class_table(inputs),
        matrix=_make_confusion_matrix(inputs),
        groups=groups,
        frequent_mistake=_find_frequent_mistake(groups, inputs),
        over_time=has_time(spec),
        stories=_make_stories(inputs, groups),
        prose=prose,
        format_count=format_count,
        curves=_draw_learning_curves(inputs.histories),
        layers=layers,
        neurons_on_chip=sum(row["neurons"] or 0 for row in layers if row["name"] != "input"),
        energy=None if estimate is None else _format_energy(estimate),
    )


def _list_warnings(provenance, result):
    """What is wrong with the recordings, and the classes that the check has no samples of."""
    lines = list(provenance.warnings)
    if absent := result.classes_without_samples:
        names = list_names(absent)
        lines.append(f"classes without samples: {names}; no accuracy on this page covers them")
    return lines


def _list_settings(inputs):
    """The settings that the bundle was made with, and the files that it was made from."""
    files = {name: path for name in PATHS if (path := inputs.settings.get_value(name))}
    values = files | list_network_settings(inputs.bundle.spec)
    return {name: format_automatic(name, value) or value for name, value in values.items()}


def find_title(stage: str) -> str:
    """The title of a network or target."""
    row = list_references().get(stage) or TARGETS[stage]
    return row.title


def make_verdict(results: list, bundle: Bundle) -> dict:
    """Compare the deployed network with its references, and count its operations.

    Parameters
    ----------
    results : list of CheckResult
        Results of the bundle, in the order of the ladder.
    bundle : Bundle

    Returns
    -------
    dict
        ``title`` of the deployed network; ``against``, a list of comparisons with ``title``,
        ``accuracy``, ``change`` (negative for a loss), ``p`` and ``significant``; ``operations``
        per sample and their ``ratio`` to the multiply-accumulates of the same network without
        spikes, or None without counts.
    """
    deployed = select_deployed_result(results)
    by_stage = {result.target: result for result in results[:-1]}
    references = [name for name in list_compared_stages() if name in by_stage][:1]
    references += [name for name in ("counts",) if name in by_stage]
    against = []
    for name in references:
        compared = compare_results(by_stage[name], deployed)
        against.append(
            {
                "title": find_title(name),
                "accuracy": by_stage[name].accuracy,
                "change": compared.accuracy_change,
                "p": compared.p_value,
                "significant": compared.p_value < SIGNIFICANCE,
            }
        )
    operations = sum(deployed.synaptic_operations.values()) / deployed.n_samples
    products = sum(bundle.spec.multiply_accumulates.values())
    return {
        "title": find_title(deployed.target),
        "against": against,
        "operations": operations or None,
        "ratio": operations / products if operations else None,
    }


def make_class_table(inputs: ReportData) -> list:
    """Recall and precision of each class in the deployed network's predictions.

    Recall is the share of a class's samples that are predicted as it, and precision the share of
    the predictions of a class that are right; None where there is nothing to divide by.
    """
    matrix = _count_confusions(inputs)
    presented = matrix.sum(1)
    predicted = matrix.sum(0)
    right = np.diag(matrix)
    return [
        {
            "name": name,
            "n": int(presented[i]),
            "recall": float(right[i] / presented[i]) if presented[i] else None,
            "precision": float(right[i] / predicted[i]) if predicted[i] else None,
        }
        for i, name in enumerate(inputs.classes)
    ]


def make_layer_table(bundle: Bundle, plan: dict, result: CheckResult, estimate=None) -> list:
    """Each layer: operation, output shape, weights, neurons, place, activity per sample.

    ``rate`` is in spikes per second and neuron, ``microjoules`` an estimate for the chip;
    values that do not exist are None.

    Parameters
    ----------
    bundle : Bundle
    plan : dict
    result : CheckResult
    estimate : deploy.check.energy.EnergyEstimate, optional
    """
    spec = bundle.spec
    n = result.n_samples
    cores = [core["layer"] for core in plan["cores"]]
    energy = {layer.layer: layer.chip_joules for layer in estimate.layers} if estimate else {}
    seconds = compute_seconds_per_sample(spec)

    def make_row(name, operation, shape, weights, neurons):
        spikes = result.spikes.get(name)
        operations = result.synaptic_operations.get(name)
        used = cores.count(name)
        return {
            "name": name,
            "operation": operation,
            "shape": "x".join(map(str, np.atleast_1d(shape))),
            "weights": weights,
            "neurons": neurons,
            "where": format_count(used, "core").replace(" ", "\u00a0") if used else "host",
            "spikes": None if spikes is None else spikes / n,
            "rate": None if spikes is None else spikes / n / neurons / seconds,
            "operations": None if operations is None else operations / n,
            "microjoules": 1e6 * energy[name] if name in energy else None,
        }

    rows = [make_row("input", "input", spec.input_shape, None, int(np.prod(spec.input_shape)))]
    for layer in spec.layers:
        neurons = layer.size if layer.neurons is not None else None
        rows.append(
            make_row(
                layer.name,
                layer.operation.describe(layer),
                layer.shape,
                int(layer.weights.size),
                neurons,
            )
        )
    return rows


def _make_ladder(results):
    rows = make_rows(results)
    lowest = np.floor(min(row.accuracy_ci95[0] for row in rows) * 20) / 20
    drawn = [
        {
            **row.to_dict(),
            "title": find_title(row.stage),
            "chart": charts.draw_interval(row.accuracy, *row.accuracy_ci95, lowest),
        }
        for row in rows
    ]
    return {"rows": drawn, "least": float(lowest), "n": results[0].n_samples}


def _draw_over_time(inputs):
    """Accuracy over the recording (events), or over the steps of the presentation (images)."""
    result = inputs.deployed_result
    n_samples = result.n_samples
    times, accuracies, label = _measure_accuracy_by_time(result, inputs.bundle.spec)
    if len(accuracies) < 2:
        return None
    intervals = (
        compute_wilson_interval(round(n_samples * share), n_samples) for share in accuracies
    )
    series = charts.Series(
        find_title(result.target),
        tuple(times),
        tuple(100 * share for share in accuracies),
        tuple((100 * low, 100 * high) for low, high in intervals),
    )
    early = result.early_decisions
    points = [(times[-1], 100 * result.accuracy, "end")]
    if early:
        points.append((100 * early.share_of_writing_mean, 100 * early.accuracy, "early"))
    counts = [each.accuracy for each in inputs.results if each.target == "counts"]
    levels = [(100 * accuracy, "logistic regression") for accuracy in counts]
    middle = times[-1] / 2
    return {
        "chart": charts.draw_line_chart(
            charts.LineChart(
                [series],
                x_label=label,
                y_label="accuracy, %",
                description="Accuracy over time",
                least=0,
                points=points,
                levels=levels,
            )
        ),
        "half": accuracies[int(np.searchsorted(times, middle))] if times[0] <= middle else None,
        "name": series.name,
        "early": early,
        "on_events": result.while_written is not None,
    }


def _measure_accuracy_by_time(result, spec):
    """Times, the accuracy at each, and what the times are."""
    written = result.while_written
    if written:
        shares = [100 * share for share in written.shares]
        return shares, written.accuracy, "share of the recording, %"
    start = spec.presentation.readout_start
    accuracies = result.anytime_accuracy[start:]
    step_ms = 1000 * spec.stimulus.step_seconds
    times = [step_ms * step for step in range(start + 1, start + 1 + len(accuracies))]
    return times, accuracies, "milliseconds of the presentation"


def _list_predictions(inputs) -> tuple:
    """The label and the prediction of each sample."""
    samples = inputs.deployed_result.samples
    labels = [sample.label for sample in samples]
    return labels, [sample.prediction for sample in samples]


def _count_confusions(inputs):
    return count_confusions(*_list_predictions(inputs), len(inputs.classes))


def _make_confusion_matrix(inputs):
    """Rows of (name, cells): count, shade in percent, and whether it is on the diagonal."""
    matrix = _count_confusions(inputs)
    if len(matrix) > MAX_MATRIX_CLASSES:
        return None
    shares = matrix / np.maximum(matrix.sum(1, keepdims=True), 1)
    rows = []
    for label, name in enumerate(inputs.classes):
        cells = []
        for prediction, count in enumerate(matrix[label].tolist()):
            # Errors are few: the square root makes one in a hundred visible.
            share = shares[label, prediction]
            is_right = label == prediction
            shade = 55 * share if is_right else 75 * share**0.5
            cells.append({"count": count, "shade": round(float(shade)), "right": is_right})
        rows.append((name, cells))
    return rows


def has_time(spec) -> bool:
    """True if small pictures show taxels over time: of events of taxels in an unknown order."""
    return not spec.stimulus.is_static and spec.input_shape[0] == 1 and read_positions(spec) is None


def _group_samples(inputs):
    """Thumbnails of all samples by class and prediction, frequent mistakes first."""
    groups = defaultdict(list)
    positions = read_positions(inputs.bundle.spec)
    images = inputs.bundle.checks.inputs
    static = inputs.bundle.spec.stimulus.is_static
    if has_time(inputs.bundle.spec):
        starts = np.linspace(0, images.shape[1], BINS, endpoint=False).astype(int)
        images = np.add.reduceat(images.sum((2, -1)), starts, axis=1).swapaxes(1, 2)
    else:
        images = images.sum(-1 if static else (1, -1))
    for index, pair in enumerate(zip(*_list_predictions(inputs), strict=True)):
        groups[pair].append(index)

    def rank(pair):
        label, prediction = pair
        if label == prediction:
            return (1, 0, pair)
        return (0, -len(groups[pair]), pair)

    def describe(index):
        sample = inputs.bundle.checks.ids[index]
        return {
            "index": index,
            "id": sample,
            "has_story": index in inputs.replays,
            "picture": charts.draw_thumbnail(images[index], sample, positions),
        }

    rows = []
    for label, prediction in sorted(groups, key=rank):
        rows.append(
            {
                "key": f"{label}-{prediction}",
                "right": label == prediction,
                "shown": inputs.classes[label],
                "prediction": inputs.classes[prediction],
                "samples": [describe(index) for index in groups[label, prediction]],
            }
        )
    return rows


def _find_frequent_mistake(groups, inputs):
    """The most frequent mistake, if it occurs more than twice; otherwise None."""
    first = groups[0]  # wrong predictions come first, the most frequent before the others
    if first["right"] or len(first["samples"]) <= 2:
        return None
    is_number = first["shown"].isdigit() and len(inputs.classes) > 10
    word = "class " if is_number else ""
    return {
        "n": len(first["samples"]),
        "of": int(_count_confusions(inputs).sum(1)[inputs.classes.index(first["shown"])]),
        "shown": word + first["shown"],
        "prediction": word + first["prediction"],
    }


def _make_stories(inputs, groups):
    """Samples one by one: events, spikes of the layers and probabilities on one time axis."""
    pictures = {}
    for group in groups:
        pictures.update({sample["index"]: sample["picture"] for sample in group["samples"]})
    stories = []
    for index, replay in inputs.replays.items():
        sample = inputs.deployed_result.samples[index]
        story = _make_story(inputs.bundle.spec, inputs.classes, sample, replay)
        stories.append({"index": index, "picture": pictures[index], **story})
    return stories


def _make_story(spec, classes, sample, replay):
    """What the template needs of a replayed sample, but for its picture."""
    step_ms = 1000 * spec.stimulus.step_seconds
    at_ms = (spec.presentation.readout_start + 1 + np.arange(len(replay.probabilities))) * step_ms
    decided_ms = at_ms[replay.decided]
    probability = replay.probabilities[replay.decided, replay.prediction]
    is_early = replay.decided < len(at_ms) - 1
    label = sample.label
    prediction = sample.prediction
    drawn = choose_drawn_steps(len(at_ms))
    threshold = spec.presentation.threshold_or_1
    quantity = "probability of the classes" if spec.estimator else "softmax of the outputs"
    curves = tuple(
        charts.Series(
            classes[number], tuple(at_ms[drawn]), tuple(replay.probabilities[drawn, number])
        )
        for number in replay.choose_classes(label)
    )
    lines = charts.Lines(
        f"{quantity}, %",
        curves,
        levels=(threshold,) if threshold < 1 else (),
        points=((decided_ms, probability),) if is_early else (),
    )
    layers = [_draw_spikes(layer, step_ms) for layer in replay.layers]
    return {
        "id": sample.id,
        "right": label == prediction,
        "shown": classes[label],
        "prediction": classes[prediction],
        "probability": float(replay.probabilities[-1, prediction]),
        "early": (decided_ms, classes[replay.prediction], probability) if is_early else None,
        "chart": charts.draw_timeline(
            [*layers, lines],
            spec.presentation.steps * step_ms,
            "milliseconds since the start of the presentation",
            f"Spikes and probabilities over time, sample {sample.id}",
            mark=decided_ms if is_early else None,
        ),
        "legend": charts.draw_legend(
            f"{curve.name} (true)" if curve.name == classes[label] else curve.name
            for curve in curves
        ),
    }


def _draw_spikes(layer, step_ms) -> charts.Raster:
    """The panel of a replayed layer."""
    spikes = sum(len(steps) for _, steps, _ in layer.groups)
    return charts.Raster(
        f"{layer.name}: {layer.size} {layer.unit}, {spikes:,} spikes",
        tuple((name, (steps + 0.5) * step_ms, rows) for name, steps, rows in layer.groups),
        layer.size,
    )


def choose_drawn_steps(n: int) -> np.ndarray:
    """The steps of a curve that are drawn: at most about 200, and always the last one."""
    every = max(1, n // 100)
    return np.append(np.arange(0, n - 1, every), n - 1)


def _draw_learning_curves(histories):
    """Accuracy of each network on training and held-out samples."""
    prefixes = {"": "training", "val_": "held out", "test_": "some test samples, not trained on"}
    curves = []
    for name, rows in histories.items():
        epochs = tuple(row["epoch"] for row in rows)
        series = []
        for prefix, title in prefixes.items():
            column = f"{prefix}accuracy"
            if column in rows[0]:
                percents = tuple(100 * row[column] for row in rows)
                series.append(charts.Series(title, epochs, percents))
        if series:
            chart = charts.draw_line_chart(
                charts.LineChart(series, "epoch", "accuracy, %", f"Learning curve: {name}")
            )
            legend = charts.draw_legend([curve.name for curve in series])
            curves.append({"title": name, "chart": chart, "legend": legend})
    return curves


def _format_energy(estimate):
    return {
        "loihi": format_joules(estimate.chip_joules),
        "share_of_updates": estimate.share_of_updates,
        **{device: format_joules(estimate.estimate_cnn_joules(device)) for device in MAC_JOULES},
    }
