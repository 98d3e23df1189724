"""The kind of networks that were trained elsewhere and come as a NIR graph.

The run has a copy of the graph, ``snn/network.nir``, from which everything else is made.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import copy_file, sha256_of
from deploy.network.chip import LOIHI
from deploy.network.decision import choose_threshold, delay_outputs
from deploy.network.responses import Responses, read_output
from deploy.network.spec import NetworkSpec, Presentation
from deploy.network.stimulus import EventFrames, Stimulus, last_steps
from deploy.terminal import WARNING
from models import chain
from models.integers import FLOOR, in_integers, round_to_integers
from models.nir.chain import from_nir, merges_polarities
from models.nir.graph import NirNetwork, read_nir
from models.nir.simulator import SAMPLES_AT_ONCE, simulate
from pipeline.kinds import counts
from pipeline.kinds.architectures import suggest_sensor_size
from pipeline.kinds.events.kind import DECIDES, confidence_of, require_enough_samples
from pipeline.kinds.kind import Imported, NetworkKind, Reference, imported_file, is_file
from pipeline.kinds.presentation import choose_presentation, current_taus, short_gap_text
from pipeline.kinds.steps import Step
from pipeline.progress import progress
from pipeline.recordings.dataset import Dataset, event_warnings, require_images_fit
from pipeline.recordings.splits import Split
from pipeline.run.folder import DELETE_ITS_FOLDER
from pipeline.run.settings import Choice, Settings, apply_choices

# Versions of the packages that simulate a graph.
NUMPY = {"numpy": np.__version__}

# The run's copy of the graph, in the folder of its network.
GRAPH = "network.nir"


@dataclass(frozen=True)
class Stepped:
    """How a graph is run: the chip's steps in the graph's time, the equations, the reset.

    Attributes
    ----------
    seconds : float
        Seconds of the graph's time per step.
    method : str
        One of :data:`models.nir.equations.METHODS`.
    reset : str
        One of :data:`models.nir.simulator.RESETS`, with which the graph was trained.
    """

    seconds: float
    method: str
    reset: str = "value"

    @classmethod
    def of(cls, settings: Settings, network: NirNetwork) -> Stepped:
        """The values of the settings, or those of the graph's convention where they have none."""
        nir, convention = settings.nir, network.convention
        seconds = settings.input.step / 1000 if settings.on_events else LOIHI.dt
        if nir.step:
            seconds = nir.step / 1000
        elif convention.step is not None:
            seconds = convention.step
        method = convention.method if nir.method == "auto" else nir.method
        reset = convention.reset if nir.reset == "auto" else nir.reset
        return cls(seconds, method, reset)


def record_convention(network: NirNetwork, stepped: Stepped) -> dict:
    """What a graph was recognised as and how it is run, for the bundle's provenance."""
    found = network.convention
    return {
        "framework": found.framework,
        "recognised_by": found.evidence,
        "equation": found.equation if stepped.method == found.method else stepped.method,
        "method": stepped.method,
        "step_seconds": stepped.seconds,
        "reset": stepped.reset,
    }


def graph_in(folder: Path, settings: Settings) -> NirNetwork:
    """The run's copy of the graph, in the folder of its network.

    Raises
    ------
    UserError
        The file cannot be read, or is not the graph that was imported.
    """
    path = folder / GRAPH
    network = read_nir(path)
    if sha256_of(path) != settings.nir.sha256:
        raise UserError(f"{path}: has changed since it was imported; {DELETE_ITS_FOLDER}")
    return network


