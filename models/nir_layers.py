"""Conversion of a NIR graph to layers of the chip, each with one linear map and one type of neuron.

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

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from deploy import limits
from deploy.network.geometry import windows
from models.integers import (
    BIAS_MANTISSA,
    DECAY_UNIT,
    MAX_THRESHOLD,
    THRESHOLD_UNIT,
    WEIGHT_LEVELS,
    WEIGHT_UNIT,
    Integers,
)
from models.nir_graph import FILTERS, SPIKING, NirError, NirNetwork
from models.nir_simulator import apply, check_step, decay

LEAST_KEEP_U, LEAST_KEEP_V, MOST_KEEP = 1, 2, DECAY_UNIT - 1
"""In 4096ths."""

FLOOR = -(2**23) + 1
"""The chip's lowest voltage, since NIR has none."""

CLIPS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)
"""Shares of a layer's largest weight that may become 127; larger weights are clipped."""

MOMENTS_EVERY = 4
"""Interval in steps at which inputs are sampled for the rounding of weights."""

DAMPING = 0.01
"""Added to the diagonal of the moments, in units of its mean."""

MOST_MOMENTS = 2000
"""Maximum number of inputs of a neuron for which the rounding of weights is compensated."""

MAX_BIAS = BIAS_MANTISSA * 2**7
WEIGHT_EXPONENTS = 8


@dataclass(frozen=True)
class NirLayer:
    """A layer of neurons, or the readout, with real numbers.

    Attributes
    ----------
    name : str
        ``"conv1"``, ``"dense1"``, ..., ``"output"``.
    nodes : tuple of str
        Names of the graph's nodes that the layer represents.
    spiking : bool
        False for a readout on the host.
    kind : str
        ``"conv"`` or ``"dense"``.
    input_shape, shape : tuple of int
        (rows, columns, channels), or (values,).
    weights : ndarray
        (rows, columns, channels in, filters), or (inputs, units): contribution of a spike to the
        current, in units of the threshold; for a readout, to the output.
    bias : ndarray, shape (filters,) or (units,)
        Added to the voltage at each step; for a readout, to the output.
    keep_u, keep_v : float
        Shares of current and voltage that remain after a step; for a readout keep_u is that of its
        low-pass.
    stride, pool : int
    padding : str
        As in :class:`deploy.network.spec.Layer`.
    fading : ndarray or float
        For a readout with a filter: the part of the bias that passes the filter.  t steps after a
        sample's start the output includes ``bias - fading * keep_u**t``.
    """

    name: str
    nodes: tuple
    spiking: bool
    kind: str
    input_shape: tuple
    shape: tuple
    weights: np.ndarray = field(repr=False)
    bias: np.ndarray = field(repr=False)
    keep_u: float = 0.0
    keep_v: float = 0.0
    stride: int = 1
    pool: int = 1
    padding: str = "valid"
    fading: np.ndarray = field(default=0.0, repr=False)

    def __str__(self):
        return f"layer {self.name} (nodes {', '.join(self.nodes)})"

    @property
    def size(self) -> int:
        """Number of neurons or outputs."""
        return math.prod(self.shape)


