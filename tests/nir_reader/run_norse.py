"""Run a NIR file in Norse: ``run_norse.py NETWORK.nir INPUT.npz OUTPUT.npz``.

It knows nothing of this project but the two files: the graph with its metadata, and ``spikes`` of
shape (n_samples, steps, channels, rows, columns).  Out go ``outputs``, the graph's output at
each step, shape (n_samples, steps, n_classes), and ``spikes.<node>``, the spikes of each neuron of
each spiking node, shape (n_samples, channels, rows, columns).
"""

import sys
import time

import nir
import norse.torch
import numpy as np
import torch


def main(network, given, wanted):
    torch.set_num_threads(1)
    graph = nir.read(network)
    model = norse.torch.from_nir(graph, dt=float(graph.metadata["dt"]))
    stream_length = int(graph.metadata["stream_length"])
    counts = {}
    for name, module in model.named_modules():
        if name in graph.nodes and isinstance(graph.nodes[name], (nir.CubaLIF, nir.LIF, nir.IF)):
            module.register_forward_hook(counter(counts, name))
    spikes = torch.from_numpy(np.load(given, allow_pickle=False)["spikes"])
    outputs, counted = [], {}
    begun = time.perf_counter()
    with torch.no_grad():
        for sample, steps in enumerate(spikes):
            if sample % stream_length == 0:
                state = None
            counts.clear()
            rows = []
            for step in steps:
                y, state = model(step, state)
                rows.append(y.numpy())
            outputs.append(rows)
            for name, count in counts.items():
                counted.setdefault(f"spikes.{name}", []).append(count.numpy())
    np.savez(
        wanted,
        outputs=np.array(outputs),
        seconds=time.perf_counter() - begun,
        **{name: np.array(rows) for name, rows in counted.items()},
    )


def counter(counts, name):
    """A hook that adds up the spikes of a module."""

    def hook(module, inputs, output):
        counts[name] = counts.get(name, 0) + (output[0] > 0).int()

    return hook


if __name__ == "__main__":
    main(*sys.argv[1:])