def simulate_samples(network, stepped, inputs, settings, advance=None):
    """Simulate the graph on samples of a run.

    Parameters
    ----------
    network : NirNetwork
    stepped : Stepped
    inputs : ndarray
        Images or frames of events, as in :func:`graph_inputs`.
    settings : Settings
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    outputs : ndarray, shape (n_samples, steps, classes)
    spikes : dict of str to ndarray of int, shape (n_samples, neurons)
        Number of spikes of each neuron, by the name of its node.
    """
    outputs, counts = [], []
    for start in range(0, len(inputs), SAMPLES_AT_ONCE):
        batch = inputs[start : start + SAMPLES_AT_ONCE]
        presented = graph_inputs(network, batch, settings.steps)
        found = simulate(network, presented, stepped.seconds, stepped.method, stepped.reset)
        outputs.append(found.outputs.reshape(*found.outputs.shape[:2], -1))
        counts.append({n: _in_places(s.sum(1, dtype=np.int64)) for n, s in found.spikes.items()})
        if advance is not None:
            advance(len(batch))
    joined = {name: np.concatenate([batch[name] for batch in counts]) for name in counts[0]}
    return np.concatenate(outputs), joined


def predictions_of(outputs, settings):
    """Predictions from the mean outputs in the readout window."""
    start = 0 if settings.on_events else settings.presentation.readout_start
    return outputs[:, start:].mean(1).argmax(1)


def graph_inputs(network: NirNetwork, inputs, steps: int) -> np.ndarray:
    """Samples of a run in the form of a graph's input.

    Parameters
    ----------
    network : NirNetwork
    inputs : ndarray
        Images (n_samples, rows, columns, channels), which are presented for ``steps`` steps, or
        frames of events (n_samples, steps, rows, columns, 2).
    steps : int

    Returns
    -------
    ndarray, shape (n_samples, steps, ...)
        Channels first, or flat.
    """
    if inputs.ndim == 4:
        inputs = np.broadcast_to(inputs[:, None], (len(inputs), steps, *inputs.shape[1:]))
    if merges_polarities(network, inputs.shape[-3:]):
        inputs = inputs.max(-1, keepdims=True)
    first = np.moveaxis(inputs, -1, 2)
    return first.reshape(*first.shape[:2], *network.input_shape)


def input_spikes(stimulus, samples, steps):
    """Spikes of the input neurons, 0 or 1, shape (n_samples, steps, values)."""
    if isinstance(stimulus, EventFrames):
        return samples.reshape(*samples.shape[:2], -1).astype(float)
    added = samples.reshape(len(samples), -1) * (stimulus.max_rate * LOIHI.dt)
    voltage = np.full(added.shape, stimulus.initial_phase)
    spikes = np.empty((len(samples), steps, added.shape[1]))
    for t in range(steps):
        voltage += added
        spikes[:, t] = voltage >= 1
        voltage -= spikes[:, t]
    return spikes


def _in_places(values):
    """Values (n, channels, rows, columns), or flat, converted to the chip's order and flattened."""
    return (np.moveaxis(values, 1, -1) if values.ndim > 2 else values).reshape(len(values), -1)


def graph_responses(folder: Path, settings: Settings, bundle: Bundle, advance=None) -> Responses:
    """Responses of the original graph to a bundle's samples, in floating point, each from rest.

    Parameters
    ----------
    folder : Path
        Folder of the graph.
    settings : Settings
    bundle : Bundle
    advance : callable, optional
        Called with the number of samples done since the last call.
    """
    network, inputs, spec = graph_in(folder, settings), bundle.checks.inputs, bundle.spec
    stepped = Stepped.of(settings, network)
    outputs, counts = simulate_samples(network, stepped, inputs, settings, advance)
    readout = spec.layers[-1]
    if readout.neurons is None:
        outputs = outputs - readout.bias  # which read_output adds
    if spec.stimulus.static:  # a graph takes the image itself, not spikes
        sizes = {"input": int(np.prod(spec.input_shape))}
        sizes |= {layer.name: layer.size for layer in spec.layers if layer.neurons}
        silent = {name: np.zeros((len(inputs), size)) for name, size in sizes.items()}
        responses = read_output(replace(spec, estimator=None), outputs, silent)
        return replace(responses, spikes={}, operations={})
    spikes = {"input": inputs.reshape(*inputs.shape[:2], -1).sum(1, dtype=np.int64)}
    names = [name for name in spec.spiking_layers if name != "input"]
    spikes |= dict(zip(names, counts.values(), strict=True))
    return read_output(spec, outputs, spikes)


