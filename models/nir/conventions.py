"""Which framework wrote a graph, told from its numbers, and what its numbers mean.

NIR's equations have seconds, but frameworks have steps.  Each writes its time constants and factors
in its own way.  Each function ``recognise_...`` knows one way, and :func:`recognise_convention`
calls them in order.  A framework is recognised if all neurons and filters of the graph fit.  The
table in ``docs/nir.md`` has the same rules in words.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import lambertw

from models.nir.equations import name_voltage_time

# Relative tolerance of numbers that were computed in 32 bits.
TOLERANCE = 1e-3

# The step that snnTorch's and SpikingJelly's exporters write, whatever the training had; Norse's.
EXPORTED_STEP_S = 1e-4
NORSE_STEP_S = 1e-3

# Time constants, in seconds, below which a graph with r = 1 cannot be in seconds: Norse's
# exporter multiplies them with its step, SpikingJelly's has multiples of 0.1 ms.
SHORTEST_SPIKINGJELLY = 1e-4
SHORTEST_TAU_S = 5e-3

SNNTORCH_RESET = (
    "snnTorch does not export its reset, which by default subtracts the threshold, a step later: "
    "if it was trained so, give --set nir.reset=subtract-late (with reset_delay=False: subtract); "
    "without a reset it cannot be on the chip"
)
SYNAPTIC_RESET = (
    "; Synaptic with reset_mechanism='zero' needs reset_delay=False, or it ignores the input of "
    "the step after a spike there and not here"
)
SINABS_RESET = (
    "sinabs does not export its reset: by default a neuron spikes as often in a step as the "
    "threshold can be subtracted, and an IF stays above minus its threshold (--set "
    "nir.reset=subtract-all; with SingleSpike and without min_v_mem: subtract)"
)
LEAKY_IN_STEPS = (
    "; it does not export norm_input=False (--set nir.method=rockpool) nor tau_syn; SpikingJelly's "
    "exporter with dt=1 writes the same numbers for Euler steps (--set nir.method=euler)"
)
SNNTORCH_OF_2023 = (
    "snnTorch's exporter of 2023 wrote the same; for it give --set nir.reset=subtract-late, its "
    "default, or =value for a reset to zero"
)
SPYX_ORDER = (
    "; Spyx flattens images with their channels last, and writes the weights after a Flatten in "
    "that order: bring them into NIR's, which has channels first"
)
NORSE_RESET = "Norse does not export v_reset: a reset to other values than the graph's is lost"


@dataclass(frozen=True)
class Convention:
    """How a graph's numbers are read.

    Attributes
    ----------
    framework : str
        Name of the framework, or of the rule.
    method : str
        One of :data:`models.nir.equations.METHODS`.
    step_s : float or None
        Seconds of the graph's time in a step; None if the graph has seconds and no step.
    evidence : str
        What the framework was recognised by.
    equation : str
        The step in one line.
    reset : str
        One of :data:`models.nir.simulator.RESETS`.
    doubt : str
        What may be wrong, and the setting that corrects it; empty for nothing.
    at_threshold : bool
        A neuron spikes when it reaches its threshold, not only above it.
    usual_reset : str
        The framework's default, one of :data:`models.nir.simulator.RESETS`, where graphs do not
        record the reset and ``reset`` is another one; empty for none.
    """

    framework: str
    method: str
    step_s: float | None
    evidence: str
    equation: str
    reset: str = "value"
    doubt: str = ""
    at_threshold: bool = False
    usual_reset: str = ""


def recognise_convention(nodes, metadata: dict) -> Convention:
    """The convention of a graph.

    Parameters
    ----------
    nodes : sequence of models.nir.nodes.Node
    metadata : dict
        The metadata of the graph.
    """
    states = [node for node in nodes if "r" in node.parameters]
    convention = recognise_metadata(states, metadata) or recognise_reset_free(nodes)
    if convention is not None:
        return convention
    for rule in RULES:
        convention = rule(states)
        if convention is not None:
            return convention
    return _read_as_nir(states)


def _read_as_nir(nodes):
    """NIR's own equations, of a graph that fits no framework."""
    leaky = [node for node in nodes if node.kind != "IF"]
    in_steps = bool(leaky) and all((node[name_voltage_time(node)] >= 1).all() for node in leaky)
    doubt = ""
    if in_steps:
        doubt = "its time constants are taken as steps, being 1 or more"
    elif leaky:
        doubt = "its time constants are taken as seconds"
    elif nodes:
        doubt = "an IF adds r times the step in seconds (if it adds r, give --set nir.step=1000)"
    if doubt:
        doubt = (
            f"no framework is recognised, so {doubt}; 'nir.step', 'nir.method' and 'nir.reset' say "
            "otherwise"
        )
    if leaky:
        doubt += " (Norse with its defaults: --set nir.step=1 --set nir.method=euler)"
    return Convention(
        "NIR", "exact", 1.0 if in_steps else None, "no framework's numbers",
        "NIR's own, solved exactly", doubt=doubt,
    )  # fmt: skip


