"""Simulation of a NIR graph in NumPy and double precision: the reference for its conversion.

The nodes' equations are (Pedersen et al. 2024, Table 1, and the docstrings of the package ``nir``),
with the input S, which is constant during a step of length h:

=========  =====================================================================================
LI         tau dv/dt = (v_leak - v) + r S
LIF        as LI; a spike where v > v_threshold, and v = v_reset there
IF         dv/dt = r S; spike and reset as LIF
CubaLI     tau_syn dI/dt = -I + w_in S,   tau_mem dv/dt = (v_leak - v) + r I
CubaLIF    as CubaLI; spike and reset as LIF
Threshold  a spike where S > threshold; no state
=========  =====================================================================================

NIR does not define how time is divided into steps, and networks are trained with either method:

``"exact"``
    The equations' own solution from one step's end to the next; with b = exp(-h / tau),
    v <- b v + (1 - b) (v_leak + r S).  For current-based neurons, with a and b for tau_syn and
    tau_mem and K = tau_syn (a - b) / (tau_syn - tau_mem), or h b / tau_mem where both are equal,
    v <- b v + (1 - b) (v_leak + r w_in S) + r (I - w_in S) K, then I <- a I + (1 - a) w_in S.
``"euler"``
    Forward Euler steps, b = 1 - h / tau, with the current updated before the voltage, as in Norse
    and snnTorch.

Spikes are detected at the ends of steps, and have a height of 1 for one step.  Neurons begin at
rest, v = v_leak and I = 0 (IF: v = v_reset).  A layer that is connected to itself receives its
spikes of the step before; NIR leaves this open.

NIR resets to v_reset, and so does the chip.  Some packages train with a reset by subtraction, which
a graph does not record; the effect can be measured with :data:`RESETS`.
"""

import math
from dataclasses import dataclass

import numpy as np

from models.nir.graph import FILTERS, SPIKING, NirError, NirNetwork, Node

METHODS = ("exact", "euler")

# Effect of a spike on v: set it to v_reset, as in NIR; subtract v_threshold - v_reset; or subtract
# it in the next step, after the leak, as snnTorch's ``subtract`` does by default.
RESETS = ("value", "subtract", "subtract-late")

# Samples that are simulated together, which bounds the memory.
AT_ONCE = 50


@dataclass(frozen=True)
class Simulated:
    """The outputs of a graph.

    Attributes
    ----------
    outputs : ndarray, shape (n_samples, steps, ...)
        Outputs of the last node: spikes, 0 or 1, or values.
    spikes : dict of str to ndarray of bool, shape (n_samples, steps, ...)
        Spikes of each spiking node, by its name.
    """

    outputs: np.ndarray
    spikes: dict


def simulate(
    network: NirNetwork, inputs, step: float, method: str = "exact", reset: str = "value"
) -> Simulated:
    """Run a graph on inputs, each sample from rest.

    Parameters
    ----------
    network : NirNetwork
    inputs : array_like, shape (n_samples, steps, ...)
        Input at each step, in the shape of ``network.input_shape`` or flat.
    step : float
        Length of a step in seconds.
    method : str
        One of :data:`METHODS`.
    reset : str
        One of :data:`RESETS`.

    Raises
    ------
    NirError
        A time constant is shorter than a step.
    ValueError
        There are no samples, they do not have the shape of the graph's input, a value is not
        finite, or the step is not positive.
    """
    inputs = np.asarray(inputs)
    if not (0 < step < math.inf and np.isfinite(inputs).all()):
        raise ValueError("the step is not positive, or an input not finite")
    check_step(network, step)
    shape, wanted = inputs.shape[2:], tuple(network.input_shape)
    one_is_flat = min(len(shape), len(wanted)) == 1 and math.prod(shape) == math.prod(wanted)
    if shape != wanted and not one_is_flat:
        raise ValueError(
            f"inputs of shape {inputs.shape}; expected (samples, steps, {str(wanted)[1:-1]})"
        )
    outputs, spikes = [], []
    for start in range(0, len(inputs), AT_ONCE):
        signal, spiked = inputs[start : start + AT_ONCE].astype(float), {}
        for node in network.nodes:
            signal = run_node(node, signal, step, method, reset)
            if node.kind in SPIKING:
                spiked[node.name] = signal.astype(bool)
        outputs.append(signal)
        spikes.append(spiked)
    names = [node.name for node in network.nodes if node.kind in SPIKING]
    if not outputs:
        raise ValueError("no samples to simulate")
    return Simulated(
        np.concatenate(outputs), {n: np.concatenate([part[n] for part in spikes]) for n in names}
    )


def check_step(network: NirNetwork, step: float):
    """Refuse a step that is longer than a time constant.

    Raises
    ------
    NirError
        A time constant is shorter; the message names the node.
    """
    for node in network.nodes:
        for name in ("tau", "tau_syn", "tau_mem"):
            if name in node.parameters:
                shortest = float(node[name].min())
                if shortest < step * (1 - 1e-6):
                    raise NirError(
                        f"{node}: a {name} of {shortest:.3g} s is shorter than the step of "
                        f"{step:.3g} s; give a shorter one with --step (in milliseconds), or the "
                        "step that the graph was written for with --set nir.step"
                    )