# Maximum number of training samples on which the scales of a graph's weights are chosen.  More do
# not help, not even published recurrent graphs.
CALIBRATION_SAMPLES = 48

# Lowest voltage, in thresholds, above which the end of the chip's registers is mentioned.
FLOOR_IN_THRESHOLDS = -8

# Maximum number of training samples on which the confidence for early decisions is chosen.
DECIDED_ON = 300

# Maximum number of training samples on which the two resets are compared.
RESET_ON = 200

# Share of the steps with spikes from which a neuron counts as one that never rests.
RUNAWAY = 0.9

# Default presentation of samples to an imported network: each from rest. Trainings in PyTorch start
# every sample with the neurons' state at rest (``reset_hidden`` of snnTorch, a state of None in
# Norse), so that this is what the network was trained for. A board loads the network at the start
# of each stream, so that it is then loaded for each sample.
# Settings that the simulation of a graph on images reads: the image, and its spikes.
IMAGE_READS = ("presentation", "image", "deployment.input_rate", "deployment.input_phase")

FROM_REST = {"input.refractory": 0.0, "presentation.gap": 0, "presentation.stream_length": 1}


def _compute_logits(stage, inputs, samples, advance):
    """Outputs of the graph at each step."""
    settings = inputs.settings
    network = graph_in(inputs.artifact("nir").folder, settings)
    stepped = Stepped.of(settings, network)
    return simulate_samples(network, stepped, samples.inputs, settings, advance)[0]


def _respond(inputs, bundle, advance):
    folder = inputs.artifact("nir").folder
    return graph_responses(folder, inputs.settings, bundle, advance)


class NirKind(NetworkKind):
    """A NIR graph, on images or on events."""

    name = "nir"
    remedy = "a longer training of the graph; check the order of classes, step and reset"
    references = {  # noqa: RUF012 - declared as a class variable in the base
        "counts": counts.REFERENCE,
        "nir": Reference(
            "NIR",
            "the graph as written, in floating point, each sample from rest",
            "nir",
            _compute_logits,
            lambda: NUMPY,
            _respond,
        ),
    }
    deployed = "nir"
    deployed_stage = "nir"

    @classmethod
    def describes(cls, settings):
        return bool(settings.nir.file)

    @property
    def channels(self):
        return 2 if self.settings.on_events else self.settings.image.channels

    @property
    def placement(self):
        return () if self.settings.on_events else ("deployment",)

    @property
    def steps(self):
        shown = DECIDES if self.settings.on_events else IMAGE_READS
        reads = ("input", "nir.sha256", "nir.step", "nir.method", "nir.reset", *shown)
        files = ("metrics.json", GRAPH)
        return counts.STEP, Step("nir", "snn", files, reads, self._read, action="reading")

    @property
    def trained(self):
        raise UserError(
            f"the network is the NIR graph {self.settings.nir.file}, which is already trained; use "
            "'stmnist convert', or train a network in a new folder"
        )

    @property
    def imported(self):
        nir = self.settings.nir
        return Imported(nir.file, nir.sha256, "nir", GIVE_AGAIN)

    @staticmethod
    def _read(inputs, artifact):
        """Make the user's graph the run's network."""
        return take_over(artifact.folder, inputs.settings, inputs.dataset, inputs.say)

    def spec(self, inputs, provenance):
        settings, dataset, graph = inputs.settings, inputs.dataset, inputs.artifact("nir")
        network, shown = graph_in(graph.folder, settings), settings.presented(confidence_of(graph))
        rng = np.random.default_rng([settings.seed, 0x41B])
        chosen = np.sort(rng.permutation(dataset.split.train)[:CALIBRATION_SAMPLES])
        samples = dataset.inputs[chosen]
        stepped = Stepped.of(settings, network)
        provenance = {**provenance, "nir": record_convention(network, stepped)}
        spec = spec_of_nir(network, stepped, settings.stimulus, shown, samples, provenance)
        if warning := short_gap_text(shown, current_taus(spec)):
            inputs.say(f"{WARNING}{warning}")
        return spec

    def choices(self, recordings, train):
        settings = self.settings
        from_rest = [Choice(name, value) for name, value in FROM_REST.items()]
        if not settings.on_events:
            return from_rest
        settings = apply_choices(settings, from_rest, settings.nir.file)
        return from_rest + choose_presentation(settings, recordings)

    def require_fit(self, recordings):
        nir, sensor, events = self.settings.nir, recordings.sensor, self.settings.on_events
        # A file that has changed is not the run's network; the run's copy is compared when it is
        # read.
        if is_file(nir.file, nir.sha256):
            shape = sensor.rows, sensor.columns, self.channels
            require_fit(read_nir(nir.file), shape, len(sensor.classes), nir.file, events)

    def require_presentable(self, dataset):
        if not self.settings.on_events:
            require_images_fit(dataset.inputs, self.settings)

    def require_usable(self, inputs):
        artifact = inputs.artifact("nir")
        if not artifact.state().is_current:
            graph_for(artifact.folder, self.settings, inputs.dataset)

    def notes(self, recordings):
        return event_warnings(self.settings, recordings) if self.settings.on_events else []


