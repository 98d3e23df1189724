"""Networks as NengoLoihi's users write them, each with what to look at."""

from __future__ import annotations

import nengo
import nengo_loihi
import numpy as np


def channel(n=40):
    """A communication channel: two ensembles on the chip, the first driven from the host."""
    with nengo.Network(seed=1) as network:
        wave = nengo.Node(lambda t: np.sin(20 * t))
        a, b = nengo.Ensemble(n, 1), nengo.Ensemble(n, 1)
        nengo.Connection(wave, a)
        nengo.Connection(a, b)
        return network, [nengo.Probe(b, synapse=0.01), nengo.Probe(a.neurons)]


def integrator(n=40):
    """An ensemble that is connected to itself."""
    with nengo.Network(seed=1) as network:
        pulse = nengo.Node(lambda t: float(t < 0.03))
        a = nengo.Ensemble(n, 1)
        nengo.Connection(pulse, a, transform=0.1, synapse=0.1)
        nengo.Connection(a, a, synapse=0.1)
        return network, [nengo.Probe(a, synapse=0.01), nengo.Probe(a.neurons, "voltage")]


def recurrent(n=40):
    """Neurons that are connected to neurons, in a loop."""
    weights = np.random.RandomState(3).normal(size=(n, n), scale=1e-2)
    with nengo.Network(seed=1) as network:
        a = nengo.Ensemble(n, 1, intercepts=nengo.dists.Uniform(-0.9, 0))
        nengo.Connection(a.neurons, a.neurons, transform=weights, synapse=0.005)
        return network, [nengo.Probe(a.neurons)]


def learning(n=40):
    """PES on the chip from n neurons; the host computes the error at every step."""
    with nengo.Network(seed=1) as network:
        wave = nengo.Node(lambda t: np.sin(2 * np.pi * t))
        error, result = nengo.Node(size_in=1), nengo.Node(size_in=1)
        ensemble = nengo.Ensemble(n, 1)
        nengo.Connection(wave, ensemble)
        learned = nengo.Connection(
            ensemble, result, function=lambda x: 0, learning_rule_type=nengo.PES(1e-3)
        )
        nengo.Connection(result, error)
        nengo.Connection(wave, error, transform=-1)
        nengo.Connection(error, learned.learning_rule)
        return network, [nengo.Probe(result, synapse=0.02)]


def feedback(n=40):
    """What the chip answers goes through a function on the host and back at every step."""
    with nengo.Network(seed=1) as network:
        host = nengo.Node(lambda t, x: np.cos(20 * t) - 0.5 * x, size_in=1)
        a = nengo.Ensemble(n, 1)
        nengo.Connection(host, a)
        nengo.Connection(a, host, synapse=0.01)
        return network, [nengo.Probe(host), nengo.Probe(a.neurons)]


def convolution(size=8):
    """A layer on the host and two on the chip, with population axons and several blocks."""
    image = np.random.RandomState(0).uniform(-1, 1, size=size * size)
    with nengo.Network(seed=1) as network:
        nengo_loihi.add_params(network)
        ensembles = network.config[nengo.Ensemble]
        ensembles.neuron_type = nengo.SpikingRectifiedLinear(amplitude=1e-2)
        ensembles.max_rates = nengo.dists.Choice([100])
        ensembles.intercepts = nengo.dists.Choice([0])
        network.config[nengo.Connection].synapse = 0.005
        source, shape, layers = nengo.Node(image), (size, size, 1), []
        for filters, stride, on_chip in ((2, 1, False), (4, 1, True), (6, 2, True)):
            transform = nengo.Convolution(
                filters, shape, kernel_size=(3, 3), strides=(stride, stride),
                init=nengo.dists.Uniform(-1, 1),
            )  # fmt: skip
            layer = nengo.Ensemble(transform.output_shape.size, 1)
            if on_chip:
                network.config[layer].block_shape = nengo_loihi.BlockShape(
                    (2, 3, filters), transform.output_shape.shape
                )
            else:
                network.config[layer].on_chip = False
            nengo.Connection(source, layer.neurons, transform=transform)
            source, shape = layer.neurons, transform.output_shape
            layers.append(layer)
        return network, [nengo.Probe(layer.neurons) for layer in layers]


