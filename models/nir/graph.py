"""Read NIR graphs as a chain of nodes, each of which is validated.

Pedersen et al., "Neuromorphic intermediate representation: A unified instruction set for
interoperable brain-inspired computing", Nature Communications 15, 8122 (2024), gives the nodes'
equations, which are repeated in :mod:`models.nir.simulator`.  Shapes are those of NIR and
PyTorch: channels first.

A graph can be used if it is a chain from one input to one output.  A layer of neurons may also be
connected to itself, through one ``Linear`` or ``Affine``.  Subgraphs are replaced by their nodes.
Parameters of neurons may be one value, or one value for each neuron.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from deploy import limits
from deploy.files import reporting_os_errors
from models.nir.conventions import Convention, recognise
from models.nir.errors import NirError, quote

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


@dataclass(frozen=True)
class NirNetwork:
    """A NIR graph that is a chain of nodes, read and validated.

    Attributes
    ----------
    input_shape : tuple of int
        Shape of the input at each step: (channels, rows, columns), or flat.
    nodes : tuple of Node
        In order, without the input and output nodes.
    metadata : dict
        Metadata of the graph; not validated.
    """

    input_shape: tuple
    nodes: tuple
    metadata: dict = field(default_factory=dict, repr=False)

    @property
    def outputs(self) -> int:
        """Number of output values."""
        return math.prod(self.nodes[-1].shape)

    @functools.cached_property
    def convention(self) -> Convention:
        """How its numbers are read, and which framework wrote them."""
        return recognise(self.nodes, self.metadata)


def read_nir(source) -> NirNetwork:
    """Read a NIR graph.

    Parameters
    ----------
    source : path-like or nir.NIRGraph
        A file, or a graph in memory.

    Returns
    -------
    NirNetwork

    Raises
    ------
    NirError
        The source is not a NIR graph, or cannot be used: it is not a chain, or has unknown nodes,
        or shapes or values that do not fit.  The message names the file, the node and a remedy.
    UserError
        The file cannot be read.
    """
    if hasattr(source, "to_dict"):
        return _make_network(source.to_dict())
    with reporting_os_errors(source, "cannot read", "check the path"):
        content = Path(source).read_bytes()
    try:
        return _parse(content)
    except NirError as error:
        raise NirError(f"{source}: {error}") from error


@functools.lru_cache(maxsize=2)
def _parse(content: bytes) -> NirNetwork:
    """The network of a file's content, which a command parses once though it is asked for often."""
    from models.nir.file import read_tree  # imports h5py

    return _make_network(read_tree(content))


def _make_network(tree) -> NirNetwork:
    nodes, edges = _merge_subgraphs(tree)
    loops = _find_loops(nodes, edges)
    first, order = _find_chain(nodes, edges)
    problems: list[tuple[int, int, NirError]] = []
    for shape in _list_input_shapes(first, nodes[first], nodes[order[0]]):
        chain: list[Node] = []
        try:
            _extend_chain(chain, nodes, order, loops, shape)
        except NirError as error:
            problems.append((-len(chain), len(problems), error))
            continue
        break
    else:  # the problem of the shape with which most nodes can be read
        raise min(problems, key=lambda problem: problem[:2])[2]
    if not any(node.kind in SPIKING for node in chain):
        raise NirError(
            "has no neurons that spike, which is what the chip has; put a LIF, CubaLIF or IF "
            "between its layers"
        )
    metadata = tree.get("metadata")
    return NirNetwork(shape, tuple(chain), metadata if isinstance(metadata, dict) else {})


def _extend_chain(chain, nodes, order, loops, shape):
    """Append the nodes in order, for an input of a shape."""
    for name in order:
        node = _read_node(name, nodes[name], shape)
        if name in loops:
            if node.kind not in SPIKING:
                raise NirError(f"{node}: is connected to itself; only layers of neurons can be")
            loop = _read_node(*loops[name], (math.prod(node.shape),))
            if loop.shape != loop.input_shape:
                raise NirError(f"{loop}: outputs {loop.shape[0]} values to {loop.input_shape[0]}")
            node = replace(node, loop=loop)
        chain.append(node)
        shape = node.shape


