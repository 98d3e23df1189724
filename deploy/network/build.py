"""Build the Nengo network of a description, for every target."""

from __future__ import annotations

import types
from dataclasses import dataclass

import nengo
import numpy as np
from nengo.builder import transforms

from .blocks import block_shapes, reads_populations
from .convolution import PaddedConvolution
from .geometry import padded_kernel, unpool, windows
from .loihi_import import nengo_loihi
from .spec import Layer, NetworkSpec, Neurons
from .stimulus import EventFrames, Feed


def pad(array, widths, **more):
    """Replacement for :func:`numpy.pad` that copies directly if all widths are 0.

    The copy is necessary: Nengo takes its windows from the memory of a whole array, not of a view.
    """
    return np.pad(array, widths, **more) if any(map(any, widths)) else array.copy()


def pad_only_where_needed():
    """Give Nengo's convolutions a NumPy in which only `pad` is replaced.

    Nengo pads the input of a convolution at each step; without padding NumPy makes a plain copy,
    but only after much Python code: three tenths of the reference simulator's time on the paper's
    network.
    """
    if getattr(transforms, "np", None) is np:
        theirs = types.ModuleType("numpy")
        vars(theirs).update(vars(np), pad=pad)
        transforms.np = theirs


pad_only_where_needed()


class EvenSpikes(nengo.SpikingRectifiedLinear):
    """Neurons with evenly spaced spikes that restart from the same phase after a blank input.

    Parameters
    ----------
    phase : float
        Voltage without input, as a share of the threshold.
    amplitude : float
    """

    phase = nengo.params.NumberParam("phase", low=0, high=1)

    def __init__(self, phase=0.5, amplitude=1.0):
        super().__init__(
            amplitude=amplitude, initial_state={"voltage": nengo.dists.Choice([phase])}
        )
        self.phase = phase

    def step(self, dt, J, output, voltage):
        """One step of Nengo's neurons, then the reset; arrays of any one shape."""
        super().step(dt, J, output, voltage)
        voltage[J <= 0] = self.phase


class Relay(nengo.neurons.NeuronType):
    """Neurons without memory that spike in each step with an input.

    Parameters
    ----------
    amplitude : float
        Area of a spike.
    """

    spiking = True
    amplitude = nengo.params.NumberParam("amplitude", low=0, low_open=True)

    def __init__(self, amplitude=1.0):
        super().__init__()
        self.amplitude = amplitude

    def gain_bias(self, max_rates, intercepts):
        """Not implemented: gain and bias are always set."""
        raise NotImplementedError

    def max_rates_intercepts(self, gain, bias):
        """Not meaningful for these neurons."""
        return np.full_like(gain, np.nan), np.full_like(bias, np.nan)

    def step(self, dt, J, output):
        """One step; arrays of any one shape."""
        output[...] = (J > 0) * (self.amplitude / dt)


@dataclass(frozen=True)
class Built:
    """A Nengo network, with the objects to feed and read it.

    Attributes
    ----------
    network : nengo.Network
    feed : Feed
    output : nengo.Probe
        The readout at each step: decoded values on the host, those of all parts of the
        presentation (:func:`deploy.network.responses.select_readout`), or spikes of output
        neurons on the
        chip.
    spikes : dict of str to nengo.Probe
        Spikes of each spiking layer, in order.
    """

    network: nengo.Network
    feed: Feed
    output: nengo.Probe
    spikes: dict


def build(spec: NetworkSpec, seed: int = 0) -> Built:
    """Build the network in Nengo.

    The convolutions onto the chip come from ``Neurons``, with their biases in the ensembles, so
    that the network needs no host-to-chip decoders and fits NengoLoihi's ``precompute`` mode.

    Parameters
    ----------
    spec : NetworkSpec
    seed : int
        The network is not random, but NengoLoihi requires a seed.

    Returns
    -------
    Built
    """
    feed = Feed(spec.presentation, int(np.prod(spec.input_shape)))
    spikes = {}
    blocks = block_shapes(spec.layers)
    with nengo.Network(label=spec.architecture, seed=seed) as network:
        nengo_loihi.add_params(network)
        pixels = nengo.Node(feed, size_out=feed.blank.size, label="pixels")
        neurons = _input_neurons(spec)
        network.config[neurons].on_chip = False
        nengo.Connection(pixels, neurons.neurons, synapse=None)
        source = neurons.neurons
        spikes["input"] = nengo.Probe(source)
        for layer in spec.layers:
            if layer.neurons is None:
                target = nengo.Node(size_in=layer.parts * layer.size, label=layer.name)
            else:
                ensemble = _ensemble(layer, layer.neurons)
                network.config[ensemble].on_chip = True
                network.config[ensemble].block_shape = nengo_loihi.BlockShape(
                    blocks[layer.name], layer.shape
                )
                target = ensemble.neurons
            transform, inputs = _transform(layer)
            nengo.Connection(
                source if inputs is None else source[inputs],
                target,
                transform=transform,
                synapse=layer.synapse,
            )
            if layer.recurrent is not None:
                # Without a filter Nengo needs one of no duration, which takes the step that a
                # spike takes on the chip.
                synapse = nengo.Lowpass(0) if layer.synapse is None else layer.synapse
                back = nengo.Dense(layer.recurrent.shape, init=layer.recurrent)
                nengo.Connection(target, target, transform=back, synapse=synapse)
            output = nengo.Probe(target)
            if layer.neurons is not None:
                spikes[layer.name] = output
            source = target
    return Built(network, feed, output, spikes)