def recognise_metadata(nodes, metadata):
    """This project's own exports, which have their step in the metadata."""
    step = np.asarray(metadata.get("dt"))
    if step.dtype.kind != "f" or step.size != 1 or not step > 0:
        return None
    return Convention(
        "NIR with a step", "exact", float(step), "'dt' in the metadata", "NIR's own, solved exactly"
    )


def recognise_reset_free(nodes):
    """Spyx's PSU_LIF: LI with r = 1, each before a Threshold, and time constants in steps.

    Spyx's v <- beta v + S has no 1 - beta, unlike NIR's equation of LI.
    """
    states = [node for node in nodes if "r" in node.parameters]
    followed = {node.name for node, after in pairwise(nodes) if after.kind == "Threshold"}
    if not states or any(node.kind != "LI" or node.name not in followed for node in states):
        return None
    if not _have_unit_factors(states) or any(
        (node["tau"] < 1 - TOLERANCE).any() for node in states
    ):
        return None
    return Convention(
        "Spyx", "spyx", 1.0, "LI with r = 1 and tau of 1 or more before each Threshold (PSU_LIF)",
        "v <- b v + S, b = 1 - 1 / tau",
        doubt="if the graph was not written by Spyx but has NIR's own equations, give --set "
        "nir.method=exact",
    )  # fmt: skip


def recognise_snntorch(nodes):
    """snnTorch, and SpikingJelly without a decaying input: r h = tau and w_in h = tau_syn.

    ``Leaky`` and ``Synaptic`` have no time; a share beta remains after a step.  The exporter writes
    tau = h / (1 - beta) with h = 0.1 ms.  With another h, 1 ms or 1 s, it is the same equation.
    """
    if not nodes or any(node.kind not in ("LIF", "CubaLIF") for node in nodes):
        return None
    steps = [node[name_voltage_time(node)] / _hide_zeros(node["r"]) for node in nodes]
    currents = [node for node in nodes if node.kind == "CubaLIF"]
    into = [node["tau_syn"] / _hide_zeros(node["w_in"]) for node in currents]
    for h in (EXPORTED_STEP_S, 1e-3, 1.0):
        have_factors = all(_are_near(step, h) for step in into)
        if not all(_are_near(step, h) for step in steps):
            continue
        if have_factors or (h == EXPORTED_STEP_S and all(map(_has_no_w_in, currents))):
            text = ", w_in too" if have_factors else ", without w_in, as in 2023"
            return Convention(
                "snnTorch", "euler" if have_factors else "spyx", h,
                f"r = tau / {_format_time(h)}" + text * bool(currents),
                "I <- alpha I + S, v <- beta v + I" if currents else "v <- beta v + S",
                doubt=SNNTORCH_RESET + SYNAPTIC_RESET * bool(currents),
                usual_reset="subtract-late",
            )  # fmt: skip
    return None