def two_rules(n=40):
    """Two learning rules with errors of three dimensions and of one, worked out on the host."""
    with nengo.Network(seed=6) as network:
        wave = nengo.Node(lambda t: [np.sin(20 * t), 0.5, -t])
        a, b = nengo.Ensemble(n, 3), nengo.Ensemble(n + 11, 3)
        error, three, one = (nengo.Node(lambda t, x: x, size_in=size) for size in (3, 3, 1))
        nengo.Connection(wave, a)
        nengo.Connection(wave, b)
        first = nengo.Connection(
            a, three, function=lambda x: [0, 0, 0], learning_rule_type=nengo.PES(2e-3)
        )
        second = nengo.Connection(
            b, one, function=lambda x: x[0], learning_rule_type=nengo.PES(1e-2)
        )
        nengo.Connection(three, error)
        nengo.Connection(wave, error, transform=-1)
        nengo.Connection(error, first.learning_rule)
        nengo.Connection(error[0], second.learning_rule)
        return network, [nengo.Probe(three), nengo.Probe(one), nengo.Probe(a.neurons)]


def through_the_host(n=40):
    """From the chip to a noisy ensemble on the host and back, by its neurons too; in a loop."""
    weights = np.random.RandomState(1).normal(size=(n, n)) * 1e-3
    with nengo.Network(seed=7) as network:
        nengo_loihi.add_params(network)
        a, b = nengo.Ensemble(n, 1), nengo.Ensemble(n, 1)
        host = nengo.Ensemble(n, 1, noise=nengo.processes.WhiteNoise(seed=1))
        network.config[host].on_chip = False
        nengo.Connection(nengo.Node(nengo.processes.WhiteSignal(1, 5, seed=3)), a)
        nengo.Connection(a, host)
        nengo.Connection(host, b)
        nengo.Connection(host.neurons, b.neurons, transform=weights)
        nengo.Connection(b, a, transform=-0.5, synapse=0.02)
        probes = [nengo.Probe(host, sample_every=0.003), nengo.Probe(b, synapse=0.01)]
        return network, probes


def passthrough(n=30):
    """Arrays of ensembles, whose nodes NengoLoihi may remove, and a probe of some neurons.

    Which connections come first in their stead differs from time to time.
    """
    with nengo.Network(seed=2) as network:
        wave = nengo.Node(lambda t: [np.sin(9 * t), np.cos(5 * t)])
        a, b = nengo.networks.EnsembleArray(n, 2), nengo.networks.EnsembleArray(n, 2)
        nengo.Connection(wave, a.input)
        nengo.Connection(a.output, b.input, transform=[[0, 1], [1, 0]])
        neurons = b.ea_ensembles[0].neurons
        return network, [nengo.Probe(b.output, synapse=0.02), nengo.Probe(neurons[::3], "voltage")]


def several_chips(n=270):
    """More blocks than a chip has cores."""
    with nengo.Network(seed=4) as network:
        nengo_loihi.add_params(network)
        a, b = nengo.Ensemble(n, 1), nengo.Ensemble(20, 1)
        network.config[a].block_shape = nengo_loihi.BlockShape((2,), (n,))
        nengo.Connection(nengo.Node(lambda t: np.sin(20 * t)), a)
        nengo.Connection(a, b)
        return network, [nengo.Probe(b, synapse=0.01), nengo.Probe(a.neurons)]


NETWORKS = {
    "channel": channel,
    "integrator": integrator,
    "recurrent": recurrent,
    "learning": learning,
    "feedback": feedback,
    "convolution": convolution,
    "two rules": two_rules,
    "through the host": through_the_host,
    "several chips": several_chips,
}