def _read_node(name, values, shape) -> Node:
    """A node for an input of a shape."""
    kind = _find_kind(values)
    handler = _HANDLERS.get(kind)
    if handler is None:
        raise NirError(
            f"node {quote(name)}: {quote(kind)} cannot be used; "
            + _INSTEAD.get(kind, "use " + ", ".join(_HANDLERS))
        )
    reader = _Values(f"node {quote(name)} ({kind})", values)
    after, parameters = handler(reader, shape)
    if math.prod(after) > limits.NEURONS or math.prod(after) < 1:
        reader.refuse(
            f"outputs {math.prod(after)} values, and a layer can have 1 to {limits.NEURONS}; "
            "use strides, averaging or fewer filters"
        )
    return Node(name, kind, shape, after, parameters)


# --- the graph ------------------------------------------------------------------------------------


def _merge_subgraphs(tree, prefix="") -> tuple:
    """Nodes by name, and edges, with subgraphs replaced by their nodes and edges."""
    nodes = {}
    inside = {}
    edges = {(prefix + _decode(a), prefix + _decode(b)) for a, b in tree["edges"]}
    for name, node in ((prefix + name, node) for name, node in tree["nodes"].items()):
        if _find_kind(node) != "NIRGraph":
            nodes[name] = node
            continue
        own, own_edges = _merge_subgraphs(node, f"{name}.")
        inside[name] = [_end(own, kind, f"graph {quote(name)}: ") for kind in ("Input", "Output")]
        nodes |= own
        edges |= own_edges
    edges = {
        (inside[a][1] if a in inside else a, inside[b][0] if b in inside else b) for a, b in edges
    }
    for name in sorted({name for pair in edges for name in pair} - nodes.keys()):
        siblings = sorted(other for other in nodes if other.startswith(prefix))
        raise NirError(
            f"an edge to {quote(name)}, which does not exist, among the nodes "
            f"{', '.join(map(quote, siblings[:6]))}; write it with edges between these"
        )
    for end in itertools.chain(*inside.values()):  # remove nodes that only pass values on
        before = [a for a, b in edges if b == end]
        after = [b for a, b in edges if a == end]
        edges = {pair for pair in edges if end not in pair}
        edges |= set(itertools.product(before, after))
        del nodes[end]
    return nodes, edges


def _end(nodes, kind, where="") -> str:
    """Name of the only node of a kind."""
    names = [name for name, node in nodes.items() if _find_kind(node) == kind]
    if len(names) != 1:
        listed = f" ({', '.join(map(quote, names[:5]))})" if names else ""
        raise NirError(
            f"{where}has {len(names)} nodes of kind {kind}{listed}; a chain from one Input to one "
            "Output can be used"
        )
    return names[0]


def _find_loops(nodes, edges) -> dict:
    """(name, values) of the node between each recurrent layer and itself, by the layer's name.

    These nodes and their edges are removed.
    """
    loops: dict[str, tuple] = {}
    for name in list(nodes):
        before = {a for a, b in edges if b == name}
        after = {b for a, b in edges if a == name}
        if _find_kind(nodes[name]) not in ("Linear", "Affine") or len(after) != 1:
            continue
        (layer,) = after
        if before != after:
            if layer in before:
                _refuse_shared_loop(name, layer, min(before - after))
            continue
        if layer in loops:
            raise NirError(
                f"node {quote(layer)}: is connected to itself twice, through "
                f"{quote(loops[layer][0])} and {quote(name)}; add their weights in one node"
            )
        loops[layer] = name, nodes.pop(name)
        edges -= {(layer, name), (name, layer)}
    return loops


def _refuse_shared_loop(name, layer, other) -> NoReturn:
    """Refuse weights through which a layer receives both its input and its own spikes."""
    raise NirError(
        f"node {quote(name)}: leads both {quote(other)} and the spikes of {quote(layer)} to "
        f"{quote(layer)}, as Spyx writes recurrent layers, in which the input does not pass these "
        f"weights; connect {quote(other)} to {quote(layer)} in the edges of the graph"
    )


def _find_chain(nodes, edges) -> tuple:
    """Name of the input node, and names of the nodes between input and output, in order."""
    first = _end(nodes, "Input")
    last = _end(nodes, "Output")
    after: dict[str, list] = {name: [] for name in nodes}
    for before, behind in sorted(edges):
        after[before].append(behind)
    order: list[str] = []
    name = first
    while name != last:
        if len(after[name]) != 1 or len(order) > len(nodes):
            leads = " and ".join(map(quote, after[name][:3])) or "nothing"
            raise NirError(
                f"node {quote(name)} ({_find_kind(nodes[name])}) leads to {leads}; a "
                f"chain from input "
                "to output can be used, in which a layer of neurons may also be connected to "
                "itself, through one Linear or Affine and without delays"
            )
        (name,) = after[name]
        order.append(name)
    order = order[:-1]
    aside = sorted(nodes.keys() - {first, last, *order})
    if aside:
        raise NirError(
            f"node {quote(aside[0])} is on a branch or leads nowhere; a chain of nodes without "
            "branches from input to output can be used"
        )
    if not order:
        raise NirError("has no nodes between input and output; write the trained network")
    return first, order


