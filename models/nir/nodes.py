"""The nodes of a NIR graph: each is read for the shape of its input, and validated.

Pedersen et al., "Neuromorphic intermediate representation: A unified instruction set for
interoperable brain-inspired computing", Nature Communications 15, 8122 (2024), gives the nodes'
equations, which are repeated in :mod:`models.nir.simulator`.  Shapes are those of NIR and
PyTorch: channels first.  Parameters of neurons may be one value, or one value for each neuron.

`HANDLERS` has a function for each kind of node that can be used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np

from deploy import limits
from models.nir.errors import NirError, quote
from models.windows import spread_kernel

# Nodes whose output is spikes.
SPIKING = ("IF", "LIF", "CubaLIF", "Threshold")

# Nodes with a state whose output is not spikes.
FILTERS = ("LI", "CubaLI")

# Maximum number of dimensions of an input that are read; the last three at most are used.
MAX_DIMENSIONS = 7


@dataclass(frozen=True)
class Node:
    """A node of a chain.

    Attributes
    ----------
    name : str
    kind : str
        NIR's name of the node's class, such as ``"LIF"``.
    input_shape, shape : tuple of int
        Shapes of input and output; images as (channels, rows, columns).
    parameters : dict
        By NIR's names.  Those of neurons are arrays of the node's shape.  Weights and biases are
        arrays as in NIR (a missing bias is zero).  ``padding`` is a pair (before, after) for each
        dimension, ``stride``, ``dilation`` and ``kernel_size`` a number for each.
    loop : Node or None
        The ``Linear`` or ``Affine`` through which the node is connected to itself.
    """

    name: str
    kind: str
    input_shape: tuple
    shape: tuple
    parameters: dict = field(repr=False)
    loop: Node | None = None

    def __str__(self):
        return f"node {quote(self.name)} ({self.kind})"

    def __getitem__(self, name):
        return self.parameters[name]


def read_node(name, values, shape) -> Node:
    """A node for an input of a shape."""
    kind = read_node_kind(values)
    handler = HANDLERS.get(kind)
    if handler is None:
        raise NirError(
            f"node {quote(name)}: {quote(kind)} cannot be used; "
            + ALTERNATIVES.get(kind, "use " + ", ".join(HANDLERS))
        )
    reader = NodeValues(f"node {quote(name)} ({kind})", values)
    after, parameters = handler(reader, shape)
    if math.prod(after) > limits.NEURONS or math.prod(after) < 1:
        reader.refuse(
            f"outputs {math.prod(after)} values, and a layer can have 1 to {limits.NEURONS}; "
            "use strides, averaging or fewer filters"
        )
    return Node(name, kind, shape, after, parameters)


def decode(value) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def read_node_kind(node) -> str:
    return decode(node.get("type", "nothing"))


def _convert_to_floats(value) -> np.ndarray | None:
    """An array of numbers as float64; None for anything else."""
    try:
        array = np.asarray(value)
        return array.astype(float) if array.dtype.kind in "fiub" else None
    except (TypeError, ValueError):
        return None


class NodeValues:
    """Reads a node's values and refuses invalid ones.

    Parameters
    ----------
    node : str
        Name and kind of the node, for messages.
    values : dict
        By NIR's names, as in the file.
    """

    def __init__(self, node, values):
        self.node = node
        self.values = values

    def refuse(self, problem) -> NoReturn:
        raise NirError(f"{self.node}: {problem}")

    def read_array(self, name, default=None) -> np.ndarray:
        """Finite numbers, float64."""
        value = self.values.get(name)
        if value is None:
            value = default
        if value is None:
            self.refuse(f"has no {name}; write the graph with a current version of nir")
        array = _convert_to_floats(value)
        if array is None:
            self.refuse(f"its {name} is not an array of numbers; write the graph again")
        if not np.isfinite(array).all():
            self.refuse(f"its {name} has NaN or infinite values; train again, with decays below 1")
        if np.abs(array).max(initial=0) > limits.MAGNITUDE:
            self.refuse(f"its {name} has a value above {limits.MAGNITUDE:g}; scale it")
        return array

    def read_per_neuron(self, name, shape, default=None) -> np.ndarray:
        """One value for each neuron."""
        array = self.read_array(name, default)
        try:
            return np.broadcast_to(array, shape).copy()
        except ValueError:
            if array.size == math.prod(shape):
                return array.reshape(shape)
            self.refuse(
                f"its {name} has shape {array.shape}, its input {shape}; give one value, or "
                "one for each neuron"
            )

    def read_positive(self, name, shape) -> np.ndarray:
        """A time constant in seconds for each neuron."""
        array = self.read_per_neuron(name, shape)
        if array.min() <= 0:
            self.refuse(f"its {name} is not above 0; give time constants in seconds")
        return array

    def read_counts(self, name, dimensions, least=1, default=None) -> tuple:
        """A whole number for each dimension."""
        array = self.read_array(name, default).ravel()
        array = np.repeat(array, dimensions) if array.size == 1 else array
        is_complete = array.size == dimensions and (array == np.rint(array)).all()
        if not is_complete or array.min() < least or array.max() > limits.NEURONS:
            self.refuse(f"its {name} must be {dimensions} whole number(s), at least {least}")
        return tuple(int(n) for n in array)

    def require_image(self, shape, dimensions=2):
        if len(shape) != dimensions + 1:
            self.refuse(
                f"reads {'rows and columns' if dimensions == 2 else 'a row'} of channels, and its "
                f"input has shape {shape}; put it before the Flatten, or reshape the input"
            )


def _read_affine(values, shape):
    weight = values.read_array("weight")
    if weight.ndim != 2:
        values.refuse(f"a weight of shape {weight.shape}; use (outputs, inputs)")
    if len(shape) != 1 and math.prod(shape) == weight.shape[1]:
        shape = (math.prod(shape),)
    if shape != (weight.shape[1],):
        values.refuse(
            f"for {weight.shape[1]} values, and its input is {' x '.join(map(str, shape))}; put a "
            "Flatten before it, or train it for that input"
        )
    bias = values.read_per_neuron("bias", (weight.shape[0],), 0.0)
    return (weight.shape[0],), {"weight": weight, "bias": bias}


def _make_convolution_reader(dimensions):
    def read_convolution(values, shape):
        values.require_image(shape, dimensions)
        weight = values.read_array("weight")
        if weight.ndim != 2 + dimensions or min(weight.shape) < 1:
            values.refuse(
                f"a weight of shape {weight.shape}; use (filters, channels, "
                + ("rows, columns)" if dimensions == 2 else "positions)")
            )
        (groups,) = values.read_counts("groups", 1, default=1)
        channels = weight.shape[1] * groups
        if channels != shape[0] or weight.shape[0] % groups:
            values.refuse(
                f"for {channels} channels in {groups} group(s), its input has {shape[0]}; train it "
                "for that input, with groups that divide its filters"
            )
        stride = values.read_counts("stride", dimensions, default=1)
        dilation = values.read_counts("dilation", dimensions, default=1)
        reach = [(k - 1) * d + 1 for k, d in zip(weight.shape[2:], dilation, strict=True)]
        padding = _read_padding(values, dimensions, reach, stride)
        sizes = [
            (n + sum(pads) - r) // s + 1
            for n, pads, r, s in zip(shape[1:], padding, reach, stride, strict=True)
        ]
        if min(sizes) < 1:
            values.refuse("its kernel is larger than its input; use a smaller one, or padding")
        bias = values.read_per_neuron("bias", (weight.shape[0],), 0.0)
        # A row of positions is an image of one row.
        rows = (1,) * (2 - dimensions)
        weight = weight.reshape(*weight.shape[:2], *rows, *weight.shape[2:])
        parameters = {
            "weight": spread_kernel(weight, groups, (*rows, *dilation)),
            "bias": bias,
            "stride": (*rows, *stride),
            "padding": (*((0, 0) for _ in rows), *padding),
        }
        return (weight.shape[0], *sizes), parameters

    return read_convolution


def _read_padding(values, dimensions, reach, stride):
    padding = values.values.get("padding", 0)
    if isinstance(padding, (str, bytes)):
        if decode(padding) == "valid":
            return ((0, 0),) * dimensions
        if decode(padding) != "same" or max(stride) > 1:
            values.refuse(
                f"padding {quote(decode(padding))} with a stride of {max(stride)}; give "
                "the padding as a number"
            )
        return tuple(((r - 1) // 2, (r - 1) - (r - 1) // 2) for r in reach)
    return tuple((n, n) for n in values.read_counts("padding", dimensions, 0, default=0))


def _read_pooling(values, shape):
    values.require_image(shape)
    size = values.read_counts("kernel_size", 2)
    stride = values.read_counts("stride", 2, default=size)
    padding = _read_padding(values, 2, size, stride)
    if any(2 * before > n for (before, _), n in zip(padding, size, strict=True)):
        values.refuse("a padding of more than half of its windows; use less")
    sizes = [
        (n + sum(pads) - k) // s + 1
        for n, pads, k, s in zip(shape[1:], padding, size, stride, strict=True)
    ]
    if min(sizes) < 1:
        values.refuse("its windows are larger than its input; use smaller ones")
    return (shape[0], *sizes), {"kernel_size": size, "stride": stride, "padding": padding}


def _read_reshape(values, shape):
    """A node that is not in NIR's paper; some exporters write it between layers."""
    names = ("shape", "output_shape", "output_type")
    declared = next((values.values[n] for n in names if values.values.get(n) is not None), None)
    if isinstance(declared, dict):
        declared = declared.get("output")
    if declared is None:
        return shape, {}
    sizes = np.asarray(declared).ravel()
    if sizes.dtype.kind not in "iu" or not 1 <= sizes.size <= MAX_DIMENSIONS:
        values.refuse("its shape is not a list of whole numbers; write it again")
    sizes = [int(n) for n in sizes]
    if sizes.count(-1) == 1:
        known_size = math.prod(n for n in sizes if n != -1)
        sizes[sizes.index(-1)] = math.prod(shape) // known_size if known_size > 0 else 0
    while len(sizes) > 1 and sizes[0] == 1 and len(sizes) > len(shape):
        sizes = sizes[1:]  # a dimension for samples
    if min(sizes) < 1 or math.prod(sizes) != math.prod(shape) or len(sizes) > 3:
        values.refuse(f"gives its input of {shape} the shape {tuple(sizes)}; use a Flatten")
    return tuple(sizes), {}