def recognise_rockpool(nodes):
    """Rockpool: r = tau exp(-h / tau) / h and no w_in, with one h for all neurons.

    h / tau is Lambert's W(1 / r).  Any r gives some h, so it must be a round number,
    or the time constants must differ.
    """
    if not nodes or any(node.kind not in ("LIF", "LI", "CubaLIF") for node in nodes):
        return None
    if not all((node["r"] > 0).all() and _has_no_w_in(node) for node in nodes):
        return None
    taus = np.concatenate([node[name_voltage_time(node)].ravel() for node in nodes])
    resistances = np.concatenate([node["r"].ravel() for node in nodes])
    steps = taus * lambertw(1 / resistances).real
    h = float(np.median(steps))
    is_round = abs(float(f"{h:.1e}") / h - 1) < 1e-4
    differ = not _are_near(taus, taus[0], 0.01)
    if not _are_near(steps, h, 1e-4) or not (is_round or differ) or (resistances == 1).all():
        return None
    h = float(f"{h:.1e}") if is_round else h
    return Convention(
        "Rockpool", "rockpool", h, f"r = tau exp(-h / tau) / h with h = {_format_time(h)}, no w_in",
        "I <- a (I + S), v <- b v + I", "subtract", at_threshold=True, usual_reset="subtract-all",
        doubt="Rockpool does not export the biases of its neurons, nor max_spikes_per_dt, without "
        "which they may spike several times in a step (--set nir.reset=subtract-all)",
    )  # fmt: skip


def recognise_spyx(nodes):
    """Spyx: r = 1 - h / tau, the share that remains, and no w_in; IF have r = 1.

    snnTorch's first exporter (2023) wrote the same.  Spyx's CuBaLIF subtracts the threshold before
    the leak, its LIF and IF after it, as snnTorch does.
    """
    leaky = [node for node in nodes if node.kind != "IF"]
    if not leaky or not all(_has_no_w_in(node) for node in leaky):
        return None
    if not all((node["r"] < 1 - TOLERANCE).all() for node in leaky):
        return None
    steps = [node[name_voltage_time(node)] * (1 - node["r"]) for node in leaky]
    has_currents = any(node.kind == "CubaLIF" for node in leaky)
    for h in (1.0, 1e-3, EXPORTED_STEP_S):
        if all(_are_near(step, h) for step in steps):
            return Convention(
                "Spyx", "spyx", h, f"r = 1 - {_format_time(h)} / tau, no w_in",
                "I <- a I + S, v <- b v + I", "subtract" if has_currents else "subtract-late",
                doubt=SNNTORCH_OF_2023
                + SPYX_ORDER * any(len(node.shape) == 3 for node in nodes),
            )  # fmt: skip
    return None


def recognise_norse_currents(nodes):
    """Norse's LIFCell: CubaLIF with r = 1 and no w_in."""
    currents = [node for node in nodes if node.kind == "CubaLIF"]
    if not currents or not _have_unit_factors(nodes):
        return None
    h = _find_norse_step(nodes)
    return Convention(
        "Norse", "norse", h, "CubaLIF with r = 1 and no w_in",
        "I <- I + S, v <- b v + (1 - b) (v_leak + I), I <- a I",
        doubt=f"its step is not in the graph; {_format_time(h)} is Norse's default, others "
        "need --set nir.step (in ms); if its current is NIR's own, give --set nir.method=exact; "
        + NORSE_RESET,
    )  # fmt: skip