def settings_of_nir(
    path, step: float | None = None, kind: str | None = None, before: Settings | None = None
) -> dict:
    """Changes of the settings with which a NIR graph replaces the trained network.

    Parameters
    ----------
    path : path-like
    step : float, optional
        Milliseconds of the recording in a step of the chip; of events only.
    kind : str, optional
        ``"image"`` or ``"events"``; default: from the number of channels of the graph's input, two
        for events and one for images.
    before : Settings, optional
        The run's present settings.  If they are of the same file, which may have changed, and have
        the same kind of input, ``nir.step`` is kept.

    Raises
    ------
    UserError
        The file cannot be read, is not a NIR graph, or cannot be used.
    """
    path, before = Path(path), before or Settings()
    network, sha256 = read_nir(path), sha256_of(path)
    nir = {"file": str(path.absolute()), "sha256": sha256}
    is_known = before.nir.sha256 == sha256
    was_graph = is_known or before.nir.file == nir["file"]
    if kind is None:
        shape = network.input_shape
        is_image = before.input.kind != "events" and shape[0] == before.image.channels
        is_known |= was_graph and (len(shape) == 1 or is_image)
        kind = before.input.kind if is_known else _kind_of(path, shape)
    changes = {"input": {"kind": kind}, "nir": nir}
    if not (was_graph and before.input.kind == kind):
        nir["step"] = 0.0
    if step is not None and kind == "events":  # images have no step of the recording
        changes["input"]["step"] = step
    return changes


