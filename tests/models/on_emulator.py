"""A network of `models.spiking` in Nengo, with what makes NengoLoihi's emulator do the same."""

import nengo
import numpy as np

from deploy.network.loihi_import import nengo_loihi
from models.chain import make_links
from models.integers import derive_parameters

DT = 0.001


def emulate(architecture, integers, frames, gap=0):
    """Show a network on NengoLoihi's emulator one sample.

    Parameters
    ----------
    frames : ndarray of uint8, shape (steps, rows, columns, channels)
    gap : int
        Steps of silence before it.

    Returns
    -------
    spikes : list of ndarray of int64, shape (gap + steps, neurons)
        Of every layer, moved back by the steps that they travel.
    blocks : list of LoihiBlock
        One a layer, discretised.
    """

    def silence(steps):
        return np.zeros((steps, *frames.shape[1:]), frames.dtype)

    shown = np.concatenate([silence(gap), frames, silence(len(integers))])

    def show(t):
        return shown[min(round(t / DT) - 1, len(shown) - 1)].reshape(-1)

    links = {
        link.name: derive_parameters(link, integers[link.name])
        for link in make_links(architecture)[:-1]
    }
    with nengo.Network(seed=0) as model:
        nengo_loihi.add_params(model)
        size = int(np.prod(frames.shape[1:]))
        events = nengo.Node(show, size_out=size)
        relay = nengo.Ensemble(
            size, 1, neuron_type=nengo.SpikingRectifiedLinear(amplitude=DT),
            gain=np.full(size, 1 / DT), bias=np.zeros(size),
        )  # fmt: skip
        model.config[relay].on_chip = False
        nengo.Connection(events, relay.neurons, synapse=None)
        sender, shape, probes = relay, frames.shape[1:], []
        for name, layer in zip(architecture.names, architecture.layers[:-1], strict=False):
            chip = links[name]
            after = layer.compute_shape(shape)
            n = int(np.prod(after))
            neurons = nengo_loihi.neurons.LoihiLIF(
                tau_rc=chip.neurons.tau_rc,
                tau_ref=0,
                min_voltage=chip.neurons.min_voltage,
                amplitude=DT,
            )
            bias = np.tile(chip.bias, n // len(chip.bias))
            ensemble = nengo.Ensemble(n, 1, neuron_type=neurons, gain=np.ones(n), bias=bias)
            if layer.kind == "dense":
                transform = nengo.Dense((n, int(np.prod(shape))), init=chip.kernel.T)
            else:
                transform = nengo.Convolution(
                    layer.filters, shape, strides=(layer.stride,) * 2,
                    kernel_size=(layer.kernel_size,) * 2, padding=layer.padding, init=chip.kernel,
                )  # fmt: skip
            synapse = nengo.Lowpass(chip.synapse) if chip.synapse else None
            nengo.Connection(sender.neurons, ensemble.neurons, transform=transform, synapse=synapse)
            probes.append(nengo.Probe(ensemble.neurons))
            sender, shape = ensemble, after
    with nengo_loihi.Simulator(model, dt=DT, target="sim", progress_bar=False) as simulator:
        simulator.run_steps(len(shown))
        blocks = list(simulator.model.blocks)
        spikes = [simulator.data[probe] > 0 for probe in probes]
    moved = [s[1 + i : 1 + i + gap + len(frames)].astype(np.int64) for i, s in enumerate(spikes)]
    return moved, blocks
