"""Small networks with random weights that fire, and samples for them: tests without training."""

from dataclasses import replace

import numpy as np

from ..network.geometry import compute_pooled_shape
from ..network.layer import Layer, Neurons
from ..network.ops.conv import DeployedConvolution
from ..network.ops.dense import DeployedDense
from ..network.presentation import Presentation
from ..network.spec import NetworkSpec
from ..network.stimulus import EventFrames, ImageSpikes

LIF = Neurons(amplitude=0.01)

# Values of a presentation in which neurons that fire often have tens of spikes.
LONG_PRESENTATION = {"steps": 100, "gap": 5, "readout_start": 0, "stream_length": 8}


def make_convolution(name, input_shape, filters, kernel_size, rng, pool=1, **geometry):
    """A convolution of LIF neurons on the chip, silent up to an input of about 0.

    ``stride`` and ``padding`` as the operation has them.
    """
    channels = compute_pooled_shape(input_shape, pool)[2]
    weights = rng.normal(size=(kernel_size, kernel_size, channels, filters))
    return Layer(
        name=name,
        operation=DeployedConvolution(filters, kernel_size, **geometry),
        input_shape=input_shape,
        neurons=LIF,
        synapse=0.005,
        weights=3 * weights / np.sqrt(weights[..., 0].size),
        bias=rng.uniform(0.9, 1.1, filters),
        pool=pool,
    )


def make_dense(name, input_shape, units, rng, pool=1):
    """A hidden dense layer of LIF neurons on the chip."""
    size = int(np.prod(compute_pooled_shape(input_shape, pool) if pool > 1 else input_shape))
    return Layer(
        name=name,
        operation=DeployedDense(units),
        input_shape=input_shape,
        neurons=LIF,
        synapse=0.005,
        weights=3 * rng.normal(size=(units, size)) / np.sqrt(size),
        bias=rng.uniform(0.9, 1.1, units),
        pool=pool,
    )


def make_readout(input_shape, rng, classes=10, on_chip=False, section_starts=(0,)):
    """A linear readout on the host, or a layer of output neurons on the chip."""
    size = int(np.prod(input_shape))
    weights = rng.normal(size=(len(section_starts) * classes, size)) / np.sqrt(size)
    return Layer(
        name="output",
        operation=DeployedDense(classes),
        input_shape=input_shape,
        neurons=LIF if on_chip else None,
        synapse=0.005,
        weights=(3 if on_chip else 1) * weights,
        bias=np.full(classes, 1.0) if on_chip else rng.normal(size=classes),
        section_starts=section_starts,
    )


def make_image_network(seed=0, on_chip_output=False, **presentation):
    """6x6-4c3-8c2-10o, shown for a short time."""
    shown = {"steps": 30, "gap": 5, "readout_start": 8, "stream_length": 3, **presentation}
    spec = make_two_convolutions(6, (4, 3), (8, 2), seed, on_chip_output)
    return replace(spec, presentation=Presentation(**shown))


def make_two_convolutions(side, first, second, seed=0, on_chip_output=False):
    """A network on square images with two convolutions and ten outputs.

    Parameters
    ----------
    side : int
        Rows and columns of an image.
    first, second : (int, int)
        Number and side length of the filters of each convolution.
    seed : int
    on_chip_output : bool
    """
    rng = np.random.default_rng(seed)
    conv1 = make_convolution("conv1", (side, side, 1), *first, rng)
    conv2 = make_convolution("conv2", conv1.shape, *second, rng)
    layers = "-".join(f"{filters}c{size}" for filters, size in (first, second))
    return NetworkSpec(
        architecture=f"{side}x{side}-{layers}-10o",
        input_shape=(side, side, 1),
        stimulus=ImageSpikes(),
        layers=(conv1, conv2, make_readout(conv2.shape, rng, on_chip=on_chip_output)),
        presentation=Presentation(),
        provenance={"simulated": True, "weights": "random"},
    )


