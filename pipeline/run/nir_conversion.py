"""Use a NIR graph, such as one exported from PyTorch, as the network of a run.

The run has a copy of the graph, ``snn/network.nir``, from which everything else is made.
"""

from __future__ import annotations

import math
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import replacing, sha256_of
from deploy.network.chip import LOIHI
from deploy.network.decision import choose_threshold, delayed
from deploy.network.nir import DEPLOYED, deployed_network
from deploy.network.responses import Responses, read_output
from deploy.network.spec import Layer, NetworkSpec, Presentation
from deploy.network.stimulus import EventFrames, ImageSpikes, Stimulus, last_steps
from models.architecture import Convolution
from models.integers import on_loihi
from models.nir_graph import SNNTORCH_STEP, NirError, NirNetwork, read_nir
from models.nir_layers import NirLayer, chosen, fired, layers_of, rounded
from models.nir_simulator import AT_ONCE, simulate
from pipeline import paper
from pipeline.inputs.dataset import Dataset
from pipeline.progress import progress
from pipeline.run.layers import chip_layer, host_readout
from pipeline.settings import SIMULATED, Settings

CALIBRATED_ON = 48
"""Training samples on which the scales of the weights are chosen."""

DECIDED_ON = 300
"""Maximum number of training samples on which the confidence for early decisions is chosen."""

RESETTING = ("IF", "LIF", "CubaLIF")
"""Nodes whose voltage a spike resets."""

FROM_REST = {"gap": 0, "stream_length": 1}
"""Default presentation of samples to an imported network: each from rest.  Trainings in PyTorch
start every sample with the neurons' state at rest (``reset_hidden`` of snnTorch, a state of None in
Norse), so that this is what the network was trained for.  A board loads the network at the start of
each stream, so that it is then loaded for each sample."""

RESET_ON = 200
"""Maximum number of training samples on which the two resets are compared."""

NUMPY = {"numpy": np.__version__}
"""Versions of the packages that simulate a graph."""

AGAIN = "give it again with 'stmnist convert RUN --nir FILE'"


@dataclass(frozen=True)
class Stepped:
    """Division of a graph's time into the chip's steps.

    Attributes
    ----------
    seconds : float
        Seconds of the graph's time per step.
    method : str
        One of :data:`models.nir_simulator.METHODS`.
    """

    seconds: float
    method: str

    @classmethod
    def of(cls, settings: Settings, network: NirNetwork) -> Stepped:
        """The values of the settings, or those of the graph where the settings have none."""
        nir, by_snntorch = settings.nir, network.written_by_snntorch
        seconds = settings.input.step / 1000 if settings.on_events else LOIHI.dt
        if nir.step:
            seconds = nir.step / 1000
        elif by_snntorch:
            seconds = SNNTORCH_STEP
        elif DEPLOYED in network.metadata:
            seconds = LOIHI.dt
        method = nir.method
        if method == "auto":
            method = "euler" if by_snntorch else "exact"
        return cls(seconds, method)

    def __str__(self):
        how = "Euler steps" if self.method == "euler" else "exact steps"
        return f"{how} of {1000 * self.seconds:g} ms of the graph's time"


def settings_of_nir(path, step: float | None = None, kind: str | None = None) -> dict:
    """Changes of the settings with which a NIR graph replaces the trained network.

    Parameters
    ----------
    path : path-like
    step : float, optional
        Milliseconds that a step of the chip represents.
    kind : str, optional
        ``"image"`` or ``"events"``; default: from the number of channels of the graph's input, two
        for events and one for images.

    Raises
    ------
    UserError
        The file cannot be read, is not a NIR graph, or cannot be used.
    """
    path = Path(path)
    network = read_nir(path)
    nir = {"file": str(path.absolute()), "sha256": sha256_of(path), "step": 0.0, "retrain": False}
    if (exported := exported_here(network, path)) is not None:
        return {**_settings_of_export(exported), "nir": nir}
    kind = kind or _kind_of(path, network.input_shape)
    fed = {"kind": kind, "refractory": 0.0}
    if step is not None:
        if kind == "events":
            fed["step"] = step
        else:
            nir["step"] = step
    return {"input": fed, "nir": nir, "presentation": FROM_REST}


