"""Build the Nengo network of a description, for every target."""

from __future__ import annotations

import types
from dataclasses import dataclass

import nengo
import numpy as np
from nengo.builder import transforms

from .blocks import choose_blocks
from .chip import LOIHI, Chip
from .layer import Layer, Neurons
from .loihi_import import nengo_loihi
from .spec import NetworkSpec
from .stimulus import Feed
from .synapses import split_layer


def pad_array(array, widths, **options):
    """Replacement for :func:`numpy.pad` that copies directly if all widths are 0.

    The copy is necessary: Nengo takes its windows from the memory of a whole array, not of a view.
    """
    return np.pad(array, widths, **options) if any(map(any, widths)) else array.copy()


def pad_only_where_needed():
    """Give Nengo's convolutions a NumPy in which only `pad` is replaced.

    Nengo pads the input of a convolution at each step; without padding NumPy makes a plain copy,
    but only after much Python code: three tenths of the reference simulator's time on the paper's
    network.
    """
    if getattr(transforms, "np", None) is np:
        numpy_with_pad = types.ModuleType("numpy")
        vars(numpy_with_pad).update(vars(np), pad=pad_array)
        transforms.np = numpy_with_pad


pad_only_where_needed()


@dataclass(frozen=True)
class BuiltNetwork:
    """A Nengo network, with the objects to feed and read it.

    Attributes
    ----------
    network : nengo.Network
    feed : Feed
    output : nengo.Probe
        The readout at each step: decoded values on the host, those of all sections of the
        presentation (:func:`deploy.network.readout.select_readout`), or spikes of output
        neurons on the chip.
    spikes : dict of str to nengo.Probe
        Spikes of each spiking layer, in order.
    """

    network: nengo.Network
    feed: Feed
    output: nengo.Probe
    spikes: dict


def build_nengo_network(spec: NetworkSpec, seed: int = 0, chip: Chip = LOIHI) -> BuiltNetwork:
    """Build the network in Nengo.

    The convolutions onto the chip come from ``Neurons``, with their biases in the ensembles, so
    that the network needs no host-to-chip decoders and fits NengoLoihi's ``precompute`` mode.

    Parameters
    ----------
    spec : NetworkSpec
    seed : int
        The network is not random, but NengoLoihi requires a seed.
    chip : Chip
        Its limits determine the blocks.

    Returns
    -------
    BuiltNetwork
    """
    feed = Feed(spec.presentation, int(np.prod(spec.input_shape)))
    spikes = {}
    blocks = choose_blocks(spec.layers, chip)
    with nengo.Network(label=spec.architecture, seed=seed) as network:
        nengo_loihi.add_params(network)
        pixels = nengo.Node(feed, size_out=feed.blank.size, label="pixels")
        neurons = _build_input_neurons(spec)
        network.config[neurons].on_chip = False
        nengo.Connection(pixels, neurons.neurons, synapse=None)
        source = neurons.neurons
        area = spec.stimulus.area
        spikes["input"] = nengo.Probe(source)
        for layer in spec.layers:
            target = _add_units(network, layer, blocks)
            for part in split_layer(layer, area, chip):
                _connect(source, target, part, chip)
            output = nengo.Probe(target)
            if layer.neurons is not None:
                spikes[layer.name] = output
                area = layer.neurons.amplitude
            source = target
    return BuiltNetwork(network, feed, output, spikes)


def _add_units(network, layer: Layer, blocks: dict):
    """The neurons of a layer on the chip, or the node of a readout on the host."""
    if layer.neurons is None:
        return nengo.Node(size_in=layer.n_sections * layer.size, label=layer.name)
    ensemble = _build_ensemble(layer, layer.neurons)
    config = network.config[ensemble]
    config.on_chip = True
    config.block_shape = nengo_loihi.BlockShape(blocks[layer.name], layer.shape)
    return ensemble.neurons


def _connect(source, target, layer: Layer, chip: Chip):
    """Connect the neurons before a layer, and its own if it is recurrent, with its neurons."""
    transform, inputs = layer.operation.make_transform(layer, chip)
    nengo.Connection(
        source if inputs is None else source[inputs],
        target,
        transform=transform,
        synapse=layer.synapse,
    )
    if layer.recurrent is not None:
        _connect_to_itself(target, layer.recurrent, layer.synapse)


def _connect_to_itself(target, weights: np.ndarray, synapse: float | None):
    """Connect the neurons of a recurrent layer with each other.

    Without a filter Nengo needs one of no duration, which takes the step that a spike takes on the
    chip.
    """
    lowpass = nengo.Lowpass(0) if synapse is None else synapse
    transform = nengo.Dense(weights.shape, init=weights)
    nengo.Connection(target, target, transform=transform, synapse=lowpass)


def _build_input_neurons(spec):
    neuron_type, gain = spec.stimulus.make_input_neurons()
    n = int(np.prod(spec.input_shape))
    return _make_neurons(n, neuron_type, np.full(n, gain), np.zeros(n), "input")


def _build_ensemble(layer: Layer, neurons: Neurons):
    neuron_type = nengo_loihi.neurons.LoihiLIF(
        tau_rc=neurons.tau_rc,
        tau_ref=neurons.tau_ref,
        min_voltage=neurons.min_voltage,
        amplitude=neurons.amplitude,
    )
    per_channel = layer.size // layer.bias.size
    bias = np.tile(layer.bias, per_channel)  # channels are the last and fastest dimension
    return _make_neurons(layer.size, neuron_type, np.ones(layer.size), bias, layer.name)


def _make_neurons(n, neuron_type, gain, bias, label):
    """An ensemble whose neurons are connected directly.

    Encoders and evaluation points are set explicitly because Nengo would otherwise draw a thousand
    points, and two for each neuron, at every build.
    """
    return nengo.Ensemble(
        n,
        1,
        neuron_type=neuron_type,
        gain=gain,
        bias=bias,
        encoders=np.ones((n, 1)),
        eval_points=np.zeros((1, 1)),
        label=label,
    )