def _decode(value) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _find_kind(node) -> str:
    return _decode(node.get("type", "nothing"))


def _list_input_shapes(name, node, following) -> list:
    """The shapes that an input may have: as declared, and without leading dimensions.

    Those are time and samples, which some exporters do not leave out.
    """
    shape = node.get("shape")
    if shape is None and isinstance(node.get("input_type"), dict):
        shape = node["input_type"].get("input")
    try:
        shape = tuple(int(n) for n in np.asarray(shape).ravel()[:MAX_DIMENSIONS])
    except (TypeError, ValueError, OverflowError):  # no numbers, NaN, infinity
        shape = ()
    shapes = [shape[start:] for start in range(max(len(shape), 1))]
    if shape[:1] == (1,) and len(shape) == 4:
        shapes = shapes[1:]
    reads_image = _find_kind(following).startswith(("Conv", "SumPool", "AvgPool"))
    if not reads_image and set(shape[:-1]) == {1}:
        shapes = shapes[-1:]  # samples and time of 1
    usable = [
        each
        for each in shapes
        if 1 <= len(each) <= 3 and min(each) >= 1 and math.prod(each) <= limits.NEURONS
    ]
    if not usable or min(shape) < 1:
        sizes = "x".join(map(str, shape[:6])) or "nothing"
        raise NirError(
            f"node {quote(name)} (Input): a shape of {sizes}; write the graph with a sample of "
            "shape (channels, rows, columns) or (values,), without dimensions for time and samples"
        )
    return usable


# --- the nodes ------------------------------------------------------------------------------------


def _convert_to_floats(value) -> np.ndarray | None:
    """An array of numbers as float64; None for anything else."""
    try:
        array = np.asarray(value)
        return array.astype(float) if array.dtype.kind in "fiub" else None
    except (TypeError, ValueError):
        return None


class _Values:
    """Reads a node's values and refuses invalid ones."""

    def __init__(self, where, values):
        self.where = where
        self.values = values

    def refuse(self, problem) -> NoReturn:
        raise NirError(f"{self.where}: {problem}")

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

    def spread(self, name, shape, default=None) -> np.ndarray:
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
        array = self.spread(name, shape)
        if array.min() <= 0:
            self.refuse(f"its {name} is not above 0; give time constants in seconds")
        return array

    def read_counts(self, name, dimensions, least=1, default=None) -> tuple:
        """A whole number for each dimension."""
        array = self.read_array(name, default).ravel()
        array = np.repeat(array, dimensions) if array.size == 1 else array
        good = array.size == dimensions and (array == np.rint(array)).all()
        if not good or array.min() < least or array.max() > limits.NEURONS:
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
    bias = values.spread("bias", (weight.shape[0],), 0.0)
    return (weight.shape[0],), {"weight": weight, "bias": bias}


