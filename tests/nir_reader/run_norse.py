"""Run a NIR file in Norse: ``run_norse.py NETWORK.nir INPUT.npz OUTPUT.npz``.

It knows nothing of this project but the two files: the graph with its metadata, and ``spikes`` of
shape (n_samples, steps, channels, rows, columns).  ``scores`` and the spikes of each layer go out.
"""

import sys

import nir
import norse.torch
import numpy as np
import torch


def main(network, given, wanted):
    torch.set_num_threads(1)
    graph = nir.read(network)
    about = graph.metadata
    stream_length, start, shown = (
        int(about[name]) for name in ("stream_length", "readout_start", "steps")
    )
    model = norse.torch.from_nir(graph, dt=float(about["dt"]))
    counts = {}
    for name, module in model.named_modules():
        if type(module).__name__ in ("CubaLIF", "LIFBoxCell") and "." not in name:
            counts[name] = 0.0
            module.register_forward_hook(
                lambda _module, _inputs, output, name=name: counts.__setitem__(
                    name, counts[name] + float(output[0].sum())
                )
            )
    spikes = torch.from_numpy(np.load(given, allow_pickle=False)["spikes"])
    scores = []
    with torch.no_grad():
        for sample, steps in enumerate(spikes):
            if sample % stream_length == 0:
                state = None
            output = []
            for step in steps:
                y, state = model(step, state)
                output.append(y.numpy())
            scores.append(np.mean(output[start:shown], axis=0))
    np.savez(
        wanted,
        scores=np.array(scores),
        names=np.array(list(counts), dtype=str),
        counts=np.array([counts[name] for name in counts]),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
