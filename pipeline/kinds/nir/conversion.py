"""The deployed network of a NIR graph, and what its conversion changes."""

from __future__ import annotations

from dataclasses import replace

from deploy.network.chip import LOIHI
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import Stimulus
from deploy.terminal import WARNING
from models import chain
from models.nir.chain import from_nir
from models.nir.graph import NirNetwork
from models.rounding import round_chain, round_to_integers
from pipeline.kinds.nir.importing import Stepping
from pipeline.settings import Settings

# Lowest voltage, in thresholds, above which the end of the chip's registers is mentioned.
FLOOR_IN_THRESHOLDS = -8


def record_convention(network: NirNetwork, stepping: Stepping) -> dict:
    """What a graph was recognised as and how it is run, for the bundle's provenance."""
    convention = network.convention
    has_own_equation = stepping.method == convention.method
    equation = convention.equation if has_own_equation else stepping.method
    return {
        "framework": convention.framework,
        "recognised_by": convention.evidence,
        "equation": equation,
        "method": stepping.method,
        "step_seconds": stepping.step_s,
        "reset": stepping.reset,
    }


def list_conversion_notes(
    network: NirNetwork, links: tuple, stepping: Stepping, settings: Settings
):
    """Yield how a graph is read, what its conversion changes and what may be wrong.

    Parameters
    ----------
    network : NirNetwork
    links : tuple of Link
        As :func:`models.nir.chain.from_nir` gives them.
    stepping : Stepping
    settings : Settings
    """
    convention = network.convention
    record = record_convention(network, stepping)
    yield (
        f"read as {convention.framework}, by {convention.evidence}: {record['equation']}; a step "
        f"is {1000 * stepping.step_s:g} ms of the graph's time, reset: {stepping.reset}"
    )
    is_as_recognised = (settings.nir.step_ms, settings.nir.method) == (0, "auto")
    if convention.doubt and is_as_recognised and settings.nir.reset == "auto":
        yield f"{WARNING}{convention.doubt}"
    for node in network.nodes:
        yield from _list_doubtful_times(node, stepping.step_s, settings.steps)
    for link in links:
        windows = [n for n in network.nodes if n.name in link.sources and "Conv" in n.kind]
        is_matrix = link.neurons is not None and link.kind == "dense"
        if is_matrix and windows and len(windows[0].input_shape) > 1:
            yield (
                f"{link}: takes the memory of a dense layer, since its windows are not the chip's "
                "(square kernels, equal strides and paddings) or its neurons' parameters differ "
                "within a channel"
            )
    height = settings.stimulus.area / LOIHI.dt
    for index, link in enumerate(links):
        if link.neurons is None:
            continue
        scaled = replace(link, kernel=link.kernel * (1.0 if index else height))
        floor = -LOIHI.voltage_limit / round_to_integers(scaled).threshold
        if floor > FLOOR_IN_THRESHOLDS:
            yield f"{link}: the chip's voltages end at {-floor:.1f} thresholds below the reset"
    for node in network.nodes:
        if node.kind == "IF":
            yield f"{node}: the chip's neurons leak at least 1/4096 of the voltage per step"
        if node.kind == "CubaLI":
            yield f"{node}: only its longer time constant is kept"


def _list_doubtful_times(node, step_s, n_steps):
    """Yield a warning for time constants that no network is trained with."""
    for name in ("tau", "tau_syn", "tau_mem"):
        if name not in node.parameters:
            continue
        shortest = float(node[name].min())
        problem = ""
        if shortest > step_s * n_steps:
            problem = f"longer than a whole sample, {n_steps} steps of {1000 * step_s:g} ms"
        elif shortest < step_s * (1 - 1e-6):
            problem = f"shorter than a step of {1000 * step_s:g} ms"
        if problem:
            yield (
                f"{WARNING}{node}: a {name} of {1000 * shortest:g} ms is {problem}; if it is "
                "counted in other units, give --set nir.step (the graph's time per step, in ms)"
            )


def make_nir_spec(
    network: NirNetwork,
    stepping: Stepping,
    stimulus: Stimulus,
    presentation: Presentation,
    samples,
    synapses_per_weight: int = 0,
) -> NetworkSpec:
    """Describe the deployed network of a NIR graph.

    Parameters
    ----------
    network : NirNetwork
    stepping : Stepping
    stimulus : Stimulus
    presentation : Presentation
    samples : ndarray
        Training samples in the format of the stimulus, on which the scales of weights are chosen.
    synapses_per_weight : int
        Number of synapses for a weight of recurrent layers; 0: two where they fit on a core.
    """
    readout_steps = range(presentation.readout_start, presentation.steps)
    links = from_nir(network, stepping.step_s, stepping.method, samples.shape[-3:], readout_steps)
    spikes = stimulus.compute_input_spikes(samples, presentation.steps)
    links = round_chain(links, spikes, stimulus.area / LOIHI.dt, synapses_per_weight)
    return chain.build_network_spec(links, stimulus, presentation)


def list_synapse_notes(spec: NetworkSpec):
    """Yield how many synapses the weights of recurrent layers have."""
    for layer in spec.layers:
        if layer.recurrent is None:
            continue
        number = layer.synapses_per_weight
        synapses = int(layer.fan_out.sum()) + number * layer.size**2
        if number > 1:
            yield (
                f"layer {layer.name}: {number} synapses for each weight, {synapses} in all, since "
                "its loop needs finer weights than 8 bits ('nir.synapses_per_weight')"
            )
        else:
            yield (
                f"layer {layer.name}: one synapse for each weight, {synapses} in all; two would "
                "make its weights finer, if they fit on a core ('nir.synapses_per_weight')"
            )