def run_node(
    node: Node, signal, step: float, method: str = "exact", reset: str = "value"
) -> np.ndarray:
    """The output of a node for a signal over time, from rest.

    Parameters
    ----------
    node : Node
    signal : ndarray of float, shape (n_samples, steps, ...)
        In the node's input shape.
    step : float
        Length of a step in seconds.
    method, reset : str
        As for :func:`simulate`.

    Returns
    -------
    ndarray of float, shape (n_samples, steps, ...)
        In the node's shape.
    """
    if node.kind == "Threshold":
        return (signal > node["threshold"]).astype(float)
    if node.kind in SPIKING + FILTERS:
        return _over_time(node, signal, step, method, reset)
    lead = signal.shape[:2]
    flat = signal.reshape(-1, *node.input_shape)
    return _LINEAR[node.kind](node, flat).reshape(*lead, *node.shape)


def apply(node: Node, signal) -> np.ndarray:
    """The output of a node without a state for signals, shape (n, ...); biases are added.

    Raises
    ------
    KeyError
        The node has a state or spikes.
    """
    return _LINEAR[node.kind](node, np.asarray(signal, float)).reshape(len(signal), *node.shape)


def decay(tau, step: float, method: str) -> np.ndarray:
    """Remaining share after a step of a value with time constant ``tau``; both in seconds."""
    return np.exp(-step / tau) if method == "exact" else np.maximum(1 - step / tau, 0.0)


def _over_time(node, signal, step, method, reset):
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
    if reset not in RESETS:
        raise ValueError(f"reset {reset!r} is not one of {', '.join(RESETS)}")
    move, fired = _moved(node, step, method), np.zeros((len(signal), *node.shape), bool)
    rest = node["v_reset"] if node.kind == "IF" else node["v_leak"]
    state = [np.broadcast_to(rest, (len(signal), *node.shape)).copy(), np.zeros(())]
    result = np.empty((*signal.shape[:2], *node.shape))
    for t in range(signal.shape[1]):
        total = signal[:, t].reshape(len(signal), *node.shape)
        if node.loop is not None:
            total = total + apply(node.loop, fired).reshape(total.shape)
        voltage, state[1] = move(*state, total)
        if node.kind in SPIKING:
            fired = voltage > node["v_threshold"]
            voltage = np.where(fired, _after_spike(node, voltage, step, method, reset), voltage)
        result[:, t] = fired if node.kind in SPIKING else voltage
        state[0] = voltage
    return result


def _after_spike(node, voltage, step, method, reset):
    if reset == "value":
        return node["v_reset"]
    taken = node["v_threshold"] - node["v_reset"]
    if reset == "subtract-late" and node.kind != "IF":  # the leak reduces it
        taken = taken / decay(node["tau" if node.kind == "LIF" else "tau_mem"], step, method)
    return voltage - taken


def _moved(node, step, method):
    """``move(v, I, S) -> v, I``: one step, before the reset."""
    r = node["r"]
    if node.kind == "IF":
        return lambda v, i, s: (v + step * r * s, i)
    leak = node["v_leak"]
    if node.kind in ("LI", "LIF"):
        b = decay(node["tau"], step, method)
        return lambda v, i, s: (b * v + (1 - b) * (leak + r * s), i)
    syn, mem, w = node["tau_syn"], node["tau_mem"], node["w_in"]
    a, b = decay(syn, step, method), decay(mem, step, method)
    if method == "euler":

        def euler(v, i, s):
            i = a * i + (1 - a) * w * s
            return b * v + (1 - b) * (leak + r * i), i

        return euler
    same = np.isclose(syn, mem, rtol=1e-9, atol=0)
    k = np.where(same, step * b / mem, syn * (a - b) / np.where(same, 1.0, syn - mem))

    def exact(v, i, s):
        v = b * v + (1 - b) * (leak + r * w * s) + r * (i - w * s) * k
        return v, a * i + (1 - a) * w * s

    return exact


# --- nodes without a state, on signals of shape (n, ...) ------------------------------------------


def _affine(node, signal):
    return signal.reshape(len(signal), -1) @ node["weight"].T + node["bias"]


def _convolution(node, signal):
    weight = node["weight"]
    dimensions, groups = weight.ndim - 2, node["groups"]
    seen = _windows(signal, weight.shape[2:], node["stride"], node["padding"], node["dilation"])
    parts = []
    for group, kernel in enumerate(np.split(weight, groups)):
        channels = slice(group * weight.shape[1], (group + 1) * weight.shape[1])
        axes = (1, *range(2 + dimensions, 2 + 2 * dimensions))
        of_kernel = tuple(range(1, 2 + dimensions))
        parts.append(np.moveaxis(np.tensordot(seen[:, channels], kernel, (axes, of_kernel)), -1, 1))
    return np.concatenate(parts, 1) + node["bias"].reshape(-1, *(1,) * dimensions)


def _windows(signal, kernel, stride, padding, dilation):
    """Views of windows, shape (n, channels, *places, *kernel)."""
    n = len(kernel)
    reach = [(k - 1) * d + 1 for k, d in zip(kernel, dilation, strict=True)]
    padded = np.pad(signal, ((0, 0), (0, 0), *padding))
    seen = np.lib.stride_tricks.sliding_window_view(padded, reach, tuple(range(2, 2 + n)))
    steps = (*(slice(None, None, s) for s in stride), *(slice(None, None, d) for d in dilation))
    return seen[(slice(None), slice(None), *steps)]


def _pool(node, signal):
    seen = _windows(signal, node["kernel_size"], node["stride"], node["padding"], (1, 1))
    return seen.mean((-2, -1)) if node.kind == "AvgPool2d" else seen.sum((-2, -1))


_LINEAR = {
    "Affine": _affine,
    "Linear": _affine,
    "Conv1d": _convolution,
    "Conv2d": _convolution,
    "SumPool2d": _pool,
    "AvgPool2d": _pool,
    "Flatten": lambda node, signal: signal,
    "Scale": lambda node, signal: signal * node["scale"],
}