def make_event_network(seed=0, **presentation):
    """6x6x2-4c4s1-5-3o on frames of events: a convolution and a hidden dense layer."""
    rng = np.random.default_rng(seed)
    shown = {"steps": 20, "gap": 4, "readout_start": 0, "stream_length": 3, **presentation}
    conv1 = excite(make_convolution("conv1", (6, 6, 2), 4, 4, rng), scale=8)
    dense1 = Layer(
        name="dense1", operation=DeployedDense(5), input_shape=conv1.shape,
        neurons=LIF, synapse=0.002,
        weights=rng.normal(size=(5, conv1.size)), bias=np.full(5, 0.9),
    )  # fmt: skip
    return NetworkSpec(
        architecture="6x6x2-4c4-5-3o",
        input_shape=(6, 6, 2),
        stimulus=EventFrames(0.01),
        layers=(conv1, dense1, make_readout((5,), rng, classes=3)),
        presentation=Presentation(**shown),
        provenance={"simulated": True, "weights": "random"},
    )


def make_busy_image_network(on_chip_output=False):
    """The network of :func:`make_image_network` with neurons that fire often.

    Roundings change the numbers of spikes in a presentation only a little.
    """
    spec = make_image_network(on_chip_output=on_chip_output, **LONG_PRESENTATION)
    layers = [
        layer if layer.neurons is None else excite(layer, scale=2, more_bias=2)
        for layer in spec.layers
    ]
    return replace(spec, layers=tuple(layers))


def make_busy_event_network(section_starts=(0,), inhibition=0.0):
    """6x6x2-4c4-30-5o on frames of events, with neurons that fire often.

    Parameters
    ----------
    section_starts : tuple of int
        Sections of the readout.
    inhibition : float
        Mean of the sum of the weights from all neurons of the dense layer to one of them, which
        are negative; 0 for a layer that is not recurrent.
    """
    rng = np.random.default_rng(1)
    conv1 = excite(make_convolution("conv1", (6, 6, 2), 4, 4, rng), scale=4)
    dense1 = excite(make_dense("dense1", conv1.shape, 30, rng), scale=1, more_bias=2)
    output = make_readout((30,), rng, classes=5, section_starts=section_starts)
    if inhibition:
        weights = -inhibition * rng.uniform(0, 2, (30, 30)) / 30
        dense1 = replace(dense1, recurrent=weights)
    return NetworkSpec(
        architecture="6x6x2-4c4-30-5o",
        input_shape=(6, 6, 2),
        stimulus=EventFrames(0.01),
        layers=(conv1, dense1, output),
        presentation=Presentation(**LONG_PRESENTATION),
        provenance={"simulated": True, "weights": "random"},
    )


def excite(layer, scale, more_bias=0.0):
    """The layer with larger weights and a larger bias, so that its neurons fire more often."""
    return replace(layer, weights=scale * layer.weights, bias=layer.bias + more_bias)


def draw_images(spec, count, rng):
    """Sparse random images, shape (count, *input_shape)."""
    shape = (count, *spec.input_shape)
    return rng.uniform(size=shape) * (rng.uniform(size=shape) < 0.4)


def draw_frames(spec, count, seed=0, share=0.05):
    """Frames of events that end at different steps, uint8."""
    rng = np.random.default_rng(seed)
    steps = spec.presentation.steps
    frames = rng.random((count, steps, *spec.input_shape)) < share
    for frame, end in zip(frames, rng.integers(1, steps + 1, count)):
        frame[end:] = False
    return frames.astype(np.uint8)


def draw_busy_frames(spec, count, seed=0):
    """Frames with many events at some taxels in the first half, and none in the second, uint8."""
    rng = np.random.default_rng(seed)
    steps = spec.presentation.steps
    rates = 0.5 * rng.random((count, 1, *spec.input_shape)) ** 2
    frames = rng.random((count, steps, *spec.input_shape)) < rates
    frames[:, steps // 2 :] = False
    return frames.astype(np.uint8)