def _input_neurons(spec):
    stimulus = spec.stimulus
    if isinstance(stimulus, EventFrames):
        neuron_type = Relay(amplitude=stimulus.area)
        gain = 1.0
    else:
        neuron_type = EvenSpikes(stimulus.initial_phase, amplitude=stimulus.area)
        gain = stimulus.max_rate
    n = int(np.prod(spec.input_shape))
    return _neurons(n, neuron_type, np.full(n, gain), np.zeros(n), "input")


def _ensemble(layer: Layer, neurons: Neurons):
    neuron_type = nengo_loihi.neurons.LoihiLIF(
        tau_rc=neurons.tau_rc,
        tau_ref=neurons.tau_ref,
        min_voltage=neurons.min_voltage,
        amplitude=neurons.amplitude,
    )
    per_channel = layer.size // layer.bias.size
    bias = np.tile(layer.bias, per_channel)  # channels are the last and fastest dimension
    return _neurons(layer.size, neuron_type, np.ones(layer.size), bias, layer.name)


def _neurons(n, neuron_type, gain, bias, label):
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


def _transform(layer: Layer):
    """The transform of the layer's weights with pooling folded in, and the inputs it reads.

    Average pooling over P x P values without overlap, followed by a convolution with a kernel of
    size K and a stride S, is one convolution with a kernel of size K P and a stride of S P.

    Returns
    -------
    nengo.transforms.Transform
    inputs : list of int or None
        None for all of them.
    """
    if layer.kind == "dense" and reads_populations(layer):
        return _population_transform(layer)
    if layer.kind == "dense":
        weights = layer.weights
        before = int(np.prod(layer.input_shape))
        if layer.pool > 1:
            by_place = np.moveaxis(weights.reshape(len(weights), *layer.read_shape), 0, -1)
            by_place = unpool(by_place, layer.input_shape, layer.pool) / layer.pool**2
            weights = np.moveaxis(by_place, -1, 0).reshape(-1, before)
        return nengo.Dense((len(weights), before), init=weights), None
    kernel = layer.weights
    input_shape = layer.input_shape
    inputs = None
    if layer.padding not in ("valid", "same"):
        sizes = [
            padded_kernel(n, layer.kernel, layer.stride, layer.padding)
            for n in layer.read_shape[:2]
        ]
        edges = [(0, size - layer.kernel) for size in sizes]
        kernel = np.pad(kernel, (*edges, (0, 0), (0, 0)))
    if layer.pool > 1:
        kernel, input_shape = _pooled_kernel(layer, kernel)
        inputs = _inputs_within(layer, input_shape)
    shapes = {
        "n_filters": layer.shape[-1],
        "input_shape": input_shape,
        "kernel_size": kernel.shape[:2],
        "strides": (layer.stride * layer.pool,) * 2,
    }
    if layer.padding in ("valid", "same"):
        return nengo.Convolution(padding=layer.padding, init=kernel, **shapes), inputs
    zeros = int(layer.padding) * layer.pool
    return PaddedConvolution(zeros, init=kernel, **shapes), inputs


def _inputs_within(layer, input_shape):
    """Numbers of the inputs in the first rows and columns, or None for all of them.

    Values outside of complete pooling windows are not read.
    """
    if input_shape == layer.input_shape:
        return None
    places = np.arange(np.prod(layer.input_shape)).reshape(layer.input_shape)
    return places[: input_shape[0], : input_shape[1]].ravel().tolist()


def _population_transform(layer):
    """A dense layer as a convolution whose only window is the whole input; see `_transform`."""
    kernel = np.moveaxis(layer.weights.reshape(layer.size, *layer.read_shape), 0, -1)
    kernel = kernel.repeat(layer.pool, axis=0).repeat(layer.pool, axis=1) / layer.pool**2
    input_shape = kernel.shape[:3]
    transform = nengo.Convolution(
        n_filters=layer.size,
        input_shape=input_shape,
        kernel_size=input_shape[:2],
        init=kernel,
    )
    return transform, _inputs_within(layer, input_shape)


def _pooled_kernel(layer, kernel):
    """A kernel that includes average pooling, and the shape of its input.

    With padding it may need zeros: Nengo puts half of the padding, rounded down, before the values,
    whereas half of the padding of pooled values is a whole number of windows.
    """
    pool = layer.pool
    stride = layer.stride * layer.pool
    kernel = kernel.repeat(pool, axis=0).repeat(pool, axis=1) / pool**2
    if layer.padding == "valid":
        return kernel, layer.input_shape
    cut = tuple(n * pool for n in layer.read_shape[:2])
    if layer.padding != "same":
        return kernel, (*cut, layer.input_shape[2])
    wanted = [
        pool * windows(n, layer.kernel, layer.stride, "same")[1] for n in layer.read_shape[:2]
    ]
    for zeros in (0, pool):
        size = len(kernel) + zeros
        front = [windows(n, size, stride, "same")[1] - pad for n, pad in zip(cut, wanted)]
        if all(0 <= n <= zeros for n in front):
            break
    pads = [(n, zeros - n) for n in front]
    return np.pad(kernel, (*pads, (0, 0), (0, 0))), (*cut, layer.input_shape[2])
