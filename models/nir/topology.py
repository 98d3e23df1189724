"""The order of the nodes of a NIR graph, which must be a chain from one input to one output.

A layer of neurons may also be connected to itself, through one ``Linear`` or ``Affine``.  Subgraphs
are replaced by their nodes.  The functions work on nodes by their names, as a file has them, and on
edges as a set of pairs of names.
"""

from __future__ import annotations

import itertools
from typing import NoReturn

from models.nir.errors import NirError, quote
from models.nir.nodes import decode, read_node_kind


def merge_subgraphs(tree, prefix="") -> tuple:
    """Nodes by name, and edges, with subgraphs replaced by their nodes and edges."""
    nodes = {}
    inside = {}
    edges = {(prefix + decode(a), prefix + decode(b)) for a, b in tree["edges"]}
    for name, node in ((prefix + name, node) for name, node in tree["nodes"].items()):
        if read_node_kind(node) != "NIRGraph":
            nodes[name] = node
            continue
        inner_nodes, inner_edges = merge_subgraphs(node, f"{name}.")
        inside[name] = [
            _find_only_node(inner_nodes, kind, f"graph {quote(name)}: ")
            for kind in ("Input", "Output")
        ]
        nodes |= inner_nodes
        edges |= inner_edges
    edges = {
        (inside[a][1] if a in inside else a, inside[b][0] if b in inside else b) for a, b in edges
    }
    for name in sorted({name for pair in edges for name in pair} - nodes.keys()):
        siblings = sorted(node_name for node_name in nodes if node_name.startswith(prefix))
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


def _find_only_node(nodes, kind, where="") -> str:
    """Name of the only node of a kind."""
    names = [name for name, node in nodes.items() if read_node_kind(node) == kind]
    if len(names) != 1:
        listed = f" ({', '.join(map(quote, names[:5]))})" if names else ""
        raise NirError(
            f"{where}has {len(names)} nodes of kind {kind}{listed}; a chain from one Input to one "
            "Output can be used"
        )
    return names[0]


def find_loops(nodes, edges) -> dict:
    """(name, values) of the node between each recurrent layer and itself, by the layer's name.

    These nodes and their edges are removed.
    """
    loops: dict[str, tuple] = {}
    for name in list(nodes):
        before = {a for a, b in edges if b == name}
        after = {b for a, b in edges if a == name}
        if read_node_kind(nodes[name]) not in ("Linear", "Affine") or len(after) != 1:
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
        f"node {quote(name)}: connects the input {quote(other)} through the recurrent weights of "
        f"{quote(layer)}, as Spyx writes recurrent layers; connect {quote(other)} to "
        f"{quote(layer)} directly in the edges of the graph"
    )


def find_chain(nodes, edges) -> tuple:
    """Name of the input node, and names of the nodes between input and output, in order."""
    first = _find_only_node(nodes, "Input")
    last = _find_only_node(nodes, "Output")
    after: dict[str, list] = {name: [] for name in nodes}
    for before, behind in sorted(edges):
        after[before].append(behind)
    order: list[str] = []
    name = first
    while name != last:
        if len(after[name]) != 1 or len(order) > len(nodes):
            leads = " and ".join(map(quote, after[name][:3])) or "nothing"
            raise NirError(
                f"node {quote(name)} ({read_node_kind(nodes[name])}) leads to {leads}; "
                "a chain from input to output can be used, in which a layer of neurons may also be "
                "connected to itself, through one Linear or Affine and without delays"
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
