"""A graph's accuracy, the cost of the chip's reset, and its threshold for early decisions."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.files import copy_file
from deploy.network.decision import choose_threshold, delay_outputs
from deploy.network.stimulus import find_last_steps
from models.nir.chain import from_nir
from models.nir.graph import NirNetwork
from pipeline.kinds.events.kind import drop_unreliable_threshold
from pipeline.kinds.nir.conversion import list_conversion_notes, record_convention
from pipeline.kinds.nir.importing import GRAPH, Stepping, find_graph, find_input_shape
from pipeline.kinds.nir.simulation import NUMPY, compute_predictions, simulate_samples
from pipeline.progress import progress
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.splits import Split
from pipeline.settings import Settings

# Maximum number of training samples on which the threshold for early decisions is chosen.
MAX_THRESHOLD_SAMPLES = 300

# Maximum number of training samples on which the two resets are compared.
MAX_RESET_SAMPLES = 200

# Share of the steps with spikes from which a neuron counts as one that never rests.
RUNAWAY_SPIKE_SHARE = 0.9

RESET_TEXT = (
    "nir: neurons reset to v_reset on the chip, not by subtraction: an accuracy of {accuracy:.3f} "
    "instead of {accuracy_as_trained:.3f} on {samples} training samples, {agreement:.1%} of their "
    "predictions are the same"
)

USUAL_RESET_TEXT = (
    "nir: if it was trained with its package's usual reset, which graphs do not record "
    "(--set nir.reset={reset}), it has an accuracy of {accuracy_as_trained:.3f}, and with the "
    "chip's {accuracy:.3f}, on {samples} training samples; {agreement:.1%} of their predictions "
    "are the same"
)

CHANCE_TEXT = (
    "nir: hardly better than chance; was the graph trained on inputs in this order (ON, OFF, rows, "
    "columns), with this --step, input.refractory, image.normalisation and order of the classes, "
    "and with the step, equation and reset that are printed above ('nir.step', 'nir.method', "
    "'nir.reset')?"
)


def import_graph(folder: Path, settings: Settings, dataset: Dataset, say=print) -> dict:
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
        As :func:`find_graph`.
    """
    begun = time.perf_counter()
    source, network = find_graph(folder, settings, dataset)
    stepping = Stepping.from_settings(settings, network)
    layers = from_nir(network, stepping.step_s, stepping.method, find_input_shape(dataset))
    for line in list_conversion_notes(network, layers, stepping, settings):
        say(f"nir: {line}")
    cost = _measure_reset(network, stepping, settings, dataset, say)
    part = "test" if len(dataset.split.test) else "validation"
    index = dataset.split.get_indices(part)
    with progress("simulate nir", len(index)) as advance:
        inputs = dataset.inputs[index]
        outputs, spikes = simulate_samples(network, stepping, inputs, settings, advance)
    _refuse_runaway(network, spikes, settings.steps)
    right = compute_predictions(outputs, settings) == dataset.labels[index]
    accuracy = float(right.mean())
    interval = compute_wilson_interval(int(right.sum()), len(right))
    metrics = {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": {part: accuracy},
        f"{part}_accuracy_ci95": list(interval),
        f"n_{part}": len(index),
        "epochs": 0,
        "convention": record_convention(network, stepping),
        "reset": cost,
        "decides_by_itself": choose_early_threshold(network, stepping, layers, settings, dataset),
        "versions": NUMPY,
    }
    if source != folder / GRAPH:
        _replace_network(folder, source)
    metrics["seconds"] = time.perf_counter() - begun
    say(
        f"nir: {part} accuracy of the graph {accuracy:.3f} on {len(index)} samples, "
        f"{metrics['seconds']:.0f} s"
    )
    likeliest = float(np.bincount(dataset.labels[index]).max() / len(index))
    if interval[0] <= likeliest:
        say(CHANCE_TEXT)
    return metrics


def _replace_network(folder, source):
    """Copy a graph into a folder, without the records of the network before."""
    for record in ("metrics.json", "training.json", "history.csv"):
        (folder / record).unlink(missing_ok=True)
    copy_file(source, folder / GRAPH)


def _measure_reset(network, stepping, settings, dataset, say):
    """Measure and say the effect of the chip's reset on a graph of another reset.

    If a graph does not record its reset, and the user sets none, the reset is that which its
    framework has by default.

    Returns
    -------
    dict or None
        As :func:`measure_reset_cost`; None if there is no other reset.
    """
    cost = None
    if stepping.reset != "value":
        cost = measure_reset_cost(network, stepping, settings, dataset)
        say(RESET_TEXT.format(**cost))
    usual_reset = network.convention.usual_reset
    if usual_reset and settings.nir.reset == "auto":
        with_usual_reset = replace(stepping, reset=usual_reset)
        cost = measure_reset_cost(network, with_usual_reset, settings, dataset)
        say(USUAL_RESET_TEXT.format(reset=usual_reset, **cost))
    return cost


def measure_reset_cost(network: NirNetwork, stepping: Stepping, settings, dataset) -> dict:
    """Effect of the chip's reset on the predictions of a graph that was trained with another.

    Returns
    -------
    dict
        Training ``samples``; ``accuracy`` with the chip's reset and ``accuracy_as_trained``;
        ``agreement``, the share of samples with the same prediction.
    """
    rng = np.random.default_rng([settings.seed, 0x5EB])
    chosen = np.sort(rng.permutation(dataset.split.train)[:MAX_RESET_SAMPLES])
    inputs = dataset.inputs[chosen]
    labels = dataset.labels[chosen]
    on_chip, as_trained = (
        compute_predictions(simulate_samples(network, run, inputs, settings)[0], settings)
        for run in (replace(stepping, reset="value"), stepping)
    )
    return {
        "samples": len(chosen),
        "accuracy": float((on_chip == labels).mean()),
        "accuracy_as_trained": float((as_trained == labels).mean()),
        "agreement": float((on_chip == as_trained).mean()),
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
        share = (spikes[node.name] > RUNAWAY_SPIKE_SHARE * steps).mean()
        if share > 0.5:
            raise UserError(
                f"{node}: its connection to itself through {node.loop.name!r} runs away: "
                f"{share:.0%} of its neurons spike at almost every step of these recordings; "
                "correct the step (--step), or train it on inputs of this density"
            )


def choose_early_threshold(network, stepping, layers, settings, dataset):
    """The threshold for early decisions of networks on events; None for others."""
    if not settings.on_events or network.outputs < 2:
        return None
    held_out = draw_held_out(dataset.split, settings.seed)
    inputs = dataset.inputs[held_out]
    outputs = simulate_samples(network, stepping, inputs, settings)[0]
    sums = delay_outputs(np.cumsum(outputs, 1), len(layers))
    loss = settings.presentation.early_loss
    threshold = choose_threshold(sums, dataset.labels[held_out], find_last_steps(inputs), loss)
    return {
        **drop_unreliable_threshold(threshold, len(held_out)).to_json(),
        "samples": len(held_out),
    }


def draw_held_out(split: Split, seed: int) -> np.ndarray:
    """Indices of the held-out samples on which the threshold is chosen, of every class.

    Held-out samples are in the order of the recordings, which is usually that of the classes, so
    they are drawn at random.
    """
    held_out = split.hold_out(seed)[1]
    return np.random.default_rng([seed, 0xDEC]).permutation(held_out)[:MAX_THRESHOLD_SAMPLES]