def exported_here(network: NirNetwork, source="") -> NetworkSpec | None:
    """The deployed network from which a graph was exported, or None for other graphs.

    Raises
    ------
    UserError
        The graph was exported by this project, but its parts do not fit each other.
    """
    try:
        nodes = {node.name: node.parameters for node in network.nodes}
        return deployed_network(nodes, network.metadata)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


def _settings_of_export(spec):
    """Settings with which an exported network gets the same input as before the export."""
    stimulus, presentation = spec.stimulus, spec.presentation
    names = ("steps", "gap", "stream_length")
    changes = {"presentation": {name: getattr(presentation, name) for name in names}}
    if isinstance(stimulus, EventFrames):
        step = round(1000 * stimulus.seconds, 9)
        changes["input"] = {"kind": "events", "step": step, "refractory": stimulus.rest * step}
        return changes
    changes["input"] = {"kind": "image"}
    changes["presentation"]["readout_start"] = presentation.readout_start
    changes["deployment"] = {"first_layer": "host" if stimulus.area is None else "chip"}
    if isinstance(stimulus, ImageSpikes):
        changes["deployment"]["input_rate"] = stimulus.max_rate
        changes["deployment"]["input_phase"] = stimulus.initial_phase
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
        f"{path}: an input of {' x '.join(map(str, shape))}; the skin has two channels of events "
        "(ON, OFF) or one of an image, (channels, rows, columns): train the network for those"
    )


# --- the stage ------------------------------------------------------------------------------------


