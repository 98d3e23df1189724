"""NIR graphs for tests, as the plain values that a file holds."""

import itertools

import numpy as np

from models.nir.graph import read_nir


class Graph:
    """What :func:`models.nir.graph.read_nir` takes for a graph in memory."""

    def __init__(self, tree):
        self.tree, self.nodes = tree, tree["nodes"]

    def to_dict(self):
        return self.tree


def tree_of(shape, *nodes, output=None):
    """A chain from an input of ``shape`` through nodes, each ``(kind, values)``."""
    named = {"input": {"type": "Input", "shape": np.array(shape)}}
    for index, (kind, values) in enumerate(nodes):
        named[f"n{index}"] = {"type": kind, **values}
    named["output"] = {"type": "Output", "shape": np.array(output or [1])}
    names = list(named)
    return {"type": "NIRGraph", "nodes": named, "edges": list(itertools.pairwise(names))}


def network_of(shape, *nodes):
    """The chain read and checked."""
    return read_nir(Graph(tree_of(shape, *nodes)))


def affine(rng, outputs, inputs, spread=1.0, bias=0.0):
    weight = rng.normal(0, spread, (outputs, inputs))
    return "Affine", {"weight": weight, "bias": rng.normal(0, 1, outputs) * bias}


def conv(rng, filters, channels, kernel, bias=0.0, **values):
    weight = rng.normal(0, 0.6, (filters, channels, *np.broadcast_to(kernel, 2)))
    return "Conv2d", {"weight": weight, "bias": rng.normal(0, 1, filters) * bias, "stride": 1,
                      "padding": 0, "dilation": 1, "groups": 1, **values}  # fmt: skip


def lif(tau=0.02, r=1.0, v_leak=0.0, v_threshold=1.0, **values):
    return "LIF", {"tau": tau, "r": r, "v_leak": v_leak, "v_threshold": v_threshold, **values}


def cuba_lif(tau_syn=0.01, tau_mem=0.02, r=1.0, v_leak=0.0, v_threshold=1.0, **values):
    return "CubaLIF", {"tau_syn": tau_syn, "tau_mem": tau_mem, "r": r, "v_leak": v_leak,
                       "v_threshold": v_threshold, **values}  # fmt: skip


def spikes(rng, samples, steps, shape, rate=0.1):
    """Frames of 0 and 1."""
    return (rng.random((samples, steps, *shape)) < rate).astype(float)