def layers_of(network: NirNetwork, step: float, method: str = "exact", input_shape=None) -> tuple:
    """Convert a graph to layers.

    Parameters
    ----------
    network : NirNetwork
    step : float
        Seconds of the graph's time that a step of the chip represents.
    method : str
        Method of integration of the graph's equations; see :mod:`models.nir_simulator`.
    input_shape : tuple of int, optional
        (rows, columns, channels) of the chip's input, if the graph's input is flat (channels first,
        then rows, then columns).

    Returns
    -------
    tuple of NirLayer
        The last one is called ``"output"``.

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
        layer = _layer(nodes, step, method, before, place, is_image, last)
        counts[layer.kind] += 1
        layers.append(
            replace(layer, name="output" if last else f"{layer.kind}{counts[layer.kind]}")
        )
        before, place = nodes[-1].shape, layers[-1].shape
        is_image = len(place) == 3
    return tuple(layers)


def _layer(nodes, step, method, before, place, is_image, last) -> NirLayer:
    """One layer; ``before`` is the graph's shape of its input and ``place`` the chip's."""
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
    settled = [_settled(node) for node in between]
    zero = np.zeros((1, *before))
    offset = _through(settled, zero)[0]
    bias = (bias + _constant_gain(neuron, shape, step, method) * offset).ravel()
    common = {"name": "", "nodes": tuple(n.name for n in nodes), "spiking": neuron is not None,
              "keep_u": keep_u, "keep_v": keep_v}  # fmt: skip
    if neuron is None and keeps:
        last_filter = between.index(keeps[-1][1])
        at_start = np.broadcast_to(keeps[-1][1]["v_leak"], (1, *keeps[-1][1].shape))
        common["fading"] = bias - _through(settled[last_filter + 1 :], at_start)[0].ravel()
    dense = last or not is_image or len(shape) != 3
    window = None if dense else _window(between, before)
    if window is not None:
        fitted = _fitted(window, gain, bias.reshape(shape), before, shape)
        if fitted is not None:
            return NirLayer(kind="conv", input_shape=place, **fitted, **common)
    outputs, inputs = math.prod(shape), math.prod(before)
    if outputs * inputs > limits.WEIGHTS:
        raise NirError(
            f"{nodes[0]}: as a matrix, which its windows need on the chip, it has "
            f"{outputs * inputs} weights, more than {limits.WEIGHTS}; use square kernels, equal "
            "strides, no padding, or averaging windows that do not overlap"
        )
    matrix = _matrix(settled, before, offset) * gain.reshape(-1)  # (inputs, outputs)
    matrix = matrix[_to_places(before)]
    if not last:
        neurons = _to_places(shape)
        matrix, bias = matrix[:, neurons], bias[neurons]
    return NirLayer(kind="dense", input_shape=place, shape=(outputs,), weights=matrix, bias=bias,
                    **common)  # fmt: skip


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
    """Parameters of a :class:`NirLayer` of windows, or None if the chip has other windows."""
    flat_gain, flat_bias = (a.reshape(shape[0], -1) for a in (gain, bias))
    if (flat_gain != flat_gain[:, :1]).any() or not np.allclose(
        flat_bias, flat_bias[:, :1], rtol=1e-12, atol=1e-15
    ):
        return None
    if window.stride[0] != window.stride[1]:
        return None
    stride, sizes = window.stride[0], [n // window.pool for n in before[1:]]
    found = _square(window.kernel, sizes, shape[1:], stride, window.before)
    if found is None:
        return None
    kernel, padding = found
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
                pads = zip(front, back, strict=True)
                return np.pad(kernel, ((0, 0), (0, 0), *pads)), padding
    return None


# --- integers -------------------------------------------------------------------------------------


def rounded(layer: NirLayer, clip: float = 1.0, moments=None) -> Integers:
    """Round a layer of neurons to the chip's integers.

    Parameters
    ----------
    layer : NirLayer
    clip : float
        Share of the largest weight that becomes 127.
    moments : ndarray, shape (inputs, inputs), optional
        From :func:`moments_of`: the rounding error of a weight is then compensated by the
        following weights, if their inputs are active together.

    Returns
    -------
    Integers

    Raises
    ------
    NirError
        Threshold and bias do not fit with any exponent of the weights.
    """
    real = layer.weights / layer.pool**2  # the layer's weights are those of averages
    if not all(np.isfinite(part).all() for part in (real, layer.bias, layer.keep_u, layer.keep_v)):
        raise NirError(
            f"{layer}: its weights or biases become infinite when divided by its threshold; "
            "scale the threshold to about 1 in training"
        )
    largest = float(np.abs(real).max()) * clip
    if largest == 0:
        raise NirError(f"{layer}: all its weights are 0; train it, or leave it out")
    # The threshold, a whole number of units, is rounded up: only the largest weights are clipped.
    with np.errstate(over="ignore"):
        units = np.ceil(WEIGHT_UNIT / THRESHOLD_UNIT * WEIGHT_LEVELS / largest - 1e-9)
    units = min(units, 2.0**1000)  # weights of 1e-310 are too small, as the loop below finds
    scale = WEIGHT_UNIT / THRESHOLD_UNIT / max(units, 1)
    if moments is None:
        weights = np.clip(np.rint(real / scale), -WEIGHT_LEVELS, WEIGHT_LEVELS)
    else:
        weights = _compensated(real / scale, moments)
    keep_u, keep_v = (
        int(np.clip(np.rint(DECAY_UNIT * keep), least, MOST_KEEP))
        for keep, least in ((layer.keep_u, LEAST_KEEP_U), (layer.keep_v, LEAST_KEEP_V))
    )
    if largest > 1.5 * WEIGHT_LEVELS * scale:
        raise NirError(
            f"{layer}: its weights are too large beside its threshold for the chip's integers, "
            f"{largest:.3g} of it; scale the weights or the threshold in training"
        )
    for lowered in range(WEIGHT_EXPONENTS):
        per_threshold = WEIGHT_UNIT * 2.0**-lowered / scale
        threshold = THRESHOLD_UNIT * round(per_threshold / THRESHOLD_UNIT)
        bias = layer.bias * threshold
        if 0 < threshold <= MAX_THRESHOLD and np.abs(bias).max() <= MAX_BIAS:
            break
    else:
        raise NirError(
            f"{layer}: its weights are too small beside its threshold for the chip's integers, or "
            "its biases too large; scale weights and threshold in training, or use shorter time "
            "constants"
        )
    return Integers(
        weights.astype(np.int32), _twelve_bits(bias), threshold, FLOOR, keep_u, keep_v, -lowered
    )


def _compensated(real, moments) -> np.ndarray:
    """Whole numbers near ``real``, such that the error of weighted sums is small.

    The inputs are rounded one after the other, and the remaining ones compensate the error by least
    squares (Frantar et al., "GPTQ", ICLR 2023, with the Cholesky factor of the inverse).  The input
    with the largest weight is the first, so that this weight does not change.
    """
    flat = real.reshape(len(moments), -1)
    order = np.argsort(-np.abs(flat).max(1), kind="stable")
    left, moments = flat[order], moments[np.ix_(order, order)]
    upper = np.linalg.cholesky(np.linalg.inv(moments)).T
    for i in range(len(left)):
        found = np.clip(np.rint(left[i]), -WEIGHT_LEVELS, WEIGHT_LEVELS)
        error = (left[i] - found) / upper[i, i]
        left[i] = found
        left[i + 1 :] -= np.outer(upper[i, i + 1 :], error)
    return left[np.argsort(order)].reshape(real.shape)


def moments_of(layer: NirLayer, spikes) -> np.ndarray:
    """Second moments of the inputs' contributions to the voltage, with a small diagonal added.

    Parameters
    ----------
    layer : NirLayer
    spikes : ndarray, shape (n_samples, steps, inputs)

    Returns
    -------
    ndarray, shape (inputs, inputs) or (rows * columns * channels,) twice
        In the order of the weights.
    """
    left, u, v = [], 0.0, 0.0
    for t in range(spikes.shape[1]):
        u = layer.keep_u * u + spikes[:, t]
        v = layer.keep_v * v + u
        if t % MOMENTS_EVERY == 0:
            left.append(v)
    seen = _seen(layer, np.stack(left, 1)) if layer.kind == "conv" else np.stack(left, 1)
    if layer.kind == "conv":
        seen = np.moveaxis(seen, 3, 5)  # channels last, as in the weights
    inputs = math.prod(layer.weights.shape[:-1])
    seen = seen.reshape(-1, inputs)
    moments = seen.T @ seen / len(seen)
    return moments + np.eye(inputs) * max(DAMPING * np.trace(moments) / inputs, 1e-12)


def _twelve_bits(bias):
    """Round to 12 bits times a power of two, as NengoLoihi does."""
    share = np.maximum(np.abs(np.rint(bias)) / BIAS_MANTISSA, 1)
    unit = 2.0 ** np.ceil(np.log2(share))
    return (np.rint(np.rint(bias) / unit) * unit).astype(np.int32)


def currents(layer: NirLayer, weights, spikes) -> np.ndarray:
    """Input currents W s at each step.

    Parameters
    ----------
    layer : NirLayer
    weights : ndarray
        Weights in the layer's shape, for sums over the squares that it averages.
    spikes : ndarray, shape (n_samples, steps, inputs)

    Returns
    -------
    ndarray, shape (n_samples, steps, neurons)
    """
    lead = spikes.shape[:2]
    if layer.kind == "dense":
        return (spikes.reshape(-1, spikes.shape[-1]) @ weights).reshape(*lead, -1)
    return np.tensordot(_seen(layer, spikes), weights, ((3, 4, 5), (2, 0, 1))).reshape(*lead, -1)


def _seen(layer, spikes):
    """Windows (frames, rows, columns, channels, kernel's rows, columns) of sums over squares."""
    frames = spikes.reshape(-1, *layer.input_shape)
    if layer.pool > 1:
        rows, columns = (n // layer.pool for n in layer.input_shape[:2])
        channels = layer.input_shape[2]
        cut = frames[:, : rows * layer.pool, : columns * layer.pool]
        frames = cut.reshape(-1, rows, layer.pool, columns, layer.pool, channels).sum((2, 4))
    side = layer.weights.shape[0]
    pads = [windows(n, side, layer.stride, layer.padding)[1:] for n in frames.shape[1:3]]
    frames = np.pad(frames, ((0, 0), *pads, (0, 0)))
    seen = np.lib.stride_tricks.sliding_window_view(frames, (side, side), (1, 2))
    return seen[:, :: layer.stride, :: layer.stride]


def fired(layer: NirLayer, spikes, integers: Integers | None = None) -> np.ndarray:
    """Spikes of a layer of neurons, from rest.

    Parameters
    ----------
    layer : NirLayer
    spikes : ndarray, shape (n_samples, steps, inputs)
        In the chip's order.
    integers : Integers, optional
        The chip's integers; default: the layer's real numbers.

    Returns
    -------
    ndarray of bool, shape (n_samples, steps, neurons)
        In the same step as the input; on the chip, one step later for each layer.
    """
    exact = integers is None
    weights = layer.weights / layer.pool**2 if exact else integers.weights.astype(float)
    added = currents(layer, weights, np.asarray(spikes, float))
    bias = layer.bias if exact else integers.bias
    bias = np.tile(bias, added.shape[2] // bias.size)
    keep_u, keep_v = layer.keep_u, layer.keep_v
    threshold, floor = 1.0, -np.inf
    if not exact:
        added = added * (WEIGHT_UNIT * 2.0**integers.exponent)
        keep_u, keep_v = integers.keep_u / DECAY_UNIT, integers.keep_v / DECAY_UNIT
        threshold, floor = integers.threshold, integers.floor
    cut = (lambda x: x) if exact else np.trunc
    u, v = np.zeros((2, len(added), added.shape[2]))
    result = np.empty(added.shape, bool)
    for t in range(added.shape[1]):
        u = cut(u * keep_u) + added[:, t]
        v = np.maximum(cut(v * keep_v) + u + bias, floor)
        result[:, t] = v > threshold
        v = np.where(result[:, t], 0.0, v)
    return result


def chosen(layer: NirLayer, spikes=None) -> Integers:
    """The layer's integers, with the scale and rounding of weights that change the spikes least.

    Parameters
    ----------
    layer : NirLayer
    spikes : ndarray, optional
        Input on training samples, as for :func:`fired`.  Without them the largest weight becomes
        127.
    """
    if spikes is None:
        return rounded(layer)
    wanted = fired(layer, spikes).sum(1, dtype=float)
    found = []
    ways = [None]
    if math.prod(layer.weights.shape[:-1]) <= MOST_MOMENTS:
        ways.append(moments_of(layer, spikes))
    for clip, moments in itertools.product(CLIPS, ways):
        integers = rounded(layer, clip, moments)
        error = fired(layer, spikes, integers).sum(1, dtype=float) - wanted
        found.append((float(np.square(error).mean()), -clip, integers))
    return min(found, key=lambda entry: entry[:2])[2]
