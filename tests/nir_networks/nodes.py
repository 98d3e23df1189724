"""Small networks of every kind of node, run by the packages: ``python nodes.py FOLDER``.

In an environment with the packages of ``tests/nir_reader/requirements.txt``; it knows nothing of
this project.  Of each network FOLDER gets ``<name>.nir``, written by the package's own exporter or
read by its own importer, and ``<name>.npz`` with ``inputs`` and ``outputs`` at each of 200 steps,
shape (3, 200, ...), in double precision.
"""

import sys
from pathlib import Path

import nir
import norse.torch as norse
import numpy as np
import snntorch as snn
import torch
from norse.torch.utils.export_nir import to_nir
from snntorch.export_nir import export_to_nir

# H: seconds of a step in Norse. Its importer keeps parameters in 32 bits, so that these are sums of
# few powers of two.
SAMPLES, STEPS, H = 3, 200, 2.0**-9


def by_snntorch():
    def full(value, shape):
        return torch.full(shape, value, dtype=torch.float64)

    def leaky(*shape):
        return snn.Leaky(
            beta=full(0.9, shape), threshold=full(1.3, shape), init_hidden=True,
            reset_mechanism="zero",
        )  # fmt: skip

    def synaptic(*shape):
        return snn.Synaptic(
            alpha=full(0.8, shape), beta=full(0.9, shape), threshold=full(2.1, shape),
            init_hidden=True, reset_mechanism="zero", reset_delay=False,
        )  # fmt: skip

    def recurrent(kind, n, **options):
        layer = kind(
            beta=full(0.9, (n,)), threshold=full(1.7, (n,)), all_to_all=True, linear_features=n,
            init_hidden=True, **options,
        )  # fmt: skip
        layer.recurrent.weight.data.normal_(0, 0.5)
        return layer

    nn = torch.nn
    loop = nn.Sequential(
        nn.Linear(6, 8), recurrent(snn.RLeaky, 8, reset_mechanism="subtract"),
        nn.Linear(8, 5, bias=False),
        recurrent(snn.RSynaptic, 5, alpha=full(0.8, (5,)), reset_mechanism="subtract"),
    )  # fmt: skip
    flat = nn.Sequential(nn.Linear(6, 8), leaky(8), nn.Linear(8, 5, bias=False), leaky(5))
    current = nn.Sequential(nn.Linear(6, 8, bias=False), synaptic(8), nn.Linear(8, 5), leaky(5))
    images = nn.Sequential(
        nn.Conv2d(2, 4, 3, padding=1, groups=2), leaky(4, 8, 8),
        nn.AvgPool2d(2), nn.Conv2d(4, 6, 2, stride=2, bias=False), leaky(6, 2, 2),
        nn.Flatten(), nn.Linear(24, 5), leaky(5),
    )  # fmt: skip
    for name, network, shape in (
        ("leaky", flat, (6,)),
        ("synaptic", current, (6,)),
        ("images", images, (2, 8, 8)),
        ("recurrent", loop, (6,)),
    ):
        for layer in network.double():
            # snnTorch's spikes have 32 bits
            for module in (layer, *layer.children()):
                module.register_forward_pre_hook(lambda _, inputs: inputs[0].double())
            if hasattr(layer, "weight"):
                layer.weight.data *= 3
        sample = torch.zeros(1, *shape, dtype=torch.float64)
        graph = export_to_nir(network, sample, ignore_dims=[0])
        inputs = (torch.rand(STEPS, SAMPLES, *shape) < 0.3).double()
        snn.Leaky.reset_hidden()
        snn.Synaptic.reset_hidden()
        snn.RLeaky.reset_hidden()
        snn.RSynaptic.reset_hidden()
        yield f"snntorch-{name}", graph, inputs, torch.stack([network(step) for step in inputs])


def by_norse():
    def full(value, *shape):
        return torch.full(shape, value, dtype=torch.float64)

    neurons = norse.LIFBoxParameters(
        full(1 / 0.03, 8), v_th=full(0.11, 8), v_leak=torch.linspace(-0.02, 0.02, 8).double()
    )
    readout = norse.LIBoxParameters(full(1 / 0.05, 5), full(0.2, 5))
    written = norse.SequentialState(
        torch.nn.Linear(6, 8), norse.LIFBoxCell(neurons, dt=H), torch.nn.Linear(8, 5),
        norse.LIBoxCell(readout, dt=H),
    ).double()  # fmt: skip
    written[0].weight.data *= 6
    graph = to_nir(written, torch.zeros(6, dtype=torch.float64), dt=1.0)
    yield "norse-writes", graph, *run(written, (6,))

    rng = np.random.default_rng(0)

    def some(*shape):
        return np.rint(rng.normal(0, 8, shape)) / 8

    def same(value, *shape):
        return np.full(shape, value)

    images = [
        nir.SumPool2d(np.array([2, 2]), np.array([2, 2]), np.array([0, 0])),
        nir.Conv2d((4, 4), some(4, 2, 3, 3), 1, 1, 1, 1, some(4)),
        nir.IF(r=same(1.0, 4, 4, 4), v_threshold=same(8.0, 4, 4, 4)),
        nir.Flatten({"input": np.array([4, 4, 4])}, 0),
        nir.Linear(some(5, 64)),
        nir.IF(r=same(1.0, 5), v_threshold=same(4.0, 5)),
    ]
    flat = [
        nir.Affine(some(8, 6), some(8) / 8),
        nir.CubaLIF(
            tau_syn=same(2.0**-7, 8), tau_mem=same(2.0**-6, 8), r=same(2.0, 8),
            v_leak=same(0.0, 8), v_threshold=same(0.5, 8), w_in=same(1.5, 8),
        ),
        nir.Affine(some(5, 8), some(5) / 8),
        nir.LIF(same(2.0**-6, 5), same(1.0, 5), same(0.0625, 5), same(0.5, 5)),
    ]  # fmt: skip
    for name, shape, nodes in (("integrates", (2, 9, 9), images), ("reads", (6,), flat)):
        ends = nir.Input({"input": np.array(shape)}), nir.Output({"output": np.array([5])})
        graph = nir.NIRGraph.from_list(ends[0], *nodes, ends[1])
        yield f"norse-{name}", graph, *run(norse.from_nir(graph, dt=H).double(), shape)


def run(network, shape):
    """Inputs and outputs, (steps, samples, ...), one sample after the other."""
    inputs = (torch.rand(STEPS, SAMPLES, *shape) < 0.3).double()
    outputs = []
    for sample in inputs.transpose(0, 1):
        state, rows = None, []
        for step in sample:
            row, state = network(step, state)
            rows.append(row)
        outputs.append(torch.stack(rows))
    return inputs, torch.stack(outputs, 1)


def main(folder):
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with torch.no_grad():
        for make in (by_snntorch, by_norse):
            for name, graph, inputs, outputs in make():
                nir.write(str(Path(folder) / f"{name}.nir"), graph)
                np.savez(
                    Path(folder) / f"{name}.npz",
                    inputs=inputs.transpose(0, 1).numpy(),
                    outputs=outputs.transpose(0, 1).numpy(),
                )


if __name__ == "__main__":
    main(*sys.argv[1:])