def _read_scale(values, shape):
    return shape, {"scale": values.read_per_neuron("scale", shape)}


def _read_threshold(values, shape):
    threshold = values.read_per_neuron("threshold", shape)
    if threshold.min() <= 0:
        values.refuse("its threshold must be above 0, or it spikes without input; train it again")
    return shape, {"threshold": threshold}


def _make_neurons_reader(time_constants, *, spikes, has_leak=True, has_input_weights=False):
    def read_neurons(values, shape):
        parameters = {name: values.read_positive(name, shape) for name in time_constants}
        parameters["r"] = values.read_per_neuron("r", shape)
        if has_leak:
            parameters["v_leak"] = values.read_per_neuron("v_leak", shape)
        if has_input_weights:
            parameters["w_in"] = values.read_per_neuron("w_in", shape, 1.0)
        if spikes:
            parameters["v_threshold"] = values.read_per_neuron("v_threshold", shape)
            parameters["v_reset"] = values.read_per_neuron("v_reset", shape, 0.0)
            if (parameters["v_threshold"] <= parameters["v_reset"]).any():
                values.refuse(
                    "its v_reset is not below its v_threshold, so that it never stops "
                    "spiking; correct them in the graph (most packages reset to 0)"
                )
        return shape, parameters

    return read_neurons