def _make_convolution_reader(dimensions):
    def handler(values, shape):
        values.require_image(shape, dimensions)
        weight = values.read_array("weight")
        if weight.ndim != 2 + dimensions or min(weight.shape) < 1:
            values.refuse(
                f"a weight of shape {weight.shape}; use (filters, channels, "
                + ("rows, columns)" if dimensions == 2 else "places)")
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
        parameters = {
            "weight": weight,
            "bias": values.spread("bias", (weight.shape[0],), 0.0),
            "stride": stride,
            "padding": padding,
            "dilation": dilation,
            "groups": groups,
        }
        return (weight.shape[0], *sizes), parameters

    return handler


def _read_padding(values, dimensions, reach, stride):
    padding = values.values.get("padding", 0)
    if isinstance(padding, (str, bytes)):
        if _decode(padding) == "valid":
            return ((0, 0),) * dimensions
        if _decode(padding) != "same" or max(stride) > 1:
            values.refuse(
                f"padding {quote(_decode(padding))} with a stride of {max(stride)}; give "
                "the padding "
                "as a number"
            )
        return tuple(((r - 1) // 2, (r - 1) - (r - 1) // 2) for r in reach)
    return tuple((n, n) for n in values.read_counts("padding", dimensions, 0, default=0))


def _pool(values, shape):
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


def _flatten(values, shape):
    ends = [values.read_array("start_dim", 0), values.read_array("end_dim", -1)]
    if any(end.size != 1 or end.item() != np.rint(end.item()) for end in ends):
        values.refuse("its start_dim and end_dim are not a whole number each")
    first, last = (int(end.item()) for end in ends)
    declared = values.values.get("input_type")
    if isinstance(declared, dict):
        declared = declared.get("input")
    if declared is not None and np.size(declared) == len(shape) + 1 and first > 0:
        first -= 1  # counted with a dimension for samples in front
    first, last = (n + len(shape) if n < 0 else n for n in (first, last))
    if not 0 <= first < len(shape):
        first = 0
    last = min(max(last, first), len(shape) - 1)
    return (*shape[:first], math.prod(shape[first : last + 1]), *shape[last + 1 :]), {}


def _reshape(values, shape):
    """A node that is not in NIR's paper; some exporters write it between layers."""
    names = ("shape", "output_shape", "output_type")
    wanted = next((values.values[n] for n in names if values.values.get(n) is not None), None)
    if isinstance(wanted, dict):
        wanted = wanted.get("output")
    if wanted is None:
        return shape, {}
    sizes = np.asarray(wanted).ravel()
    if sizes.dtype.kind not in "iu" or not 1 <= sizes.size <= MAX_DIMENSIONS:
        values.refuse("its shape is not a list of whole numbers; write it again")
    sizes = [int(n) for n in sizes]
    if sizes.count(-1) == 1:
        rest = math.prod(n for n in sizes if n != -1)
        sizes[sizes.index(-1)] = math.prod(shape) // rest if rest > 0 else 0
    while len(sizes) > 1 and sizes[0] == 1 and len(sizes) > len(shape):
        sizes = sizes[1:]  # a dimension for samples
    if min(sizes) < 1 or math.prod(sizes) != math.prod(shape) or len(sizes) > 3:
        values.refuse(f"gives its input of {shape} the shape {tuple(sizes)}; use a Flatten")
    return tuple(sizes), {}


def _scale(values, shape):
    return shape, {"scale": values.spread("scale", shape)}


def _read_threshold(values, shape):
    threshold = values.spread("threshold", shape)
    if threshold.min() <= 0:
        values.refuse("its threshold must be above 0, or it spikes without input; train it again")
    return shape, {"threshold": threshold}


def _make_neurons_reader(times, *, spikes, leak=True, weighs=False):
    def handler(values, shape):
        parameters = {name: values.read_positive(name, shape) for name in times}
        parameters["r"] = values.spread("r", shape)
        if leak:
            parameters["v_leak"] = values.spread("v_leak", shape)
        if weighs:
            parameters["w_in"] = values.spread("w_in", shape, 1.0)
        if spikes:
            parameters["v_threshold"] = values.spread("v_threshold", shape)
            parameters["v_reset"] = values.spread("v_reset", shape, 0.0)
            if (parameters["v_threshold"] <= parameters["v_reset"]).any():
                values.refuse(
                    "its v_reset is not below its v_threshold, so that it never stops "
                    "spiking; correct them in the graph (most packages reset to 0)"
                )
        return shape, parameters

    return handler


_HANDLERS = {
    "Affine": _read_affine,
    "Linear": _read_affine,
    "Conv1d": _make_convolution_reader(1),
    "Conv2d": _make_convolution_reader(2),
    "SumPool2d": _pool,
    "AvgPool2d": _pool,
    "Flatten": _flatten,
    "Reshape": _reshape,
    "Identity": lambda values, shape: (shape, {}),
    "Scale": _scale,
    "Threshold": _read_threshold,
    "IF": _make_neurons_reader((), spikes=True, leak=False),
    "LIF": _make_neurons_reader(("tau",), spikes=True),
    "LI": _make_neurons_reader(("tau",), spikes=False),
    "CubaLIF": _make_neurons_reader(("tau_syn", "tau_mem"), spikes=True, weighs=True),
    "CubaLI": _make_neurons_reader(("tau_syn", "tau_mem"), spikes=False, weighs=True),
}

# Possible replacement of an unsupported node.
_INSTEAD = {
    "Delay": "the chip's axons have no delays here; train without",
    "I": "the chip has no integrator without a leak; use LI with a long time constant",
    "Input": "a chain has one input",
    "Output": "a chain has one output",
}