GRAPH = "network.nir"
"""The run's copy of the graph, in the folder of its network."""


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
        The file has changed, or the graph is for another sensor or other classes.
    """
    begun, source = time.perf_counter(), Path(settings.nir.file)
    if not source.exists() and folder / GRAPH.exists():
        source = folder / GRAPH
    network = read_nir(source)
    if sha256_of(source) != settings.nir.sha256:
        raise UserError(f"{source}: has changed; {AGAIN}")
    require_fit(network, _fed_shape(dataset), len(dataset.recordings.sensor.classes), source)
    stepped = Stepped.of(settings, network)
    exported, cost = exported_here(network, source), None
    if exported is None:
        layers = layers_of(network, stepped.seconds, stepped.method, _fed_shape(dataset))
        for line in notes(network, layers, stepped):
            say(f"nir: {line}")
        if any(node.kind in RESETTING for node in network.nodes):
            cost = reset_cost(network, stepped, settings, dataset)
            say(f"nir: {_reset_text(cost)}")
    else:
        layers = exported.layers
        say("nir: exported from a bundle; what NIR leaves out is taken from the file's metadata")
    part = "test" if len(dataset.split.test) else "validation"
    index = getattr(dataset.split, part)
    with progress("simulate nir", len(index)) as advance:
        answers = _outputs(network, stepped, dataset.inputs[index], settings, advance)[0]
    right = _predictions(answers, settings) == dataset.labels[index]
    accuracy, interval = float(right.mean()), wilson_interval(int(right.sum()), len(right))
    metrics = {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": {part: accuracy},
        f"{part}_accuracy_ci95": list(interval),
        f"n_{part}": len(index),
        "epochs": 0,
        "step_seconds": stepped.seconds,
        "method": stepped.method,
        "reset_by_subtraction": cost,
        "decides_by_itself": _threshold(network, stepped, layers, settings, dataset),
        "versions": NUMPY,
    }
    if source != folder / GRAPH:
        for record in ("metrics.json", "training.json"):  # of the previous network
            (folder / record).unlink(missing_ok=True)
        with replacing(folder / GRAPH) as file, open(source, "rb") as graph:
            shutil.copyfileobj(graph, file)
    metrics["seconds"] = time.perf_counter() - begun
    say(
        f"nir: {part} accuracy of the graph {accuracy:.3f} on {len(index)} samples, "
        f"{metrics['seconds']:.0f} s"
    )
    likeliest = float(np.bincount(dataset.labels[index]).max() / len(index))
    if interval[0] <= likeliest:
        say(
            "nir: hardly better than chance; was the graph trained on inputs in this order (ON and "
            "OFF, rows from the top, columns), in steps of this duration (--step) and with the "
            "classes in this order?"
        )
    return metrics


def refuse_early(settings: Settings):
    """Refuse a graph that cannot fit any recordings, before anything is written.

    Parameters
    ----------
    settings : Settings
        With ``nir.file``.

    Raises
    ------
    UserError
        The message names the file, the node or nodes of a layer, and an alternative.
    """
    source = settings.nir.file
    network = read_nir(source)
    if exported_here(network, source) is not None:
        return
    if settings.data.source == SIMULATED:
        skin = settings.skin.rows or paper.ROWS, settings.skin.columns or paper.COLUMNS
        require_fit(network, (*skin, 2 if settings.on_events else 1), paper.CLASSES, source)
    stepped, area = Stepped.of(settings, network), settings.stimulus.area
    try:
        first, *others = layers_of(network, stepped.seconds, stepped.method)
        height = 1.0 if area is None else area / LOIHI.dt
        for layer in (replace(first, weights=first.weights * height), *others):
            if layer.spiking:
                rounded(layer)
    except NirError as error:
        raise UserError(f"{source}: {error}") from error


def require_fit(network: NirNetwork, fed_shape, classes: int, source):
    """Refuse a graph for another sensor or other classes.

    Parameters
    ----------
    network : NirNetwork
    fed_shape : tuple of int
        (rows, columns, channels) of the input in this run.
    classes : int
    source : path-like

    Raises
    ------
    UserError
        The message has the required sensor and classes.
    """
    (rows, columns, channels), shape = fed_shape, network.input_shape
    if shape not in ((channels, rows, columns), (channels * rows * columns,)):
        what = "events" if channels == 2 else "an image"
        raise UserError(
            f"{source}: has an input of {' x '.join(map(str, shape))}; {what} of {rows} x "
            f"{columns} taxels would be {channels} x {rows} x {columns} (channels, rows, columns): "
            "train it for that, or give recordings of its sensor (--data), or the other --input"
        )
    if network.outputs != classes:
        raise UserError(
            f"{source}: {network.nodes[-1]} puts out {network.outputs} values, and there are "
            f"{classes} classes: train it for those, or give other recordings (--data)"
        )


def _fed_shape(dataset):
    return dataset.inputs.shape[-3:]


def notes(network: NirNetwork, layers: tuple, stepped: Stepped):
    """Yield what the conversion of a graph changes or may misread, one line each.

    Parameters
    ----------
    network : NirNetwork
    layers : tuple of NirLayer
        As :func:`models.nir_layers.layers_of` gives them.
    stepped : Stepped
    """
    by_snntorch = network.written_by_snntorch
    yield str(stepped) + (", as snnTorch's exporter writes it" if by_snntorch else "")
    for layer in layers:
        windows = [n for n in network.nodes if n.name in layer.nodes and "Conv" in n.kind]
        if layer.spiking and layer.kind == "dense" and windows and len(windows[0].input_shape) > 1:
            yield (
                f"{layer}: takes the memory of a dense layer, since its windows are not the chip's "
                "(square kernels, equal strides, no padding or 'same') or its neurons' parameters "
                "differ within a channel"
            )
    for node in network.nodes:
        if node.kind == "IF":
            yield f"{node}: the chip's neurons leak at least 1/4096 of the voltage per step"
            if stepped.seconds < 1 and (node["r"] == 1).all():
                yield (
                    f"{node}: its input is multiplied by the step, as NIR says; Norse and others "
                    "add the whole of it at each step: then give --set nir.step=1000"
                )
        if node.kind == "CubaLI":
            yield f"{node}: only its longer time constant is kept"


def reset_cost(network: NirNetwork, stepped: Stepped, settings, dataset) -> dict:
    """Effect of a reset by subtraction on a graph's answers to training samples.

    A graph does not record how its network was trained to reset; the chip resets to ``v_reset``.

    Returns
    -------
    dict
        ``samples``; ``accuracy`` with the chip's reset and ``accuracy_subtracting``; ``agreement``
        of their predictions; ``spikes``, the ratio of spikes by subtraction to those with the
        chip's reset.
    """
    rng = np.random.default_rng([settings.seed, 0x5EB])
    some = np.sort(rng.permutation(dataset.split.train)[:RESET_ON])
    late = "subtract-late" if network.written_by_snntorch else "subtract"
    predictions, spikes = {}, {}
    for reset in ("value", late):
        outputs, counts = _outputs(network, stepped, dataset.inputs[some], settings, reset=reset)
        predictions[reset] = _predictions(outputs, settings)
        spikes[reset] = sum(int(count.sum()) for count in counts.values())
    labels = dataset.labels[some]
    return {
        "samples": len(some),
        "accuracy": float((predictions["value"] == labels).mean()),
        "accuracy_subtracting": float((predictions[late] == labels).mean()),
        "agreement": float((predictions["value"] == predictions[late]).mean()),
        "spikes": spikes[late] / max(spikes["value"], 1),
    }


def _predictions(outputs, settings):
    """Predictions from the mean outputs in the readout window."""
    start = 0 if settings.on_events else settings.presentation.readout_start
    return outputs[:, start:].mean(1).argmax(1)


def _reset_text(cost):
    here, there = cost["accuracy"], cost["accuracy_subtracting"]
    text = (
        f"neurons reset to v_reset; with a reset by subtraction the accuracy on {cost['samples']} "
        f"training samples is {there:.3f} instead of {here:.3f}, {cost['agreement']:.1%} of the "
        f"answers are the same, and there are {cost['spikes']:.2f} times as many spikes"
    )
    if there <= here:
        return text
    return text + "; if it was trained with that reset, train it with a reset to zero"


def _threshold(network, stepped, layers, settings, dataset):
    """The confidence for early decisions of networks on events."""
    if not settings.on_events or network.outputs < 2:
        return None
    held_out = dataset.split.held_out(settings.seed)[1][:DECIDED_ON]
    inputs = dataset.inputs[held_out]
    outputs = _outputs(network, stepped, inputs, settings)[0]
    sums = delayed(np.cumsum(outputs, 1), len(layers))
    found = choose_threshold(sums, dataset.labels[held_out], last_steps(inputs))
    return {**found._asdict(), "samples": len(held_out)}


# --- the graph as written -------------------------------------------------------------------------


def _outputs(network, stepped, inputs, settings, advance=None, reset="value"):
    """Outputs (n_samples, steps, classes), and spikes (n_samples, neurons) of each node by name."""
    outputs, counts = [], []
    for start in range(0, len(inputs), AT_ONCE):
        part = inputs[start : start + AT_ONCE]
        if DEPLOYED in network.metadata and isinstance(settings.stimulus, ImageSpikes):
            # exported from a bundle, whose graph is for the input neurons' spikes
            spikes = _input_spikes(settings.stimulus, part, settings.steps)
            presented = graph_inputs(network, spikes.reshape(*spikes.shape[:2], *part.shape[1:]), 0)
        else:
            presented = graph_inputs(network, part, settings.steps)
        found = simulate(network, presented, stepped.seconds, stepped.method, reset)
        outputs.append(found.outputs.reshape(*found.outputs.shape[:2], -1))
        counts.append({n: _in_places(s.sum(1, dtype=np.int64)) for n, s in found.spikes.items()})
        if advance is not None:
            advance(len(part))
    joined = {name: np.concatenate([part[name] for part in counts]) for name in counts[0]}
    return np.concatenate(outputs), joined


def graph_inputs(network: NirNetwork, inputs, steps: int) -> np.ndarray:
    """Samples of a run in the form of a graph's input.

    Parameters
    ----------
    network : NirNetwork
    inputs : ndarray
        Images (n_samples, rows, columns, 1), which are presented for ``steps`` steps, or frames of
        events (n_samples, steps, rows, columns, 2).
    steps : int

    Returns
    -------
    ndarray, shape (n_samples, steps, ...)
        Channels first, or flat.
    """
    if inputs.ndim == 4:
        inputs = np.broadcast_to(inputs[:, None], (len(inputs), steps, *inputs.shape[1:]))
    first = np.moveaxis(inputs, -1, 2)
    return first.reshape(*first.shape[:2], *network.input_shape)


def _in_places(values):
    """Values (n, channels, rows, columns), or flat, converted to the chip's order and flattened."""
    moved = np.moveaxis(values, 1, -1) if values.ndim > 2 else values
    return moved.reshape(len(values), -1)


