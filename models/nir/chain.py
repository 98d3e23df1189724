"""A NIR graph as a chain of links, each with one linear map and one type of neuron.

A step of the chip's neuron, in units of its threshold (:mod:`models.spiking` has it in integers):

    u <- keep_u u + W s,      v <- keep_v v + u + bias,      a spike where v > 1, and v = 0 there

All nodes from one layer of neurons to the next become W and bias; the neurons' own parameters are
folded in.  A neuron's step (:mod:`models.nir.equations`) has the same form, with theta =
v_threshold - v_reset, voltages relative to v_reset, and M and c the linear map before the neurons:

=========  ====================================================================================
LIF, IF    keep_u = 0,  W = v_from_s M / theta,
           bias = (v_from_s c + added - (1 - keep_v) v_reset) / theta.  This is exact.
           The chip's leak is at least 1/4096 per step: an IF's voltage loses 5 % in 200 steps.
CubaLIF    keep_u = keep_i,  W = (1 - keep_i) input_sum M / theta, bias as LIF with input_sum.
           Exact for Norse, Rockpool, Spyx and for Euler steps, whose only difference is that c
           passes the filter from a sample's start on, whereas here it is constant.  With exact
           steps the change of the current within a step is ignored; its sum over time is the same.
Threshold  keep_v = 0 (on the chip 2/4096),  W = M / threshold,  bias = c / threshold.
LI         before a layer's neurons: keep_u = keep_v, W times v_from_s; the steady-state
           contribution of v_leak and c is in the bias.  At the end of a graph: a low-pass on the
           host.
CubaLI     at the end of a graph only: the low-pass with the longer time constant, on the host.  The
           shorter one is left out, which shifts the outputs in time but does not change their sum.
=========  ====================================================================================

Integers cause further differences: weights have 8 bits, with one scale for each layer, and those of
recurrent layers are the sum of two such; decays have 12 bits; current and voltage are truncated to
whole numbers at each step.  keep_u is at least 1/4096.

A layer has one time constant of the voltage and one of the current.  A convolution whose windows
the chip supports remains a convolution (:mod:`models.nir.windows`).  All other maps become a
matrix, which takes more of a core's memory and is otherwise equivalent.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from deploy import limits
from deploy.network.chip import LOIHI
from models.chain import Link, NeuronDecays
from models.nir.equations import METHODS
from models.nir.errors import NirError
from models.nir.graph import NirNetwork
from models.nir.nodes import FILTERS, SPIKING
from models.nir.simulator import apply_node, require_short_step
from models.nir.windows import find_window
from models.ops import Convolution, Dense
from models.windows import fit_window_to_chip


def from_nir(
    network: NirNetwork, step_s: float, method: str = "exact", input_shape=None, readout_steps=None
) -> tuple:
    """Convert a graph to a chain.

    Parameters
    ----------
    network : NirNetwork
    step_s : float
        Seconds of the graph's time that a step of the chip represents.
    method : str
        One of :data:`models.nir.equations.METHODS`.
    input_shape : tuple of int, optional
        (rows, columns, channels) of the chip's input, if the graph's input is flat (channels first,
        then rows, then columns).  Its two channels are one of a graph with half as many inputs, for
        which events of both polarities are the same.
    readout_steps : range, optional
        Steps of a sample in which the readout is averaged.  A readout behind a filter has the
        graph's mean bias in these steps, since that of the host is the same at each step; by
        default it has the bias that the graph reaches.

    Returns
    -------
    tuple of Link
        Their neurons are given by :class:`models.chain.NeuronDecays`; the last one is called
        ``"output"``.

    Raises
    ------
    NirError
        A node cannot be on the chip; the message names it and an alternative.
    """
    require_short_step(network, step_s, method)
    shape = network.input_shape
    chip_shape = _to_channels_last(shape) if input_shape is None else tuple(input_shape)
    merged = merges_polarities(network, chip_shape)
    if merged:
        chip_shape = (*chip_shape[:2], 1)
    is_same_image = len(shape) != 3 or chip_shape == _to_channels_last(shape)
    if math.prod(chip_shape) != math.prod(shape) or not is_same_image:
        raise NirError(
            f"is for an input of {_format_shape(shape)}, and that of the chip is "
            f"{_format_shape(chip_shape)} (rows, columns, channels)"
        )
    before = shape if input_shape is None else (chip_shape[2], *chip_shape[:2])
    is_image = len(shape) == 3
    groups = _split_after_neurons(network.nodes)
    layers = []
    counts: Counter = Counter()
    for index, nodes in enumerate(groups):
        is_last = index == len(groups) - 1
        nodes_of_link = _LinkNodes(
            nodes,
            before,
            chip_shape,
            is_image=is_image and not is_last,
            is_last=is_last,
            step_s=step_s,
            method=method,
        )
        link = nodes_of_link.make_link(readout_steps)
        counts[link.kind] += 1
        name = "output" if is_last else f"{link.kind}{counts[link.kind]}"
        layers.append(replace(link, name=name))
        before = nodes[-1].shape
        chip_shape = link.shape
        is_image = len(chip_shape) == 3
    if merged:
        first = layers[0]
        # The input's channels are the last axis but one of every kernel: of a convolution's windows
        # (rows, columns, channels, filters), and of a matrix, whose inputs have channels innermost.
        kernel = np.repeat(first.kernel, 2, axis=-2)
        layers[0] = replace(first, input_shape=(*first.input_shape[:2], 2), kernel=kernel)
    return tuple(layers)


def merges_polarities(network: NirNetwork, chip_shape) -> bool:
    """True for a graph with one input for both polarities of each taxel.

    Parameters
    ----------
    network : NirNetwork
    chip_shape : tuple of int
        (rows, columns, channels) of the sensor's events.
    """
    return tuple(chip_shape[2:]) == (2,) and math.prod(chip_shape) == 2 * math.prod(
        network.input_shape
    )


def _split_after_neurons(nodes) -> list:
    """The nodes up to and including each layer of neurons, and those after the last."""
    groups: list[list] = [[]]
    for node in nodes:
        groups[-1].append(node)
        if node.kind in SPIKING:
            groups.append([])
    return [group for group in groups if group]


@dataclass(frozen=True)
class _InputEffect:
    """How an input changes the voltages of a layer, in units of the thresholds.

    Attributes
    ----------
    once : ndarray
        What an input of 1 adds in its step.
    constant : ndarray
        What a constant input of 1 adds in each step.
    added : ndarray
        What is added in each step without an input.
    keep_u, keep_v : float
        Shares of current and voltage that remain after a step.
    """

    once: np.ndarray
    constant: np.ndarray
    added: np.ndarray
    keep_u: float = 0.0
    keep_v: float = 0.0


@dataclass(frozen=True)
class _LinkNodes:
    """The nodes of the graph that become one link.

    Attributes
    ----------
    nodes : list of Node
    before : tuple of int
        Shape of their input in the graph.
    chip_shape : tuple of int
        Shape of their input on the chip.
    is_image : bool
        True if the link may be a convolution.
    is_last : bool
        True for the nodes after the last layer of neurons.
    step_s : float
    method : str
        As for :func:`from_nir`.
    """

    nodes: list
    before: tuple
    chip_shape: tuple
    is_image: bool
    is_last: bool
    step_s: float
    method: str

    @property
    def neuron(self):
        return self.nodes[-1] if self.nodes[-1].kind in SPIKING else None

    @property
    def maps(self):
        return self.nodes if self.neuron is None else self.nodes[:-1]

    @property
    def shape(self):
        return self.nodes[-1].shape

    def solve(self, node):
        """The equation of a node's step."""
        return METHODS[self.method](node, self.step_s)

    def make_link(self, readout_steps) -> Link:
        """The link, still without a name."""
        filters = self.find_filter()
        effect = self.find_input_effect()
        loop = None if self.neuron is None else self.neuron.loop
        keep_u = effect.keep_u
        once = effect.once
        if filters:
            keep_u = self.find_remaining_share(filters[0])
            once = once if self.neuron is None else once * (1 - keep_u)
        maps = [self.replace_filter(node) for node in self.maps]
        offset = _pass_through(maps, np.zeros((1, *self.before)))[0]
        constant = offset if loop is None else offset + loop["bias"].reshape(self.shape)
        bias = (effect.added + effect.constant * constant).ravel()
        neuron = None if self.neuron is None else NeuronDecays(keep_u, effect.keep_v)
        common: dict[str, Any] = {  # arguments of every link
            "name": "",
            "neurons": neuron,
            "input_shape": self.chip_shape,
            "sources": tuple(node.name for node in self.nodes),
        }
        if neuron is None and filters:
            if keep_u > 0:
                common["synapse"] = float(-LOIHI.dt / np.log(keep_u))
            if readout_steps is not None:
                bias = self.average_bias(bias, maps, filters[0], keep_u, readout_steps)
        if self.is_image and loop is None and len(self.shape) == 3:
            windows = self.find_windows(once, bias)
            if windows is not None:
                return Link(**windows, **common)
        return self.make_dense(maps, offset, once, bias, loop, common)

    def find_filter(self) -> list:
        """The filter before the neurons, if there is one; the chip has no second."""
        filters = [node for node in self.maps if node.kind in FILTERS]
        neuron = self.neuron
        if neuron is not None:
            for node in filters:
                if node.kind == "CubaLI":
                    raise NirError(
                        f"{node}: has two filters before neurons, and the chip has one; use LI, or "
                        "CubaLIF neurons with its time constant"
                    )
        if len(filters) + (neuron is not None and neuron.kind == "CubaLIF") > 1:
            raise NirError(
                f"{filters[-1]}: a second filter before the same neurons; the chip has one, so use "
                "LIF in place of CubaLIF, or leave one out"
            )
        if filters and neuron is not None and neuron.loop is not None:
            raise NirError(
                f"{filters[0]}: a filter before a layer that is connected to itself filters only a "
                "part of its input, and the chip filters all of it; use CubaLIF neurons"
            )
        return filters

    def find_remaining_share(self, node) -> float:
        """The share that remains in a filter; of two time constants the longer one's."""
        equation = self.solve(node)
        keep = np.maximum(equation.keep_v, equation.keep_i)
        return _require_equal(node, keep, "time constants")

    def find_input_effect(self) -> _InputEffect:
        """What an input adds to the neurons' voltage."""
        neuron = self.neuron
        if neuron is None:
            ones = np.ones(self.shape)
            return _InputEffect(ones, ones, np.zeros(self.shape))
        if neuron.kind == "Threshold":
            per_input = 1 / neuron["threshold"]
            return _InputEffect(per_input, per_input, np.zeros(self.shape))
        equation = self.solve(neuron)
        theta = neuron["v_threshold"] - neuron["v_reset"]
        keep_v = _require_equal(neuron, equation.keep_v, "membrane time constants")
        keep_u = 0.0
        if neuron.kind == "CubaLIF":
            keep_u = _require_equal(neuron, equation.keep_i, "synaptic time constants")
        constant = equation.input_sum / theta
        added = (equation.added - (1 - equation.keep_v) * neuron["v_reset"]) / theta
        return _InputEffect(constant * (1 - keep_u), constant, added, keep_u, keep_v)

    def replace_filter(self, node):
        """The node itself, or the steady-state response in place of a filter."""
        if node.kind not in FILTERS:
            return node
        equation = self.solve(node)
        parameters = {
            "scale": equation.input_sum / (1 - equation.keep_v),
            "offset": equation.added / (1 - equation.keep_v),
        }
        return replace(node, kind="steady", parameters=parameters)

    def average_bias(self, bias, maps, node, keep, readout_steps):
        """The mean bias of the readout in the steps that it averages.

        t steps after a sample's start the output includes bias - fading keep^t.
        """
        after = maps[self.maps.index(node) + 1 :]
        at_start = np.broadcast_to(node["v_leak"], (1, *node.shape))
        fading = bias - _pass_through(after, at_start)[0].ravel()
        return bias - fading * np.mean(keep ** (np.array(readout_steps) + 1))

    def find_windows(self, weight_scale, bias) -> dict | None:
        """The link's parameters as a convolution, or None if it is none on the chip."""
        channels = self.shape[0]
        weight_scale = weight_scale.reshape(channels, -1)
        bias = bias.reshape(channels, -1)
        if (weight_scale != weight_scale[:, :1]).any():
            return None
        if not np.allclose(bias, bias[:, :1], rtol=1e-12, atol=1e-15):
            return None
        window = find_window(self.maps, self.before, self.find_scale)
        if window is None:
            return None
        fitting = fit_window_to_chip(window, self.before[1:], self.shape[1:])
        if fitting is None:
            return None
        kernel = fitting["weights"] * weight_scale[:, 0]
        return {
            "operation": Convolution(
                kernel.shape[-1], len(kernel), fitting["stride"], fitting["padding"]
            ),
            "kernel": kernel,
            "bias": bias[:, 0].copy(),
            "pool": fitting["pool"],
        }

    def find_scale(self, node):
        """Factors of a node that scales its input."""
        return node["scale"] if node.kind == "Scale" else self.replace_filter(node)["scale"]

    def make_dense(self, maps, offset, weight_scale, bias, loop, common) -> Link:
        """The link with a matrix."""
        outputs = math.prod(self.shape)
        inputs = math.prod(self.before)
        if outputs * inputs > limits.WEIGHTS:
            raise NirError(
                f"{self.nodes[0]}: as a matrix, which its windows need on the chip, it has "
                f"{outputs * inputs} weights, more than {limits.WEIGHTS}; use square kernels, "
                "equal strides, or averaging windows that do not overlap"
            )
        scales = weight_scale.reshape(-1)
        # Its shape is (inputs, outputs).
        matrix = _make_matrix(maps, self.before, offset) * scales
        neurons = np.arange(outputs) if self.is_last else _order_channels_last(self.shape)
        matrix = matrix[_order_channels_last(self.before)][:, neurons]
        if loop is not None:
            recurrent = loop["weight"].T * scales
            common["recurrent_kernel"] = recurrent[np.ix_(neurons, neurons)]
        operation = Dense(outputs, is_output=self.is_last)
        return Link(operation=operation, kernel=matrix, bias=bias[neurons], **common)


