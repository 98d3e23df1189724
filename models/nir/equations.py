"""The steps of a graph's neurons and filters, one function a way of integrating them.

A step lasts h seconds.  Every way is linear between two spikes.  With the input S, which is
constant during a step, the current I and the voltage v::

    v <- keep_v v + v_from_i I + v_from_s S + added          (with the current of the step before)
    I <- keep_i I + i_from_s S

The nodes' equations are (Pedersen et al. 2024, Table 1, and the docstrings of the package ``nir``):

=========  =====================================================================================
LI         tau dv/dt = (v_leak - v) + r S
LIF        as LI; a spike where v > v_threshold, and v = v_reset there
IF         dv/dt = r S; spike and reset as LIF
CubaLI     tau_syn dI/dt = -I + w_in S,   tau_mem dv/dt = (v_leak - v) + r I
CubaLIF    as CubaLI; spike and reset as LIF
Threshold  a spike where S > threshold; no state
=========  =====================================================================================

NIR does not say how time is divided into steps, and some frameworks write numbers that fit these
equations only with their own steps: :mod:`models.nir.conventions` tells which.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StepEquation:
    """The coefficients of a node's step; see the module's docstring.

    Attributes
    ----------
    keep_v, v_from_s, added, keep_i, i_from_s, v_from_i : ndarray or float
        One value for each neuron, or 0.
    """

    keep_v: np.ndarray
    v_from_s: np.ndarray
    added: np.ndarray
    keep_i: np.ndarray | float = 0.0
    i_from_s: np.ndarray | float = 0.0
    v_from_i: np.ndarray | float = 0.0

    @property
    def input_sum(self) -> np.ndarray:
        """The sum of what an input of 1 in one step adds to the voltage, without its leak."""
        return self.v_from_s + self.v_from_i * self.i_from_s / (1 - self.keep_i)


def solve_exactly(node, h) -> StepEquation:
    """The solution of NIR's equations from one step's end to the next.

    With a and b = exp(-h / tau) for tau_syn and tau_mem, and K = tau_syn (a - b) /
    (tau_syn - tau_mem), or h b / tau_mem where both are equal::

        v <- b v + (1 - b) (v_leak + r w_in S) + r (I - w_in S) K,     I <- a I + (1 - a) w_in S
    """
    if node.kind == "IF":
        return _integrate(node["r"] * h)
    b = np.exp(-h / node[name_voltage_time(node)])
    if "tau_syn" not in node.parameters:
        return StepEquation(b, (1 - b) * node["r"], (1 - b) * node["v_leak"])
    syn, mem, r, w = (node[name] for name in ("tau_syn", "tau_mem", "r", "w_in"))
    a = np.exp(-h / syn)
    are_equal = np.isclose(syn, mem, rtol=1e-9, atol=0)
    k = np.where(are_equal, h * b / mem, syn * (a - b) / np.where(are_equal, 1.0, syn - mem))
    direct = r * w * (1 - b - k)
    return StepEquation(b, direct, (1 - b) * node["v_leak"], a, (1 - a) * w, r * k)


def step_by_euler(node, h) -> StepEquation:
    """Forward Euler steps, the current before the voltage: snnTorch, SpikingJelly, Norse's boxes.

    With a and b = 1 - h / tau (0 at least)::

        I <- a I + (1 - a) w_in S,     v <- b v + (1 - b) (v_leak + r I)

    snnTorch writes r h = tau and w_in h = tau_syn, so that this is v <- beta v + I.  SpikingJelly
    writes tau in multiples of h, and r = 1 (its input decays) or r h = tau.
    """
    if node.kind == "IF":
        return _integrate(_compute_whole_input(node, h))
    b = _compute_euler_decay(h, node[name_voltage_time(node)])
    added = (1 - b) * node["v_leak"]
    if "tau_syn" not in node.parameters:
        return StepEquation(b, (1 - b) * node["r"], added)
    a = _compute_euler_decay(h, node["tau_syn"])
    v_per_i = (1 - b) * node["r"]
    i_per_s = (1 - a) * node["w_in"]
    return StepEquation(b, v_per_i * i_per_s, added, a, i_per_s, v_per_i * a)


def step_as_norse(node, h) -> StepEquation:
    """Norse's LIFCell: the current jumps by the whole input, then the voltage follows.

    With a and b = 1 - h / tau (``lif_feed_forward_step``)::

        I <- I + S,     v <- b v + (1 - b) (v_leak + r I),     I <- a I
    """
    if "tau_syn" not in node.parameters:
        return step_by_euler(node, h)
    a, b = (_compute_euler_decay(h, node[name]) for name in ("tau_syn", "tau_mem"))
    v_per_i = (1 - b) * node["r"]
    return StepEquation(
        b, v_per_i * node["w_in"], (1 - b) * node["v_leak"], a, a * node["w_in"], v_per_i
    )


def step_as_rockpool(node, h) -> StepEquation:
    """Rockpool's LIFTorch, LIFNeuronTorch and ExpSynTorch: inputs are added whole.

    With a and b = exp(-h / tau), whatever r is; Rockpool writes its step with it::

        LIFTorch  I <- a (I + S),  v <- b v + I;     LIFNeuronTorch  v <- b v + S
        ExpSynTorch  v <- b (v + S)
    """
    if node.kind == "IF":
        return _integrate(_compute_whole_input(node, h))
    b = np.exp(-h / node[name_voltage_time(node)])
    added = (1 - b) * node["v_leak"]
    if node.kind in ("LI", "LIF"):
        return StepEquation(b, b if node.kind == "LI" else np.ones_like(b), added)
    a = np.exp(-h / node["tau_syn"])
    return StepEquation(b, a, added, a, a, a)


def step_as_spyx(node, h) -> StepEquation:
    """Spyx: inputs are added whole, whatever r is: it has the share that remains.

    With a and b = 1 - h / tau::

        I <- a I + S,     v <- b v + I          (without a current: v <- b v + S)
    """
    if node.kind == "IF":
        return _integrate(_compute_whole_input(node, h))
    b = _compute_euler_decay(h, node[name_voltage_time(node)])
    added = (1 - b) * node["v_leak"]
    ones = np.ones_like(b)
    if "tau_syn" not in node.parameters:
        return StepEquation(b, ones, added)
    a = _compute_euler_decay(h, node["tau_syn"])
    return StepEquation(b, ones, added, a, ones, a)


METHODS = {
    "exact": solve_exactly,
    "euler": step_by_euler,
    "norse": step_as_norse,
    "rockpool": step_as_rockpool,
    "spyx": step_as_spyx,
}


def name_voltage_time(node) -> str:
    """Name of the time constant of a node's voltage."""
    return "tau" if "tau" in node.parameters else "tau_mem"


def _integrate(added):
    return StepEquation(np.ones_like(added), added, np.zeros_like(added))


def _compute_whole_input(node, h):
    """The factor of an IF's input: r h, or 1 if every r is 1, since then r is not in seconds."""
    return np.where((node["r"] == 1).all(), 1.0, node["r"] * h)


def _compute_euler_decay(h, tau):
    return np.maximum(1 - h / tau, 0.0)