def _kind_of(path, shape):
    """The kind of input for this shape."""
    if len(shape) == 3 and shape[0] in (1, 2):
        return "image" if shape[0] == 1 else "events"
    if len(shape) == 1:
        for channels, kind in ((2, "events"), (1, "image")):
            side = math.isqrt(shape[0] // channels)
            if shape[0] == channels * side * side:
                return kind
        raise UserError(
            f"{path}: {shape[0]} inputs are neither a square array of taxels nor two of them; "
            "give its input with --input events or --input image"
        )
    raise UserError(
        f"{path}: an input of {' x '.join(map(str, shape))}; events have two channels (ON, OFF), "
        "an image of counts one; others need --input image and, for example, --set image.slices=4"
    )


# The remedy for a graph that has changed since it was imported.
GIVE_AGAIN = "give it again with 'stmnist convert RUN --nir FILE'"


def take_over(folder: Path, settings: Settings, dataset: Dataset, say=print) -> dict:
    """Copy the user's graph into a network's folder, and measure its accuracy.

    Parameters
    ----------
    folder : Path
    settings, dataset
        With `settings.nir.file`.
    say : callable

    Returns
    -------
    dict
        Metrics of the graph, for its record.

    Raises
    ------
    UserError
        As :func:`graph_for`.
    """
    begun = time.perf_counter()
    source, network = graph_for(folder, settings, dataset)
    stepped = Stepped.of(settings, network)
    layers, cost = from_nir(network, stepped.seconds, stepped.method, _fed_shape(dataset)), None
    for line in conversion_notes(network, layers, stepped, settings):
        say(f"nir: {line}")
    if stepped.reset != "value":
        cost = reset_cost(network, stepped, settings, dataset)
        say(
            "nir: neurons reset to v_reset on the chip, not by subtraction: an accuracy of "
            "{accuracy:.3f} instead of {accuracy_as_trained:.3f} on {samples} training samples, "
            "{agreement:.1%} of their predictions are the same".format(**cost)
        )
    part = "test" if len(dataset.split.test) else "validation"
    index = getattr(dataset.split, part)
    with progress("simulate nir", len(index)) as advance:
        inputs = dataset.inputs[index]
        outputs, spikes = simulate_samples(network, stepped, inputs, settings, advance)
    _refuse_runaway(network, spikes, settings.steps)
    right = predictions_of(outputs, settings) == dataset.labels[index]
    accuracy, interval = float(right.mean()), wilson_interval(int(right.sum()), len(right))
    metrics = {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": {part: accuracy},
        f"{part}_accuracy_ci95": list(interval),
        f"n_{part}": len(index),
        "epochs": 0,
        "convention": record_convention(network, stepped),
        "reset": cost,
        "decides_by_itself": _threshold(network, stepped, layers, settings, dataset),
        "versions": NUMPY,
    }
    if source != folder / GRAPH:
        for record in ("metrics.json", "training.json", "history.csv"):  # of the previous network
            (folder / record).unlink(missing_ok=True)
        copy_file(source, folder / GRAPH)
    metrics["seconds"] = time.perf_counter() - begun
    say(
        f"nir: {part} accuracy of the graph {accuracy:.3f} on {len(index)} samples, "
        f"{metrics['seconds']:.0f} s"
    )
    likeliest = float(np.bincount(dataset.labels[index]).max() / len(index))
    if interval[0] <= likeliest:
        say(
            "nir: hardly better than chance; was the graph trained on inputs in this order (ON, "
            "OFF, rows, columns), with this --step, input.refractory and order of the classes, and "
            "with the step, equation and reset that are printed above ('nir.step', 'nir.method', "
            "'nir.reset')?"
        )
    return metrics


def graph_for(folder: Path, settings: Settings, dataset: Dataset) -> tuple:
    """The graph that was imported, from the user's file or else from the run's copy.

    Parameters
    ----------
    folder : Path
        Folder of the copy.
    settings, dataset

    Returns
    -------
    Path, NirNetwork

    Raises
    ------
    UserError
        The file has changed or cannot be read, and the run has no copy; or the graph is for another
        sensor or other classes.
    """
    source = imported_file(settings.nir.file, settings.nir.sha256, folder / GRAPH)
    network = read_nir(source)
    if not is_file(source, settings.nir.sha256):
        raise UserError(f"{source}: has changed; {GIVE_AGAIN}")
    classes = len(dataset.recordings.sensor.classes)
    require_fit(network, _fed_shape(dataset), classes, source, settings.on_events)
    return source, network


def refuse_early(settings: Settings, strict: bool = False):
    """Refuse a graph that cannot fit any recordings, before anything is written.

    Parameters
    ----------
    settings : Settings
        With ``nir.file``.
    strict : bool
        Also refuse a graph that was trained with another reset than the chip's.

    Raises
    ------
    UserError
        The message names the file, the node or nodes of a layer, and an alternative.
    """
    source = settings.nir.file
    network = read_nir(source)
    stepped, area = Stepped.of(settings, network), settings.stimulus.area
    if strict and stepped.reset != "value":
        raise UserError(
            f"{source}: trained with a reset by subtraction ('nir.reset'), and the chip resets to "
            "v_reset; train it with a reset to zero, or convert it without --strict"
        )
    try:
        first, *others = from_nir(network, stepped.seconds, stepped.method)
        height = area / LOIHI.dt
        for layer in (replace(first, weights=first.weights * height), *others):
            if layer.neuron is not None:
                round_to_integers(layer)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


def require_fit(network: NirNetwork, fed_shape, classes: int, source, on_events: bool):
    """Refuse a graph for another sensor or other classes.

    Parameters
    ----------
    network : NirNetwork
    fed_shape : tuple of int
        (rows, columns, channels) of the input in this run.
    classes : int
    source : path-like
    on_events : bool
        Both polarities of events may be one channel of the graph.

    Raises
    ------
    UserError
        The message has the required sensor and classes.
    """
    (rows, columns, channels), shape = fed_shape, network.input_shape
    fits = [(n, rows, columns) for n in ({channels, 1} if on_events else {channels})]
    if shape not in (*fits, *((math.prod(fit),) for fit in fits)):
        what = "events" if on_events else "an image"
        remedy = suggest_sensor_size(shape[1:], (rows, columns)) if len(shape) == 3 else ""
        raise UserError(
            f"{source}: has an input of {' x '.join(map(str, shape))}; {what} of {rows} x "
            f"{columns} taxels would be {channels} x {rows} x {columns} (channels, rows, columns): "
            f"{remedy}train it for that, or give another --data or --input, or other settings "
            "image.*"
        )
    if network.outputs != classes:
        raise UserError(
            f"{source}: {network.nodes[-1]} puts out {network.outputs} values, and there are "
            f"{classes} classes: train it for those, or give other recordings (--data)"
        )


def _fed_shape(dataset):
    return dataset.inputs.shape[-3:]


def conversion_notes(network: NirNetwork, layers: tuple, stepped: Stepped, settings: Settings):
    """Yield how a graph is read, what its conversion changes and what may be wrong.

    Parameters
    ----------
    network : NirNetwork
    layers : tuple of Link
        As :func:`models.nir.chain.from_nir` gives them.
    stepped : Stepped
    settings : Settings
    """
    found, record = network.convention, record_convention(network, stepped)
    yield (
        f"read as {found.framework}, by {found.evidence}: {record['equation']}; a step is "
        f"{1000 * stepped.seconds:g} ms of the graph's time, reset: {stepped.reset}"
    )
    is_as_recognised = (settings.nir.step, settings.nir.method) == (0, "auto")
    if found.doubt and is_as_recognised and settings.nir.reset == "auto":
        yield f"{WARNING}{found.doubt}"
    for node in network.nodes:
        yield from _doubtful_times(node, stepped.seconds, settings.steps)
    for layer in layers:
        windows = [n for n in network.nodes if n.name in layer.sources and "Conv" in n.kind]
        is_matrix = layer.neuron is not None and layer.kind == "dense"
        if is_matrix and windows and len(windows[0].input_shape) > 1:
            yield (
                f"{layer}: takes the memory of a dense layer, since its windows are not the chip's "
                "(square kernels, equal strides and paddings) or its neurons' parameters differ "
                "within a channel"
            )
    height = settings.stimulus.area / LOIHI.dt
    for index, layer in enumerate(layers):
        if layer.neuron is None:
            continue
        scaled = replace(layer, weights=layer.weights * (1.0 if index else height))
        floor = FLOOR / round_to_integers(scaled).threshold
        if floor > FLOOR_IN_THRESHOLDS:
            yield f"{layer}: the chip's voltages end at {-floor:.1f} thresholds below the reset"
    for node in network.nodes:
        if node.kind == "IF":
            yield f"{node}: the chip's neurons leak at least 1/4096 of the voltage per step"
        if node.kind == "CubaLI":
            yield f"{node}: only its longer time constant is kept"


def _doubtful_times(node, step, steps):
    """Yield a warning for time constants that no network is trained with."""
    for name in ("tau", "tau_syn", "tau_mem"):
        if name not in node.parameters:
            continue
        shortest = float(node[name].min())
        problem = ""
        if shortest > step * steps:
            problem = f"longer than a whole sample, {steps} steps of {1000 * step:g} ms"
        elif shortest < step * (1 - 1e-6):
            problem = f"shorter than a step of {1000 * step:g} ms"
        if problem:
            yield (
                f"{WARNING}{node}: a {name} of {1000 * shortest:g} ms is {problem}; if it is "
                "counted in other units, give --set nir.step (the graph's time per step, in ms)"
            )


def reset_cost(network: NirNetwork, stepped: Stepped, settings, dataset) -> dict:
    """Effect of the chip's reset on the predictions of a graph that was trained with another.

    Returns
    -------
    dict
        Training ``samples``; ``accuracy`` with the chip's reset and ``accuracy_as_trained``;
        ``agreement``, the share of samples with the same prediction.
    """
    rng = np.random.default_rng([settings.seed, 0x5EB])
    some = np.sort(rng.permutation(dataset.split.train)[:RESET_ON])
    inputs, labels = dataset.inputs[some], dataset.labels[some]
    chip, trained = (
        predictions_of(simulate_samples(network, run, inputs, settings)[0], settings)
        for run in (replace(stepped, reset="value"), stepped)
    )
    return {
        "samples": len(some),
        "accuracy": float((chip == labels).mean()),
        "accuracy_as_trained": float((trained == labels).mean()),
        "agreement": float((chip == trained).mean()),
    }


def _refuse_runaway(network, spikes, steps):
    """Refuse a recurrent layer most of whose neurons spike at almost every step.

    Parameters
    ----------
    network : NirNetwork
    spikes : dict of str to ndarray, shape (n_samples, neurons)
        Number of spikes by the node's name.
    steps : int
    """
    for node in network.nodes:
        if node.loop is None:
            continue
        share = (spikes[node.name] > RUNAWAY * steps).mean()
        if share > 0.5:
            raise UserError(
                f"{node}: its connection to itself through {node.loop.name!r} runs away: "
                f"{share:.0%} of its neurons spike at almost every step of these recordings; "
                "correct the step (--step), or train it on inputs of this density"
            )


def _threshold(network, stepped, layers, settings, dataset):
    """The confidence for early decisions of networks on events."""
    if not settings.on_events or network.outputs < 2:
        return None
    held_out = decided_on(dataset.split, settings.seed)
    inputs = dataset.inputs[held_out]
    outputs = simulate_samples(network, stepped, inputs, settings)[0]
    sums = delay_outputs(np.cumsum(outputs, 1), len(layers))
    loss = settings.presentation.early_loss
    threshold = choose_threshold(sums, dataset.labels[held_out], last_steps(inputs), loss)
    return {**require_enough_samples(threshold, len(held_out))._asdict(), "samples": len(held_out)}


def decided_on(split: Split, seed: int) -> np.ndarray:
    """Indices of the held-out samples on which the confidence is chosen, of every class.

    Held-out samples are in the order of the recordings, which is usually that of the classes, so
    they are drawn at random.
    """
    held_out = split.held_out(seed)[1]
    return np.random.default_rng([seed, 0xDEC]).permutation(held_out)[:DECIDED_ON]


def spec_of_nir(
    network: NirNetwork,
    stepped: Stepped,
    stimulus: Stimulus,
    presentation: Presentation,
    samples,
    provenance: dict,
) -> NetworkSpec:
    """Describe the deployed network of a NIR graph.

    Parameters
    ----------
    network : NirNetwork
    stepped : Stepped
    stimulus : Stimulus
    presentation : Presentation
    samples : ndarray
        Training samples in the format of the stimulus, on which the scales of weights are chosen.
    provenance : dict
        Stored in the bundle.
    """
    read = range(presentation.readout_start, presentation.steps)
    links = from_nir(network, stepped.seconds, stepped.method, samples.shape[-3:], read)
    spikes = input_spikes(stimulus, samples, presentation.steps)
    links = in_integers(links, spikes, stimulus.area / LOIHI.dt)
    return chain.build_network_spec(links, stimulus, presentation, provenance)
