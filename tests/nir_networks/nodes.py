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


def by_norses_cells():
    """LIFCell, whose current jumps by its input, with the exporter's default and with dt=1."""

    def cell(n):
        values = {"tau_syn_inv": 200.0, "tau_mem_inv": 100.0, "v_leak": 0.0, "v_th": 1.0}
        values = {name: torch.full((n,), value) for name, value in values.items()}
        return norse.LIFCell(norse.LIFParameters(**values))

    for name, dt in (("norse-cells", 1.0), ("norse-cells-scaled", 0.001)):
        network = norse.SequentialState(
            torch.nn.Linear(6, 8), cell(8), torch.nn.Linear(8, 5, bias=False), cell(5)
        ).double()
        for layer in (network[0], network[2]):
            layer.weight.data *= 8
        graph = to_nir(network, torch.zeros(6, dtype=torch.float64), dt=dt)
        yield name, graph, *run(network, (6,))


def by_spikingjelly():
    from spikingjelly.activation_based import functional, layer, neuron
    from spikingjelly.activation_based.nir_exchange import export_to_nir

    nn = torch.nn
    flat = {
        "if": (neuron.IFNode(), neuron.IFNode(), 1e-4),
        "lif": (neuron.LIFNode(tau=2.0), neuron.LIFNode(tau=3.0), 1e-4),
        "added": (neuron.LIFNode(2.0, decay_input=False), neuron.LIFNode(4.0, False), 1e-4),
        "both": (neuron.IFNode(), neuron.ParametricLIFNode(init_tau=3.0), 1e-3),
    }
    networks = {
        name: (nn.Sequential(nn.Linear(6, 8), one, nn.Linear(8, 5), other), (6,), dt)
        for name, (one, other, dt) in flat.items()
    }
    images = nn.Sequential(
        layer.Conv2d(2, 4, 5, stride=2, padding=1), neuron.LIFNode(tau=2.0), layer.AvgPool2d(2),
        layer.Conv2d(4, 6, 3, padding=1, bias=False), neuron.IFNode(), layer.Flatten(),
        nn.Linear(24, 5), neuron.LIFNode(tau=2.0),
    )  # fmt: skip
    networks["images"] = images, (2, 11, 11), 1e-4
    for name, (network, shape, dt) in networks.items():
        for module in network.double():
            if hasattr(module, "weight"):
                module.weight.data *= 6
        sample = torch.zeros(1, *shape, dtype=torch.float64)
        graph = export_to_nir(network, sample, dt=dt)
        functional.reset_net(network)
        inputs = (torch.rand(STEPS, SAMPLES, *shape) < 0.3).double()
        yield f"spikingjelly-{name}", graph, inputs, torch.stack([network(x) for x in inputs])


def by_rockpool():
    from rockpool.nn.combinators import Sequential
    from rockpool.nn.modules import LIFNeuronTorch, LIFTorch, LinearTorch
    from rockpool.nn.modules.torch.nir import to_nir

    values = {"threshold": 1.0, "dt": 1e-3, "tau_mem": 0.02}
    as_chip = {"max_spikes_per_dt": 1, **values}
    kinds = {
        "currents": lambda n: LIFTorch((n, n), tau_syn=0.01, **as_chip),
        "voltages": lambda n: LIFNeuronTorch(n, **as_chip),
        "several": lambda n: LIFTorch((n, n), tau_syn=0.01, **values),
    }
    for name, make in kinds.items():
        network = Sequential(
            LinearTorch((6, 8), has_bias=False), make(8), LinearTorch((8, 5), has_bias=False),
            make(5),
        )  # fmt: skip
        inputs = (torch.rand(SAMPLES, STEPS, 6) < 0.1).float()
        outputs, _, _ = network(inputs)
        graph = to_nir(network, torch.zeros(1, 1, 6))
        yield f"rockpool-{name}", graph, inputs.transpose(0, 1), outputs.detach().transpose(0, 1)


def by_sinabs():
    import sinabs
    from sinabs.activation import MembraneReset, SingleSpike
    from sinabs.layers import IAF, LIF
    from sinabs.nir import to_nir

    as_chip = {"spike_fn": SingleSpike, "reset_fn": MembraneReset(), "min_v_mem": None}
    kinds = {
        "several": lambda n: IAF(min_v_mem=-1.0),
        "iaf": lambda n: IAF(**as_chip),
        "lif": lambda n: LIF(tau_mem=torch.full((n,), 10.0), spike_threshold=torch.ones(n),
                             **as_chip),
    }  # fmt: skip
    for name, make in kinds.items():
        network = torch.nn.Sequential(
            torch.nn.Linear(6, 8, bias=False), make(8), torch.nn.Linear(8, 5), make(5)
        )
        for layer in (network[0], network[2]):
            layer.weight.data *= 40 if name == "lif" else 8
        inputs = (torch.rand(SAMPLES, STEPS, 6) < 0.3).float()
        graph = to_nir(network, inputs[:1])  # with the dimension of time
        sinabs.reset_states(network)
        outputs = network(inputs)
        yield f"sinabs-{name}", graph, inputs.transpose(0, 1), outputs.transpose(0, 1)


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


MAKERS = by_snntorch, by_norse, by_norses_cells, by_spikingjelly, by_rockpool, by_sinabs


def main(folder):
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with torch.no_grad():
        for make in MAKERS:
            for name, graph, inputs, outputs in make():
                nir.write(str(Path(folder) / f"{name}.nir"), graph)
                np.savez(
                    Path(folder) / f"{name}.npz",
                    inputs=inputs.transpose(0, 1).numpy(),
                    outputs=outputs.transpose(0, 1).numpy(),
                )


if __name__ == "__main__":
    main(*sys.argv[1:])