def graph_responses(graph: Path, settings: Settings, bundle: Bundle, advance=None) -> Responses:
    """Responses of the original graph to a bundle's samples, in floating point, each from rest.

    Parameters
    ----------
    graph : Path
    settings : Settings
    bundle : Bundle
    advance : callable, optional
        Called with the number of samples done since the last call.
    """
    network, inputs, spec = read_nir(graph), bundle.checks.inputs, bundle.spec
    outputs, counts = _outputs(network, Stepped.of(settings, network), inputs, settings, advance)
    if settings.network == "retrained":  # its estimator was trained with it, not with the graph
        spec = replace(
            spec, estimator=None, presentation=replace(spec.presentation, confidence=None)
        )
    readout = spec.layers[-1]
    if readout.neurons is None:
        outputs = outputs - readout.bias  # which read_output adds
    if spec.stimulus.static:  # a graph takes the image itself, not spikes
        sizes = {"input": int(np.prod(spec.input_shape))}
        sizes |= {layer.name: layer.size for layer in spec.layers if layer.neurons}
        silent = {name: np.zeros((len(inputs), size)) for name, size in sizes.items()}
        found = read_output(replace(spec, estimator=None), outputs, silent)
        return replace(found, spikes={}, operations={})
    spikes = {"input": inputs.reshape(*inputs.shape[:2], -1).sum(1, dtype=np.int64)}
    names = [name for name in spec.spiking_layers if name != "input"]
    spikes |= dict(zip(names, counts.values(), strict=True))
    return read_output(spec, outputs, spikes)