HANDLERS = {
    "Affine": _read_affine,
    "Linear": _read_affine,
    "Conv1d": _make_convolution_reader(1),
    "Conv2d": _make_convolution_reader(2),
    "SumPool2d": _read_pooling,
    "AvgPool2d": _read_pooling,
    # Also of some dimensions only: the nodes after it read the values in the same order.
    "Flatten": lambda values, shape: ((math.prod(shape),), {}),
    "Reshape": _read_reshape,
    "Identity": lambda values, shape: (shape, {}),
    "Scale": _read_scale,
    "Threshold": _read_threshold,
    "IF": _make_neurons_reader((), spikes=True, has_leak=False),
    "LIF": _make_neurons_reader(("tau",), spikes=True),
    "LI": _make_neurons_reader(("tau",), spikes=False),
    "CubaLIF": _make_neurons_reader(("tau_syn", "tau_mem"), spikes=True, has_input_weights=True),
    "CubaLI": _make_neurons_reader(("tau_syn", "tau_mem"), spikes=False, has_input_weights=True),
}

# Possible replacement of an unsupported node.
ALTERNATIVES = {
    "Delay": "the chip's axons have no delays here; train without",
    "I": "the chip has no integrator without a leak; use LI with a long time constant",
    "Input": "a chain has one input",
    "Output": "a chain has one output",
}
