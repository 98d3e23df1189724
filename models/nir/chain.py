"""A NIR graph as a chain of links, each with one linear map and one type of neuron.

A step of the chip's neuron, in units of its threshold (:mod:`models.spiking` has it in integers):

    u <- keep_u u + W s,      v <- keep_v v + u + bias,      a spike where v > 1, and v = 0 there

All nodes from one layer of neurons to the next become W and bias; the neurons' own parameters are
folded in.  Let b be the share of v that remains after a step, a that of I (:func:`decay`, exact or
Euler), theta = v_threshold - v_reset, and M and c the linear map before the neurons.  With all
voltages relative to v_reset:

=========  ====================================================================================
LIF        keep_v = b, keep_u = 0,  W = (1 - b) r M / theta,
           bias = (1 - b) (r c + v_leak - v_reset) / theta.  This is exact.
CubaLIF    keep_v = b, keep_u = a,  W = (1 - a) (1 - b) w_in r M / theta,
           bias = (1 - b) (r w_in c + v_leak - v_reset) / theta.  With Euler steps the only
           difference is that c passes the filter from a sample's start on, whereas here it is
           constant.  With exact steps the change of the current within a step is ignored too; its
           sum over time is the same.
IF         keep_v = 1, keep_u = 0,  W = h r M / theta,  bias = h r c / theta.  The chip's leak is
           at least 1/4096 per step, so that a voltage decreases by 5 % in 200 steps.  Norse adds
           the whole input at each step, which is h = 1 here.
Threshold  keep_v = 0 (on the chip 2/4096),  W = M / threshold,  bias = c / threshold.
LI         before a layer's neurons: keep_u = b, W times (1 - b) r; the steady-state contribution
           of v_leak and c is in the bias.  At the end of a graph: a low-pass on the host.
CubaLI     at the end of a graph only: the low-pass with the longer time constant, on the host.  The
           shorter one is left out, which shifts the outputs in time but does not change their sum.
=========  ====================================================================================

Integers cause further differences: weights have 8 bits, with one scale for each layer; decays have
12 bits; current and voltage are truncated to whole numbers at each step.  keep_u is at least
1/4096.

A layer has one time constant of the voltage and one of the current.  A convolution whose windows
the chip supports remains a convolution, with averaging before or after it folded in.  All other
maps become a matrix, which takes more of a core's memory and is otherwise equivalent.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from deploy import limits
from deploy.network.chip import LOIHI
from deploy.network.geometry import windows
from models.chain import Decays, Link
from models.integers import DECAY_UNIT
from models.nir.graph import FILTERS, SPIKING, NirError, NirNetwork
from models.nir.simulator import apply, check_step, decay


def from_nir(
    network: NirNetwork, step: float, method: str = "exact", input_shape=None, read=None
) -> tuple:
    """Convert a graph to a chain.

    Parameters
    ----------
    network : NirNetwork
    step : float
        Seconds of the graph's time that a step of the chip represents.
    method : str
        Method of integration of the graph's equations; see :mod:`models.nir.simulator`.
    input_shape : tuple of int, optional
        (rows, columns, channels) of the chip's input, if the graph's input is flat (channels first,
        then rows, then columns).  Its two channels are one of a graph with half as many inputs, for
        which events of both polarities are the same.
    read : range, optional
        Steps of a sample in which the readout is averaged.  A readout behind a filter has the
        graph's mean bias in these steps, since that of the host is the same at each step; by
        default it has the bias that the graph reaches.

    Returns
    -------
    tuple of Link
        Their neurons are given by :class:`models.chain.Decays`; the last one is called
        ``"output"``.

    Raises
    ------
    NirError
        A node cannot be on the chip; the message names it and an alternative.
    """
    check_step(network, step)
    groups, run = [], []
    for node in network.nodes:
        run.append(node)
        if node.kind in SPIKING:
            groups.append(run)
            run = []
    if run:
        groups.append(run)
    shape = network.input_shape
    place = _places_first(shape) if input_shape is None else tuple(input_shape)
    if merged := merges_polarities(network, place):
        input_shape = place = (*place[:2], 1)
    place_of_input = place
    as_given = len(shape) != 3 or place == _places_first(shape)
    if math.prod(place) != math.prod(shape) or not as_given:
        raise NirError(
            f"is for an input of {_times(shape)}, and that of the chip is {_times(place)} (rows, "
            "columns, channels)"
        )
    is_image = len(shape) == 3
    before = shape if input_shape is None else (place[2], *place[:2])
    layers, counts = [], {"conv": 0, "dense": 0}
    for index, nodes in enumerate(groups):
        last = index == len(groups) - 1
        layer = _link(nodes, step, method, before, place, is_image, last, read)
        counts[layer.kind] += 1
        layers.append(
            replace(layer, name="output" if last else f"{layer.kind}{counts[layer.kind]}")
        )
        before, place = nodes[-1].shape, layers[-1].shape
        is_image = len(place) == 3
    if merged:
        first = layers[0]
        axis = 2 if first.kind == "conv" else 0
        weights = np.repeat(first.weights, 2, axis)
        layers[0] = replace(first, input_shape=(*place_of_input[:2], 2), weights=weights)
    return tuple(layers)


def merges_polarities(network: NirNetwork, place) -> bool:
    """True for a graph with one input for both polarities of each taxel.

    Parameters
    ----------
    network : NirNetwork
    place : tuple of int
        (rows, columns, channels) of the sensor's events.
    """
    return tuple(place[2:]) == (2,) and math.prod(place) == 2 * math.prod(network.input_shape)


def _link(nodes, step, method, before, place, is_image, last, read) -> Link:
    """One link; ``before`` is the graph's shape of its input and ``place`` the chip's."""
    neuron = nodes[-1] if nodes[-1].kind in SPIKING else None
    between = nodes[:-1] if neuron is not None else nodes
    keeps = []  # (share that remains per step, node) of each filter
    for node in between:
        if node.kind in FILTERS:
            if node.kind == "CubaLI" and neuron is not None:
                raise NirError(
                    f"{node}: has two filters before neurons, and the chip has one; use "
                    "LI, or CubaLIF neurons with its time constant"
                )
            keep = decay(node["tau" if node.kind == "LI" else "tau_mem"], step, method)
            if node.kind == "CubaLI":
                keep = np.maximum(keep, decay(node["tau_syn"], step, method))
            keeps.append((_same(node, keep, "time constants"), node))
    shape = nodes[-1].shape
    gain, bias, keep_u, keep_v = _neuron(neuron, shape, step, method)
    if len(keeps) + (neuron is not None and neuron.kind == "CubaLIF") > 1:
        node = keeps[-1][1]
        raise NirError(
            f"{node}: a second filter before the same neurons; the chip has one, so use LIF in the "
            "place of CubaLIF, or leave one out"
        )
    for keep, _ in keeps:
        keep_u = keep
        if neuron is not None:
            gain = gain * (1 - keep)
    loop = neuron.loop if neuron is not None else None
    if loop is not None and keeps:
        raise NirError(
            f"{keeps[-1][1]}: a filter before a layer that is connected to itself filters only a "
            "part of its input, and the chip filters all of it; use CubaLIF neurons"
        )
    settled = [_settled(node) for node in between]
    offset = _through(settled, np.zeros((1, *before)))[0]
    constant = offset if loop is None else offset + loop["bias"].reshape(shape)
    bias = (bias + _constant_gain(neuron, shape, step, method) * constant).ravel()
    common = {
        "name": "",
        "neuron": None if neuron is None else Decays(keep_u, keep_v),
        "sources": tuple(node.name for node in nodes),
    }
    if neuron is None and keep_u > 0:
        common["tau_syn"] = float(-LOIHI.dt / np.log(keep_u))
    if neuron is None and keeps and read is not None:
        # t steps after a sample's start the output includes bias - fading keep_u^t
        last_filter = between.index(keeps[-1][1])
        at_start = np.broadcast_to(keeps[-1][1]["v_leak"], (1, *keeps[-1][1].shape))
        fading = bias - _through(settled[last_filter + 1 :], at_start)[0].ravel()
        bias = bias - fading * np.mean(keep_u ** (np.array(read) + 1))
    dense = last or loop is not None or not is_image or len(shape) != 3
    window = None if dense else _window(between, before)
    if window is not None:
        fitted = _fitted(window, gain, bias.reshape(shape), before, shape)
        if fitted is not None:
            return Link(kind="conv", input_shape=place, **fitted, **common)
    outputs, inputs = math.prod(shape), math.prod(before)
    if outputs * inputs > limits.WEIGHTS:
        raise NirError(
            f"{nodes[0]}: as a matrix, which its windows need on the chip, it has "
            f"{outputs * inputs} weights, more than {limits.WEIGHTS}; use square kernels, equal "
            "strides, no padding, or averaging windows that do not overlap"
        )
    matrix = _matrix(settled, before, offset) * gain.reshape(-1)  # (inputs, outputs)
    matrix = matrix[_to_places(before)]
    neurons = np.arange(outputs) if last else _to_places(shape)
    matrix, bias = matrix[:, neurons], bias[neurons]
    if loop is not None:
        common["loop"] = (loop["weight"].T * gain.reshape(-1))[np.ix_(neurons, neurons)]
    return Link(
        kind="dense", input_shape=place, shape=(outputs,), weights=matrix, bias=bias, **common
    )


def _neuron(neuron, shape, step, method):
    """(gain of each neuron's input, constant part of its bias, keep_u, keep_v)."""
    if neuron is None:
        return np.ones(shape), np.zeros(shape), 0.0, 0.0
    if neuron.kind == "Threshold":
        return 1 / neuron["threshold"], np.zeros(shape), 0.0, 0.0
    theta = neuron["v_threshold"] - neuron["v_reset"]
    gain = _constant_gain(neuron, shape, step, method)
    if neuron.kind == "IF":
        return gain, np.zeros(shape), 0.0, 1.0
    keep = decay(neuron["tau" if neuron.kind == "LIF" else "tau_mem"], step, method)
    bias = (1 - keep) * (neuron["v_leak"] - neuron["v_reset"]) / theta
    keep_v, keep_u = _same(neuron, keep, "membrane time constants"), 0.0
    if neuron.kind == "CubaLIF":
        keep_u = _same(neuron, decay(neuron["tau_syn"], step, method), "synaptic time constants")
        gain = gain * (1 - keep_u)
    return gain, bias, keep_u, keep_v


def _constant_gain(neuron, shape, step, method):
    """Increase of the voltage at each step by one unit of constant input, in thresholds."""
    if neuron is None:
        return np.ones(shape)
    if neuron.kind == "Threshold":
        return 1 / neuron["threshold"]
    theta = neuron["v_threshold"] - neuron["v_reset"]
    if neuron.kind == "IF":
        return step * neuron["r"] / theta
    if neuron.kind == "LIF":
        return (1 - decay(neuron["tau"], step, method)) * neuron["r"] / theta
    return (1 - decay(neuron["tau_mem"], step, method)) * neuron["r"] * neuron["w_in"] / theta


def _same(node, keep, what) -> float:
    """The value of a parameter that must be equal for all neurons of a layer."""
    low, high = (int(np.rint(DECAY_UNIT * k)) for k in (keep.min(), keep.max()))
    if low != high:
        raise NirError(
            f"{node}: its {what} differ between neurons, keeping {low} to {high} 4096ths per step; "
            "NengoLoihi has one per layer: train one time constant for all neurons of a layer"
        )
    return float(keep.mean())


def _settled(node):
    """A node without memory: a filter is replaced by its steady-state response."""
    if node.kind not in FILTERS:
        return node
    scale = node["r"] * (node["w_in"] if node.kind == "CubaLI" else 1.0)
    return replace(node, kind="settled", parameters={"scale": scale, "offset": node["v_leak"]})


def _through(nodes, signal):
    for node in nodes:
        signal = signal.reshape(len(signal), *node.input_shape)
        if node.kind == "settled":
            signal = signal * node["scale"] + node["offset"]
        else:
            signal = apply(node, signal)
    return signal


def _matrix(nodes, before, offset):
    """The map as a matrix (inputs, outputs), channels first on both sides."""
    n = math.prod(before)
    rows = []
    for start in range(0, n, 512):
        part = np.eye(min(512, n - start), n, start).reshape(-1, *before)
        rows.append((_through(nodes, part) - offset).reshape(len(part), -1))
    return np.concatenate(rows)


def _places_first(shape) -> tuple:
    """(rows, columns, channels) of NIR's (channels, rows, columns); a row of channels is one."""
    if len(shape) == 3:
        return (*shape[1:], shape[0])
    if len(shape) == 2:
        return (1, shape[1], shape[0])
    return shape


def _to_places(shape):
    """Indices with channels first of values in the chip's order, which has channels last."""
    if len(shape) == 1:
        return np.arange(shape[0])
    return np.moveaxis(np.arange(math.prod(shape)).reshape(shape), 0, -1).ravel()


def _times(shape):
    return " x ".join(map(str, shape))


# --- convolutions ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Window:
    """The inputs of each output: a kernel (filters, channels, rows, columns) on a grid of windows.

    ``pool`` is a square of values that are averaged before; ``scale`` one a channel of the input.
    """

    kernel: np.ndarray
    stride: tuple
    before: tuple
    pool: int = 1


def _window(nodes, shape):
    """The map as windows, or None if it has another form."""
    window, pool = None, 1
    scale = np.ones(shape[0])
    for node in nodes:
        kind = node.kind
        if kind in ("LI", "CubaLI", "Scale"):
            factor = node["scale"] if kind == "Scale" else node["r"]
            by_channel = factor.reshape(factor.shape[0], -1)
            if (by_channel != by_channel[:, :1]).any():
                return None
            if window is None:
                scale = scale * by_channel[:, 0]
            else:
                kernel = window.kernel * by_channel[:, 0, None, None, None]
                window = replace(window, kernel=kernel)
        elif kind == "Conv2d":
            if window is not None:
                return None
            window = _Window(_dense_kernel(node), node["stride"],
                             tuple(p[0] for p in node["padding"]), pool)  # fmt: skip
        elif kind in ("AvgPool2d", "SumPool2d"):
            size, stride = node["kernel_size"], node["stride"]
            if any(map(any, node["padding"])):
                return None
            share = 1 / math.prod(size) if kind == "AvgPool2d" else 1.0
            if window is None and pool == 1 and size == stride and size[0] == size[1]:
                pool = size[0]
                scale = scale * share * pool**2
            elif window is not None:
                window = _pooled(window, size, stride, share)
            else:
                return None
        else:
            return None
    if window is None:
        window = _Window(np.eye(shape[0])[:, :, None, None], (1, 1), (0, 0), pool)
    return replace(window, kernel=window.kernel * scale[:, None, None])


def _dense_kernel(node):
    """A convolution's kernel without groups and dilation."""
    weight, groups, dilation = node["weight"], node["groups"], node["dilation"]
    filters, channels, *size = weight.shape
    reach = [(k - 1) * d + 1 for k, d in zip(size, dilation, strict=True)]
    kernel = np.zeros((filters, channels * groups, *reach))
    per_group = filters // groups
    for group in range(groups):
        of_group = slice(group * per_group, (group + 1) * per_group)
        into = slice(group * channels, (group + 1) * channels)
        kernel[of_group, into, :: dilation[0], :: dilation[1]] = weight[of_group]
    return kernel


def _pooled(window, size, stride, share):
    """Windows of sums over windows: a larger kernel with larger steps."""
    kernel = 0.0
    for row in range(size[0]):
        for column in range(size[1]):
            above, left = row * window.stride[0], column * window.stride[1]
            below = (size[0] - 1) * window.stride[0] - above
            right = (size[1] - 1) * window.stride[1] - left
            kernel = kernel + np.pad(window.kernel, ((0, 0), (0, 0), (above, below), (left, right)))
    steps = tuple(a * b for a, b in zip(window.stride, stride, strict=True))
    return replace(window, kernel=kernel * share, stride=steps)


def _fitted(window, gain, bias, before, shape):
    """Parameters of a link of windows, or None if the chip has other windows."""
    flat_gain, flat_bias = (a.reshape(shape[0], -1) for a in (gain, bias))
    if (flat_gain != flat_gain[:, :1]).any() or not np.allclose(
        flat_bias, flat_bias[:, :1], rtol=1e-12, atol=1e-15
    ):
        return None
    if window.stride[0] != window.stride[1]:
        return None
    stride, sizes = window.stride[0], [n // window.pool for n in before[1:]]
    square = _square(window.kernel, sizes, shape[1:], stride, window.before)
    if square is None:
        return None
    kernel, padding = square
    weights = kernel.transpose(2, 3, 1, 0) * flat_gain[:, 0]
    return {
        "shape": (*shape[1:], shape[0]),
        "weights": weights,
        "bias": flat_bias[:, 0].copy(),
        "stride": stride,
        "pool": window.pool,
        "padding": padding,
    }


def _square(kernel, sizes, counts, stride, before):
    """The kernel made square with zeros so that its windows are the chip's, and their padding."""
    reach = kernel.shape[2:]
    for padding in ("valid", "same"):
        for side in range(max(reach), max(reach) + max(*reach, 4) + 1):
            chips = [windows(n, side, stride, padding) for n in sizes]
            front = [zeros - b for (_, zeros, _), b in zip(chips, before, strict=True)]
            back = [side - k - f for k, f in zip(reach, front, strict=True)]
            if [c[0] for c in chips] == list(counts) and min(*front, *back) >= 0:
                return np.pad(kernel, ((0, 0), (0, 0), *zip(front, back, strict=True))), padding
    return None