# --- the network for the chip ---------------------------------------------------------------------


def deployed_nir(
    folder: Path,
    confidence: float | None,
    settings: Settings,
    dataset: Dataset,
    provenance: dict,
) -> NetworkSpec:
    """Describe the deployed network of a run's graph; see :func:`spec_of_nir`.

    Parameters
    ----------
    folder : Path
        Folder of the network.
    confidence : float or None
        Confidence for early decisions; None without early decisions.
    settings, dataset, provenance
    """
    network = read_nir(folder / GRAPH)
    presentation = settings.presented(confidence)
    if (exported := exported_here(network, folder / GRAPH)) is not None:
        fed = (settings.stimulus, dataset.inputs.shape[-3:])
        if fed != (exported.stimulus, exported.input_shape):
            raise UserError(
                f"{settings.nir.file}: exported from a bundle with another input than these "
                f"settings say ({exported.stimulus}); {AGAIN}"
            )
        return replace(exported, presentation=presentation, provenance=provenance)
    rng = np.random.default_rng([settings.seed, 0x41B])
    some = np.sort(rng.permutation(dataset.split.train)[:CALIBRATED_ON])
    return spec_of_nir(
        network,
        Stepped.of(settings, network),
        settings.stimulus,
        presentation,
        dataset.inputs[some],
        provenance,
        settings.deployment.pop_type,
    )


