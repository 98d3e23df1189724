"""Pre-flight: the resources that a network needs of each core, before it is sent to a board.

The counts are those of the blocks that NengoLoihi's builder makes, one block per core, and are
compared with the limits of Loihi 1.  NengoLoihi checks some of them itself; this module checks all
of them, including AxonCfg registers and the synapse memory of separate lists, and reports by how
much a layer exceeds a limit and what to change.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Dict, List, Tuple

from ..arithmetic import divide_up
from ..errors import UserError
from ..network.build import build_nengo_network
from ..network.chip import DT, LOIHI, Chip
from ..network.loihi_import import BUILD_ERRORS, make_build_error, nengo_loihi
from ..network.spec import NetworkSpec, get_spec
from ..tables import align_in_blocks, format_count
from ..terminal import WARNING
from .resources import (
    compute_worst_case,
    count_axon_cfg_registers,
    count_used,
    find_axons_with_targets,
)

# Column titles of a chip's limits in a table.
COLUMNS = ("compartments", "axons in", "axons out", "AxonCfg", "synapse words")

# The remedy for each exceeded limit. Layers are divided into blocks automatically. Therefore only a
# layer whose ``block_shape`` was set from Python can have too many compartments.
REMEDIES = {
    "compartments": "give the layer a block_shape of at most {limit} neurons",
    "input axons": "give the layer fewer inputs, by a convolution with a stride before it",
    "output axons": "use fewer filters or units in this layer or the next",
    "AxonCfg registers": "use fewer filters or units in this layer or the next",
    "synapse words": "give the layer fewer inputs, by a stride and fewer filters before it",
}


@dataclass(frozen=True)
class CorePlan:
    """The resources of one core.

    Attributes
    ----------
    layer : str
    part : int
        Index of the block of the layer, from 0.
    chip, core : int
        Position in the placement.
    used : dict of str to int
        Number used of each of the chip's limited resources.
    unshared_axon_cfgs : int
        AxonCfg registers if the members of a population could not share them.
    pop_types : tuple of int
        Types of the incoming axons: 0 discrete, 32 population.
    threshold : int
        Membrane threshold, in the chip's integers.
    worst_input, worst_current : int
        Magnitude of one step's synaptic input and of the current in the worst case: every source
        fires at its maximum rate, and all weights have the same sign; see `Chip.input_limit` and
        `Chip.current_limit`.
    """

    layer: str
    part: int
    chip: int
    core: int
    used: Dict[str, int]
    unshared_axon_cfgs: int
    pop_types: Tuple[int, ...]
    threshold: int
    worst_input: int
    worst_current: int


@dataclass(frozen=True)
class Plan:
    """The placement of a network, with problems and warnings.

    Attributes
    ----------
    cores : list of CorePlan
    chips : int
        Number of chips that the network needs.
    problems : list of str
        Reasons why it cannot run; empty if it fits.
    warnings : list of str
        Possible problems on a board.
    chip : Chip
    """

    cores: List[CorePlan]
    chips: int
    problems: List[str]
    warnings: List[str]
    chip: Chip = LOIHI

    def to_json(self) -> dict:
        """The plan as plain values."""
        return {
            "schema": "stmnist-plan/1",
            "fits": not self.problems,
            "chips": self.chips,
            "limits": dict(self.chip.limits),
            "input_limit": self.chip.input_limit,
            "current_limit": self.chip.current_limit,
            "voltage_limit": self.chip.voltage_limit,
            "cores": [asdict(core) for core in self.cores],
            "problems": self.problems,
            "warnings": self.warnings,
        }


def make_plan(spec: NetworkSpec, chips: int = 1, chip: Chip = LOIHI) -> Plan:
    """Plan the placement of a network on the chips.

    Parameters
    ----------
    spec : NetworkSpec or Bundle
    chips : int
        Maximum number of chips.
    chip : Chip

    Raises
    ------
    UserError
        NengoLoihi cannot make blocks of the network.
    TypeError
        The network is neither a NetworkSpec nor a Bundle.
    """
    spec = get_spec(spec)
    model, blocks = _build_blocks(spec, chip)
    placed = [
        (layer, i, block) for layer, of_layer in blocks.items() for i, block in enumerate(of_layer)
    ]
    n_chips = divide_up(len(placed), chip.cores)
    positions = _allocate(model, n_chips, chip)
    axons = _Axons(_find_shortest_intervals(spec, model), _find_targets(model))
    cores = [
        _plan_core(layer, index, positions[block], block, axons, chip)
        for layer, index, block in placed
    ]
    problems = [*_list_problems(cores, chip), *_list_refractory_problems(blocks, chip)]
    if n_chips > chips:
        problems.append(
            f"the network: {len(cores)} cores need {n_chips} chips, {n_chips - chips} more than "
            f"the {chips} allowed; allow more with --chips, or use larger blocks"
        )
    warnings = [*_list_lost_weights(spec, cores), *_warn_of_layers(cores, chip)]
    return Plan(cores, n_chips, problems, warnings, chip)


def require_fit_on_chips(spec: NetworkSpec, chips: int = 1) -> Plan:
    """Plan, and refuse a network that does not fit.

    Raises
    ------
    UserError
        The network does not fit; the message names the layer, the limit, the excess and a remedy.
    """
    plan = make_plan(spec, chips)
    if plan.problems:
        others = f" (and {len(plan.problems) - 1} more)" if len(plan.problems) > 1 else ""
        raise UserError("the network does not fit: " + plan.problems[0] + others)
    return plan


def _build_blocks(spec, chip):
    """NengoLoihi's discretised blocks: ``(model, {layer: list of blocks})``."""
    built = build_nengo_network(spec, chip=chip)
    model = nengo_loihi.builder.Model(dt=DT)
    model.validation_level = nengo_loihi.builder.builder.ValidationLevel.NONE  # checked here
    try:
        model.build(built.network, precompute=True)
    except BUILD_ERRORS as error:
        raise make_build_error(built.network, error) from error
    blocks = {}
    for ensemble in built.network.all_ensembles:
        if built.network.config[ensemble].on_chip and ensemble in model.objs:
            of_ensemble = model.objs[ensemble]["out"]
            blocks[ensemble.label] = (
                list(of_ensemble) if isinstance(of_ensemble, (list, tuple)) else [of_ensemble]
            )
    return model, blocks


