"""Simulation of a NIR graph in NumPy and double precision: the reference for its conversion.

A step's equations are those of :mod:`models.nir.equations`; which of them, and how long a step is,
tells the graph's convention (:mod:`models.nir.conventions`) unless it is given.  Spikes are
detected at the ends of steps, and have a height of 1 for one step.  Neurons begin at rest,
v = v_leak and I = 0 (IF: v = v_reset).  A layer that is connected to itself receives its spikes of
the step before; NIR leaves this open.

NIR resets to v_reset, and so does the chip.  Some packages train with a reset by subtraction, which
a graph does not record; the effect can be measured with :data:`RESETS`.
"""

import math
from dataclasses import dataclass

import numpy as np

from models.nir.equations import METHODS
from models.nir.errors import NirError
from models.nir.graph import NirNetwork
from models.nir.nodes import FILTERS, SPIKING, Node

# Effect of a spike on v: set it to v_reset, as in NIR; subtract v_threshold - v_reset; do so in
# the next step, after the leak, as snnTorch's ``subtract`` does by default; or, as sinabs and
# Rockpool do by default, spike as often in a step as it can be subtracted, and subtract all.
RESETS = ("value", "subtract", "subtract-late", "subtract-all")

# Samples that are simulated together, which bounds the memory.
SAMPLES_AT_ONCE = 50


@dataclass(frozen=True)
class GraphOutputs:
    """The outputs of a graph.

    Attributes
    ----------
    outputs : ndarray, shape (n_samples, steps, ...)
        Outputs of the last node: spikes, 0 or 1, or values.
    spikes : dict of str to ndarray of bool, shape (n_samples, steps, ...)
        Spikes of each spiking node, by its name; numbers of spikes with ``subtract-all``.
    """

    outputs: np.ndarray
    spikes: dict


def simulate(
    network: NirNetwork,
    inputs,
    step: float | None = None,
    method: str = "auto",
    reset: str = "auto",
) -> GraphOutputs:
    """Run a graph on inputs, each sample from rest.

    Parameters
    ----------
    network : NirNetwork
    inputs : array_like, shape (n_samples, steps, ...)
        Input at each step, in the shape of ``network.input_shape`` or flat.
    step : float, optional
        Seconds of the graph's time in a step; by default that of the graph's convention.
    method : str
        One of :data:`models.nir.equations.METHODS`, or ``"auto"``: that of the convention.
    reset : str
        One of :data:`RESETS`, or ``"auto"``: that of the convention.

    Raises
    ------
    NirError
        A time constant is shorter than an Euler step.
    ValueError
        There are no samples, they do not have the shape of the graph's input, a value is not
        finite, the step is not positive, or the graph has none and none is given.
    """
    convention = network.convention
    step_s = convention.step_s if step is None else step
    method = convention.method if method == "auto" else method
    reset = convention.reset if reset == "auto" else reset
    inputs = np.asarray(inputs)
    if step_s is None:
        raise ValueError("the graph has seconds and no step: give the step in seconds")
    if not (0 < step_s < math.inf and np.isfinite(inputs).all()):
        raise ValueError("the step is not positive, or an input not finite")
    require_short_step(network, step_s, method)
    shape = inputs.shape[2:]
    expected = tuple(network.input_shape)
    one_is_flat = min(len(shape), len(expected)) == 1 and math.prod(shape) == math.prod(expected)
    if shape != expected and not one_is_flat:
        raise ValueError(
            f"inputs of shape {inputs.shape}; expected (samples, steps, {str(expected)[1:-1]})"
        )
    if not len(inputs):
        raise ValueError("no samples to simulate")
    outputs = []
    names = [node.name for node in network.nodes if node.kind in SPIKING]
    spikes: dict[str, list] = {name: [] for name in names}
    for start in range(0, len(inputs), SAMPLES_AT_ONCE):
        signal = inputs[start : start + SAMPLES_AT_ONCE].astype(float)
        for node in network.nodes:
            signal = run_node(node, signal, step_s, method, reset, convention.at_threshold)
            if node.kind in SPIKING:
                is_count = reset == "subtract-all"
                spikes[node.name].append(signal.astype(np.int32 if is_count else bool))
        outputs.append(signal)
    joined = {name: np.concatenate(batches) for name, batches in spikes.items()}
    return GraphOutputs(np.concatenate(outputs), joined)


def require_short_step(network: NirNetwork, step_s: float, method: str):
    """Refuse Euler steps that are longer than a time constant.

    Raises
    ------
    NirError
        A time constant is shorter; the message names the node.
    """
    for node in network.nodes if method in ("euler", "norse", "spyx") else ():
        for name in ("tau", "tau_syn", "tau_mem"):
            shortest = float(np.min(node.parameters.get(name, math.inf)))
            if shortest < step_s * (1 - 1e-6):
                raise NirError(
                    f"{node}: a {name} of {shortest:.3g} s is shorter than the step of "
                    f"{step_s:.3g} s, and Euler's method needs a step that is not longer than it; "
                    "give the graph's step in milliseconds with --set nir.step"
                )