def recognise_spikingjelly(nodes):
    """SpikingJelly: IF have r = 1 / h; LIF have r = 1, or r h = tau, and tau in multiples of h.

    The exporter's h is 0.1 ms.  Without IF only small time constants tell.
    """
    if not nodes or any(node.kind not in ("LIF", "IF") for node in nodes):
        return None
    integrators = [node for node in nodes if node.kind == "IF"]
    leaky = [node for node in nodes if node.kind == "LIF"]
    doubt = (
        "SpikingJelly does not export v_reset=None, with which it subtracts the threshold: if it "
        "was trained so, give --set nir.reset=subtract"
    )
    if integrators:
        h = float(1 / _hide_zeros(integrators[0]["r"]).flat[0])
        exponent = np.log10(h) if h > 0 else 0
        if not -6.1 < exponent < -1.9 or not _are_near(h, 10.0 ** round(exponent)):
            return None
        h = 10.0 ** round(exponent)
        if not all(_are_near(node["r"], 1 / h) for node in integrators):
            return None
        evidence = f"IF with r = 1 / {_format_time(h)}"
    else:
        h = EXPORTED_STEP_S
        evidence = "LIF with r = 1 and time constants of some tenths of a ms"
        taus = np.concatenate([node["tau"].ravel() for node in leaky])
        is_short = (taus >= SHORTEST_SPIKINGJELLY * (1 - TOLERANCE)) & (taus < SHORTEST_TAU_S)
        if not is_short.all() or not _have_unit_factors(leaky):
            return None
        doubt += (
            "; if its exporter had another dt, or these are seconds, give --set nir.step (in ms)"
        )
    if not all(
        _are_near(node["r"], 1.0) or _are_near(node["r"], node["tau"] / h) for node in leaky
    ):
        return None
    if any((node["tau"] < h * (1 - TOLERANCE)).any() for node in leaky):
        return None
    return Convention(
        "SpikingJelly" if integrators else "SpikingJelly, or NIR's paper", "euler", h, evidence,
        "v <- v + S" if not leaky else "v <- v + (S - (v - v_leak)) / tau, tau in steps",
        doubt=doubt, at_threshold=True,
    )  # fmt: skip


def recognise_norse_boxes(nodes):
    """Norse's LIFBoxCell and LIBoxCell as its exporter writes them by default: times times 1 ms."""
    times = [node["tau"].max() for node in nodes if node.kind in ("LIF", "LI")]
    if not times or max(times) >= SHORTEST_SPIKINGJELLY or not _have_unit_factors(nodes):
        return None
    h = _find_norse_step(nodes)
    return Convention(
        "Norse", "euler", h, "r = 1 and time constants of some microseconds",
        "v <- b v + (1 - b) (v_leak + S)",
        doubt="its step is not in the graph; this is that of Norse's defaults, others need --set "
        "nir.step (in ms); " + NORSE_RESET,
    )  # fmt: skip


def recognise_steps(nodes):
    """sinabs and graphs by hand: r = 1, time constants counted in steps, IF that add their input.

    sinabs' LIF has alpha = exp(-1 / tau) and v <- alpha v + (1 - alpha) S.
    """
    if not nodes or not _have_unit_factors(nodes):
        return None
    leaky = [node for node in nodes if node.kind != "IF"]
    if any((node[name_voltage_time(node)] < 1).any() for node in leaky):
        return None
    return Convention(
        "time in steps (sinabs, Norse's IAFCell, graphs by hand)", "exact", 1.0,
        "r = 1" + " and time constants of 1 or more" * bool(leaky),
        "v <- alpha v + (1 - alpha) S, alpha = exp(-1 / tau)" if leaky else "v <- v + S",
        doubt=SINABS_RESET + LEAKY_IN_STEPS * bool(leaky),
        usual_reset="subtract-all",
    )  # fmt: skip


RULES = (
    recognise_snntorch,
    recognise_norse_currents,
    recognise_rockpool,
    recognise_spyx,
    recognise_spikingjelly,
    recognise_norse_boxes,
    recognise_steps,
)


def _hide_zeros(values):
    return np.where(values == 0, np.nan, values)


def _are_near(values, target, tolerance=TOLERANCE) -> bool:
    return bool(np.allclose(values, target, rtol=tolerance, atol=0))


def _has_no_w_in(node):
    return "w_in" not in node.parameters or _are_near(node["w_in"], 1.0)


def _have_unit_factors(nodes):
    return all(_are_near(node["r"], 1.0) and _has_no_w_in(node) for node in nodes)


def _find_norse_step(nodes):
    """Norse's step in the graph's time, by the size of its time constants.

    Its exporter writes tau dt with its own dt, 1 ms by default, or tau itself (dt = 1); tau of 1
    and more are counted in steps.
    """
    longest = max(node[name_voltage_time(node)].max() for node in nodes if node.kind != "IF")
    if longest < SHORTEST_TAU_S / 5:
        return NORSE_STEP_S**2
    return NORSE_STEP_S if longest < 1 else 1.0


def _format_time(seconds):
    return f"{1000 * seconds:g} ms" if seconds < 1 else f"{seconds:g} s"
