"""What an inference costs: synaptic operations of the spiking network, multiplications of the CNN.

A synaptic operation is one spike arriving at one synapse.  It is the counterpart of one
multiply-accumulate of the CNN (Davies et al. 2018).
"""

from __future__ import annotations

from typing import Dict

import numpy as np

from .spec import Layer, NetworkSpec


def fan_out(layer: Layer) -> np.ndarray:
    """Synapses that each neuron of the layer before has onto this layer, shape (n_inputs,).

    Neurons near the edge of a convolution reach fewer positions.
    """
    if layer.kind == "dense":
        return np.full(int(np.prod(layer.input_shape)), layer.size)
    return convolution_fan_out(layer.input_shape, layer.kernel, layer.shape[-1])


def convolution_fan_out(input_shape, kernel: int, filters: int) -> np.ndarray:
    """Synapses of each input of a convolution without padding, stride 1, shape (n_inputs,)."""
    rows, columns, channels = input_shape
    reach = [
        np.minimum.reduce(
            [
                np.arange(1, n + 1),
                np.arange(n, 0, -1),
                np.full(n, min(kernel, n - kernel + 1)),
            ]
        )
        for n in (rows, columns)
    ]
    positions = np.outer(*reach) * filters
    return np.repeat(positions.ravel(), channels)


def multiply_accumulates(spec: NetworkSpec) -> Dict[str, int]:
    """Multiply-accumulates of each layer of the CNN of the same architecture, one inference."""
    return {layer.name: int(fan_out(layer).sum()) for layer in spec.layers}


def synaptic_operations(spec: NetworkSpec, spikes: Dict[str, np.ndarray]) -> Dict[str, np.ndarray]:
    """Synaptic operations by the layer that receives them.

    Parameters
    ----------
    spec : NetworkSpec
    spikes : dict of str to ndarray, shape (..., n_neurons)
        Spikes of each neuron of each spiking layer.

    Returns
    -------
    dict of str to ndarray, shape (...)
        Without an entry for a first layer on the host, which receives currents and no spikes.
    """
    senders = ["input" if spec.encoder else None, *(layer.name for layer in spec.layers[:-1])]
    return {
        layer.name: spikes[sender] @ fan_out(layer)
        for sender, layer in zip(senders, spec.layers)
        if sender is not None
    }