def run_node(
    node: Node,
    signal,
    step_s: float,
    method: str = "exact",
    reset: str = "value",
    at_threshold: bool = False,
) -> np.ndarray:
    """The output of a node for a signal over time, from rest.

    Parameters
    ----------
    node : Node
    signal : ndarray of float, shape (n_samples, steps, ...)
        In the node's input shape.
    step_s : float
        Length of a step in seconds.
    method, reset : str
        One of :data:`models.nir.equations.METHODS`, one of :data:`RESETS`.
    at_threshold : bool
        A neuron spikes when it reaches its threshold, not only above it.

    Returns
    -------
    ndarray of float, shape (n_samples, steps, ...)
        In the node's shape.
    """
    if node.kind == "Threshold":
        return (signal > node["threshold"]).astype(float)
    if node.kind in SPIKING + FILTERS:
        return _run_over_time(node, signal, step_s, method, reset, at_threshold)
    lead = signal.shape[:2]
    flat = signal.reshape(-1, *node.input_shape)
    return apply_node(node, flat).reshape(*lead, *node.shape)


def apply_node(node: Node, signal) -> np.ndarray:
    """The output of a node without a state for signals, shape (n, ...); biases are added.

    Raises
    ------
    KeyError
        The node has a state or spikes.
    """
    return _LINEAR[node.kind](node, np.asarray(signal, float)).reshape(len(signal), *node.shape)


def _run_over_time(node, signal, step_s, method, reset, at_threshold):
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
    if reset not in RESETS:
        raise ValueError(f"reset {reset!r} is not one of {', '.join(RESETS)}")
    equation = METHODS[method](node, step_s)
    spiking = node.kind in SPIKING
    shape = (len(signal), *node.shape)
    spikes = np.zeros(shape)
    current = np.zeros(shape)
    voltage = np.broadcast_to(node["v_reset" if node.kind == "IF" else "v_leak"], shape)
    result = np.empty((*signal.shape[:2], *node.shape))
    for t in range(signal.shape[1]):
        total = signal[:, t].reshape(shape)
        if node.loop is not None:
            total = total + apply_node(node.loop, spikes).reshape(shape)
        voltage = equation.keep_v * voltage + equation.v_from_s * total + equation.added
        voltage = voltage + equation.v_from_i * current
        current = equation.keep_i * current + equation.i_from_s * total
        if spiking:
            spikes = _count_spikes(node, voltage, reset, at_threshold)
            voltage = _reset_voltage(node, voltage, spikes, equation, reset)
        result[:, t] = spikes if spiking else voltage
    return result


def _count_spikes(node, voltage, reset, at_threshold):
    """0 or 1; with ``subtract-all`` the number of spikes in a step."""
    if reset == "subtract-all":
        height = node["v_threshold"] - node["v_reset"]
        return np.maximum(np.floor((voltage - node["v_reset"]) / height), 0.0)
    exceeds = np.greater_equal if at_threshold else np.greater
    return exceeds(voltage, node["v_threshold"]).astype(float)


def _reset_voltage(node, voltage, spikes, equation, reset):
    """The voltage after the spikes."""
    if reset == "value":
        return np.where(spikes > 0, node["v_reset"], voltage)
    height = node["v_threshold"] - node["v_reset"]
    if reset == "subtract-late":  # the leak reduces it
        height = height / np.maximum(equation.keep_v, 1e-300)
    voltage = voltage - spikes * height
    if reset == "subtract-all" and node.kind == "IF":
        # sinabs reads an IF with this lower limit, and its from_model converts with it.
        voltage = np.maximum(voltage, -node["v_threshold"])
    return voltage


# --- nodes without a state, on signals of shape (n, ...) ------------------------------------------


def _compute_affine(node, signal):
    return signal.reshape(len(signal), -1) @ node["weight"].T + node["bias"]


def _compute_convolution(node, signal):
    weight = node["weight"]
    images = signal.reshape(len(signal), weight.shape[1], -1, node.input_shape[-1])
    windows = _view_windows(images, weight.shape[2:], node["stride"], node["padding"])
    sums = np.tensordot(windows, weight, ((1, 4, 5), (1, 2, 3)))
    return np.moveaxis(sums, -1, 1) + node["bias"][:, None, None]


def _view_windows(images, size, stride, padding):
    """Views of windows, shape (n, channels, windows down, windows across, *size)."""
    padded = np.pad(images, ((0, 0), (0, 0), *padding))
    windows = np.lib.stride_tricks.sliding_window_view(padded, size, (2, 3))
    return windows[:, :, :: stride[0], :: stride[1]]


def _pool(node, signal):
    windows = _view_windows(signal, node["kernel_size"], node["stride"], node["padding"])
    return windows.mean((-2, -1)) if node.kind == "AvgPool2d" else windows.sum((-2, -1))


_LINEAR = {
    "Affine": _compute_affine,
    "Linear": _compute_affine,
    "Conv1d": _compute_convolution,
    "Conv2d": _compute_convolution,
    "SumPool2d": _pool,
    "AvgPool2d": _pool,
    "Flatten": lambda node, signal: signal,
    "Reshape": lambda node, signal: signal,
    "Identity": lambda node, signal: signal,
    "Scale": lambda node, signal: signal * node["scale"],
}