def spec_of_nir(
    network: NirNetwork,
    stepped: Stepped,
    stimulus: Stimulus,
    presentation: Presentation,
    samples,
    provenance: dict,
    pop_type: int = 32,
) -> NetworkSpec:
    """Describe the deployed network of a NIR graph; see :mod:`models.nir_layers` for differences.

    Parameters
    ----------
    network : NirNetwork
    stepped : Stepped
    stimulus : EventFrames or ImageSpikes
    presentation : Presentation
    samples : ndarray
        Training samples in the format of the stimulus, on which the scales of the weights are
        chosen; their shape is that of the input.
    provenance : dict
        Stored in the bundle.
    pop_type : int
        NengoLoihi's population axon type.
    """
    if not isinstance(stimulus, (EventFrames, ImageSpikes)):
        raise UserError(
            "'deployment.first_layer' must be chip for a NIR graph, whose neurons are all there"
        )
    samples = np.asarray(samples)
    shape = samples.shape[-3:]
    layers = layers_of(network, stepped.seconds, stepped.method, shape)
    height = stimulus.area / LOIHI.dt  # of a spike of the input neurons, in the graph's units
    signal = _input_spikes(stimulus, samples, presentation.steps)
    made = []
    for index, layer in enumerate(layers):
        if not layer.spiking:
            made.append(_readout(layer, presentation, pop_type))
            continue
        factor = height if index == 0 else 1.0
        scaled = replace(layer, weights=layer.weights * factor)
        made.append(_on_chip(scaled, chosen(scaled, signal), factor, pop_type))
        signal = fired(scaled, signal)
    return NetworkSpec(
        architecture=notation(shape, layers),
        input_shape=shape,
        stimulus=stimulus,
        layers=tuple(made),
        presentation=presentation,
        provenance=provenance,
    )


def _on_chip(layer: NirLayer, integers, height, pop_type) -> Layer:
    chip = on_loihi(integers, LOIHI.dt)
    weights = chip.weights * (layer.pool**2 / height)
    weights = weights if layer.kind == "conv" else weights.T
    return chip_layer(chip, weights, _geometry(layer, pop_type))


def _readout(layer: NirLayer, presentation, pop_type) -> Layer:
    read = np.arange(presentation.readout_start, presentation.steps) + 1
    # The host's bias is the same at each step: it gets the mean of the graph's.
    bias = layer.bias - layer.fading * np.mean(layer.keep_u**read)
    synapse = float(-LOIHI.dt / np.log(layer.keep_u)) if layer.keep_u > 0 else None
    return host_readout(layer.weights.T, bias, _geometry(layer, pop_type), synapse)


def _geometry(layer, pop_type):
    same = ("name", "kind", "input_shape", "shape", "stride", "padding", "pool")
    kernel = layer.weights.shape[0] if layer.kind == "conv" else 0
    geometry = {name: getattr(layer, name) for name in same}
    return {**geometry, "kernel": kernel, "block_shape": None, "pop_type": pop_type}


def _input_spikes(stimulus, samples, steps):
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


def notation(shape, layers) -> str:
    """The layers in the notation of architectures, such as ``10x10x2-12c4s2-64-10o``."""
    parts = ["x".join(map(str, shape))]
    for layer in layers:
        if layer.pool > 1:
            parts.append(f"{layer.pool}a")
        if layer.kind == "conv":
            filters, kernel = layer.shape[-1], layer.weights.shape[0]
            parts.append(str(Convolution(filters, kernel, layer.stride, layer.padding)))
        else:
            parts.append(f"{layer.size}{'o' if layer.name == 'output' else ''}")
    return "-".join(parts)
