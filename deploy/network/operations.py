"""Costs of an inference: synaptic operations of the spiking network, multiplications of the CNN.

The synaptic operations of a layer are the spikes that arrive at it times their fan-out: each spike
of a neuron of the previous layer (for the first layer, of the input neurons) counts once for every
synapse of that neuron.  A network's synaptic operations are those of all its layers, including the
output layer, wherever that is computed.  The gap before a sample is included.  An operation is the
counterpart of a multiply-accumulate of the CNN of the same architecture, whose number includes the
output layer too (Davies et al. 2018).  Report, comparison, sweep and energy estimate use this
count.
"""

from __future__ import annotations

from typing import Dict

import numpy as np

from .geometry import unpooled
from .spec import Layer, NetworkSpec


def fan_out(layer: Layer) -> np.ndarray:
    """Number of synapses of each neuron of the previous layer onto this one, shape (n_inputs,).

    Neurons near the edge of a convolution reach fewer positions; those outside of complete pooling
    windows reach none.  Zeros that pad a kernel are not counted.
    """
    reached = layer.read_fan_out
    if layer.pool > 1:
        reached = unpooled(reached, layer.input_shape, layer.pool)
    return reached.ravel()


def multiply_accumulates(spec: NetworkSpec) -> Dict[str, int]:
    """Multiply-accumulates of each layer of the CNN of the same architecture, one inference.

    Pooling before a layer is included: one operation for each value that it reads.
    """
    return {
        layer.name: int(layer.read_fan_out.sum())
        + (0 if layer.recurrent is None else layer.size**2)
        + (int(np.prod(layer.read_shape)) * layer.pool**2 if layer.pool > 1 else 0)
        for layer in spec.layers
    }


def synaptic_operations(spec: NetworkSpec, spikes: Dict[str, np.ndarray]) -> Dict[str, np.ndarray]:
    """Synaptic operations by the receiving layer.

    Parameters
    ----------
    spec : NetworkSpec
    spikes : dict of str to ndarray, shape (..., n_neurons)
        Spikes of each neuron of each spiking layer.

    Returns
    -------
    dict of str to ndarray, shape (...)
    """
    senders = ["input", *(layer.name for layer in spec.layers[:-1])]
    operations = {
        layer.name: spikes[sender] @ fan_out(layer) for sender, layer in zip(senders, spec.layers)
    }
    for layer in spec.layers:
        if layer.recurrent is not None:
            own = np.asarray(spikes[layer.name]).sum(-1)
            operations[layer.name] = operations[layer.name] + own * layer.size
    return operations