def _allocate(model, chips, chip):
    """``(chip, core)`` of each block, by the allocator that NengoLoihi uses for a board."""
    largest = max((block.compartment.n_compartments for block in model.blocks), default=0)
    if chip is not LOIHI or largest > chip.limits["compartments"]:
        # The allocator is for Loihi 1, and refuses larger blocks; the plan has them in order.
        return {block: divmod(i, chip.cores) for i, block in enumerate(model.blocks)}
    board = nengo_loihi.hardware.allocators.GreedyInterchip()(model, n_chips=chips)
    return {
        block: (board.chip_index(used), used.core_index(core))
        for used in board.chips
        for core in used.cores
        for block in core.blocks
    }


@dataclass(frozen=True)
class _Axons:
    """What a core's counts need of the network's axons, by the ``id`` of their synapse object.

    Attributes
    ----------
    intervals : dict of int to int
        Minimum interval in steps between two spikes of the sources.
    targets : dict of int to ndarray of bool
        :func:`~deploy.preflight.resources.find_axons_with_targets`.
    """

    intervals: Dict[int, int]
    targets: dict


def _plan_core(layer, index, position, block, axons, chip):
    shared, unshared = count_axon_cfg_registers(block, axons.targets)
    worst_input, worst_current = compute_worst_case(block, axons.intervals, chip)
    return CorePlan(
        layer=layer,
        part=index,
        chip=position[0],
        core=position[1],
        used=count_used(block, chip, shared),
        unshared_axon_cfgs=unshared,
        pop_types=tuple(sorted({synapse.pop_type for synapse in block.synapses})),
        threshold=int(block.compartment.vth.max()),
        worst_input=worst_input,
        worst_current=worst_current,
    )


def _find_targets(model):
    """For each synapse object, which of its axons have targets."""
    return {
        id(synapse): find_axons_with_targets(synapse)
        for block in model.blocks
        for synapse in block.synapses
    }


def _find_shortest_intervals(spec, model):
    """Minimum interval in steps of a source's spikes, for each synapse object by its ``id``."""
    intervals = {}
    for source in model.inputs:
        for axon in source.axons:
            intervals[id(axon.target)] = spec.stimulus.shortest_interval
    for block in model.blocks:
        refractory = max(1, int(block.compartment.refract_delay.min()))
        for axon in block.axons:
            intervals[id(axon.target)] = refractory
    return intervals