def _require_equal(node, keep, parameter) -> float:
    """The value of a parameter that must be equal for all neurons of a layer."""
    low, high = (int(np.rint(LOIHI.decay_unit * k)) for k in (np.min(keep), np.max(keep)))
    if low != high:
        raise NirError(
            f"{node}: its {parameter} differ between neurons, keeping {low} to {high} 4096ths per "
            "step; NengoLoihi has one per layer: train one time constant for all neurons of a layer"
        )
    return float(np.mean(keep))


def _pass_through(nodes, signal):
    for node in nodes:
        signal = signal.reshape(len(signal), *node.input_shape)
        if node.kind == "steady":
            signal = signal * node["scale"] + node["offset"]
        else:
            signal = apply_node(node, signal)
    return signal


def _make_matrix(nodes, before, offset):
    """The map as a matrix (inputs, outputs), channels first on both sides."""
    n = math.prod(before)
    rows = []
    for start in range(0, n, 512):
        units = np.eye(min(512, n - start), n, start).reshape(-1, *before)
        rows.append((_pass_through(nodes, units) - offset).reshape(len(units), -1))
    return np.concatenate(rows)


def _to_channels_last(shape) -> tuple:
    """(rows, columns, channels) of NIR's (channels, rows, columns); a row of channels is one."""
    if len(shape) == 3:
        return (*shape[1:], shape[0])
    if len(shape) == 2:
        return (1, shape[1], shape[0])
    return shape


def _order_channels_last(shape):
    """Indices with channels first of values in the chip's order, which has channels last."""
    if len(shape) == 1:
        return np.arange(shape[0])
    return np.moveaxis(np.arange(math.prod(shape)).reshape(shape), 0, -1).ravel()


def _format_shape(shape):
    return " x ".join(map(str, shape))
