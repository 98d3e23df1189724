"""Read NIR graphs as a chain of nodes.

A graph can be used if it is a chain (:mod:`models.nir.topology`) of nodes that can be read
(:mod:`models.nir.nodes`) for some shape of its input.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from deploy import limits
from deploy.files import reporting_os_errors
from models.nir.conventions import Convention, recognise_convention
from models.nir.errors import NirError, quote
from models.nir.nodes import MAX_DIMENSIONS, SPIKING, Node, read_node, read_node_kind
from models.nir.topology import find_chain, find_loops, merge_subgraphs


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
        return recognise_convention(self.nodes, self.metadata)


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
    nodes, edges = merge_subgraphs(tree)
    loops = find_loops(nodes, edges)
    first, order = find_chain(nodes, edges)
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
        node = read_node(name, nodes[name], shape)
        if name in loops:
            if node.kind not in SPIKING:
                raise NirError(f"{node}: is connected to itself; only layers of neurons can be")
            loop = read_node(*loops[name], (math.prod(node.shape),))
            if loop.shape != loop.input_shape:
                raise NirError(f"{loop}: outputs {loop.shape[0]} values to {loop.input_shape[0]}")
            node = replace(node, loop=loop)
        chain.append(node)
        shape = node.shape


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
    reads_image = read_node_kind(following).startswith(("Conv", "SumPool", "AvgPool"))
    if not reads_image and set(shape[:-1]) == {1}:
        shapes = shapes[-1:]  # samples and time of 1
    usable = [
        candidate
        for candidate in shapes
        if 1 <= len(candidate) <= 3
        and min(candidate) >= 1
        and math.prod(candidate) <= limits.NEURONS
    ]
    if not usable or min(shape) < 1:
        sizes = "x".join(map(str, shape[:6])) or "nothing"
        raise NirError(
            f"node {quote(name)} (Input): a shape of {sizes}; write the graph with a sample of "
            "shape (channels, rows, columns) or (values,), without dimensions for time and samples"
        )
    return usable