def _list_problems(cores, chip):
    for layer in dict.fromkeys(core.layer for core in cores):
        of_layer = [core for core in cores if core.layer == layer]
        for resource, limit in chip.limits.items():
            used = [core.used[resource] for core in of_layer]
            if max(used) > limit:
                over = sum(n > limit for n in used)
                yield (
                    f"layer {layer}: up to {max(used)} {resource} on {over} of "
                    f"{format_count(len(used), 'core')}, but a core has {limit}; "
                    f"{REMEDIES[resource].format(limit=limit)}"
                )


def _list_refractory_problems(blocks, chip):
    """Layers with a longer refractory period than the chip can count."""
    limit = chip.refractory_steps
    for layer, of_layer in blocks.items():
        steps = max(int(block.compartment.refract_delay.max()) for block in of_layer) - 1
        if steps > limit:
            yield (
                f"layer {layer}: a refractory period of {steps} steps, {steps - limit} more than "
                f"the {limit} that the chip can count; choose a shorter one (snn.tau_ref)"
            )


def _list_lost_weights(spec, cores):
    """Layers whose weights all become 0 in the chip's integers."""
    for layer in spec.layers:
        of_layer = [core for core in cores if core.layer == layer.name]
        if of_layer and layer.weights.any() and not any(core.worst_input for core in of_layer):
            yield (
                f"layer {layer.name}: all its weights become 0 in the chip's integers, the largest "
                f"is {abs(layer.weights).max():.3g}; scale the network so that its neurons' "
                "thresholds are about 1"
            )


def _warn_of_layers(cores, chip):
    """One line for each layer and kind of warning, with the number of the worst core."""
    limit = chip.limits["AxonCfg registers"]
    for layer in dict.fromkeys(core.layer for core in cores):
        of_layer = [core for core in cores if core.layer == layer]
        unshared = max(
            core.unshared_axon_cfgs if core.used["AxonCfg registers"] <= limit else 0
            for core in of_layer
        )
        if unshared > limit:
            yield (
                f"layer {layer}: {unshared} AxonCfg registers if populations cannot share them, "
                f"but a core has {limit}: a board may refuse it (NengoLoihi issue 326); "
                f"{REMEDIES['AxonCfg registers']}"
            )
        for name, worst, largest in (
            ("one step's input", max(core.worst_input for core in of_layer), chip.input_limit),
            ("the current", max(core.worst_current for core in of_layer), chip.current_limit),
        ):
            if worst >= largest:
                yield f"layer {layer}: {name} can wrap around ({worst / largest:.1f} x)"


# What the columns of a plan are.
LEGEND = (
    "- cores: of the layer; the other columns are those of its fullest core (all: --json)",
    "- pop: how spikes name the synapses that they go to (type of the input axons)",
    "- compartments: neurons",
    "- axons: connections for spikes into the core and out of it; AxonCfg: registers of the latter",
    "- input, current: the largest that can occur, in percent of the value at which the chip's",
    "  integers wrap around",
    "- threshold: in percent of the largest voltage",
    "- all other percentages: of what a core has",
)


def format_plan(plan: Plan) -> str:
    """Format a plan as a table of layers, each with its fullest core, and a few lines."""
    rows = [["layer", "cores", "pop", *COLUMNS, "input", "current", "threshold"]]
    for layer in dict.fromkeys(core.layer for core in plan.cores):
        cores = [core for core in plan.cores if core.layer == layer]
        kinds = sorted({kind for core in cores for kind in core.pop_types})
        cells = [layer, str(len(cores)), "+".join(map(str, kinds))]
        for name, limit in plan.chip.limits.items():
            largest = max(core.used[name] for core in cores)
            cells.append(f"{largest} {largest / limit:.0%}")
        worst_input = max(core.worst_input for core in cores)
        worst_current = max(core.worst_current for core in cores)
        threshold = max(core.threshold for core in cores)
        cells.append(f"{worst_input / plan.chip.input_limit:.0%}")
        cells.append(f"{worst_current / plan.chip.current_limit:.0%}")
        cells.append(f"{threshold / plan.chip.voltage_limit:.0%}")
        rows.append(cells)
    lines = align_in_blocks(rows, left=3)
    lines.append(f"cores: {len(plan.cores)}, chips: {plan.chips}")
    lines += LEGEND
    lines += [f"{WARNING}{line}" for line in plan.warnings]
    lines += [f"does not fit: {line}" for line in plan.problems]
    return "\n".join(lines)
