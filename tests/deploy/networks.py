"""Small networks with random weights that fire, for tests that need no training."""

import numpy as np

from deploy.check.bundle import CheckSet, write_bundle
from deploy.network.geometry import compute_pooled_shape
from deploy.network.layer import Layer, Neurons
from deploy.network.ops.conv import DeployedConvolution
from deploy.network.ops.dense import DeployedDense
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames, ImageSpikes

LIF = Neurons(amplitude=0.01)


def conv(name, input_shape, filters, kernel, rng, block_shape=None, scale=1.0, pool=1, **geometry):
    """A convolution of LIF neurons on the chip, silent up to an input of about 0.

    ``stride`` and ``padding`` as the operation has them.
    """
    read = compute_pooled_shape(input_shape, pool)
    weights = rng.normal(size=(kernel, kernel, read[2], filters))
    return Layer(
        name=name,
        operation=DeployedConvolution(filters, kernel, **geometry),
        input_shape=input_shape,
        neurons=LIF,
        synapse=0.005,
        block_shape=block_shape,
        weights=scale * 3 * weights / np.sqrt(weights[..., 0].size),
        bias=rng.uniform(0.9, 1.1, filters),
        pool=pool,
    )


def dense(name, input_shape, units, rng, block_shape=None, scale=1.0, pool=1):
    """A hidden dense layer of LIF neurons on the chip."""
    size = int(np.prod(compute_pooled_shape(input_shape, pool) if pool > 1 else input_shape))
    return Layer(
        name=name, operation=DeployedDense(units), input_shape=input_shape,
        neurons=LIF, synapse=0.005, block_shape=block_shape,
        weights=scale * 3 * rng.normal(size=(units, size)) / np.sqrt(size),
        bias=rng.uniform(0.9, 1.1, units), pool=pool,
    )  # fmt: skip


def readout(input_shape, rng, classes=10, on_chip=False, starts=(0,)):
    """A linear readout on the host, or a layer of output neurons on the chip."""
    size = int(np.prod(input_shape))
    return Layer(
        name="output",
        operation=DeployedDense(classes),
        input_shape=input_shape,
        neurons=LIF if on_chip else None,
        synapse=0.005,
        weights=rng.normal(size=(len(starts) * classes, size))
        * (3 if on_chip else 1)
        / np.sqrt(size),
        bias=np.full(classes, 1.0) if on_chip else rng.normal(size=classes),
        starts=starts,
    )


def small_spec(seed=0, on_chip_output=False, **presentation):
    """6x6-4c3-8c2-10o, shown for a short time."""
    rng = np.random.default_rng(seed)
    shown = {"steps": 30, "gap": 5, "readout_start": 8, "stream_length": 3, **presentation}
    conv1 = conv("conv1", (6, 6, 1), 4, 3, rng)
    conv2 = conv("conv2", conv1.shape, 8, 2, rng)
    return NetworkSpec(
        architecture="6x6-4c3-8c2-10o",
        input_shape=(6, 6, 1),
        stimulus=ImageSpikes(),
        layers=(conv1, conv2, readout(conv2.shape, rng, on_chip=on_chip_output)),
        presentation=Presentation(**shown),
        provenance={"simulated": True, "weights": "random"},
    )


def mixed_spec(seed=0):
    """8x8-4c3s2p-2a-9-4o: a stride, "same" padding, pooling, a dense layer, several cores each."""
    rng = np.random.default_rng(seed)
    conv1 = conv("conv1", (8, 8, 1), 4, 3, rng, block_shape=(3, 4, 2), stride=2, padding="same")
    dense1 = dense("dense1", conv1.shape, 9, rng, block_shape=(4,), pool=2)
    return NetworkSpec(
        architecture="8x8-4c3s2p-2a-9-4o",
        input_shape=(8, 8, 1),
        stimulus=ImageSpikes(),
        layers=(conv1, dense1, readout((9,), rng, classes=4)),
        presentation=Presentation(steps=30, gap=5, readout_start=8, stream_length=3),
        provenance={"simulated": True, "weights": "random"},
    )


def paper_spec(seed=0, **presentation):
    """10x10-6c4-24c3-10o, the size of the paper's network."""
    rng = np.random.default_rng(seed)
    conv1 = conv("conv1", (10, 10, 1), 6, 4, rng)
    conv2 = conv("conv2", conv1.shape, 24, 3, rng)
    return NetworkSpec(
        architecture="10x10-6c4-24c3-10o",
        input_shape=(10, 10, 1),
        stimulus=ImageSpikes(),
        layers=(conv1, conv2, readout(conv2.shape, rng)),
        presentation=Presentation(**presentation),
        provenance={"simulated": True, "weights": "random"},
    )


def random_checks(spec, count, seed=0):
    """Sparse random images."""
    rng = np.random.default_rng(seed)
    shape = (count, *spec.input_shape)
    images = rng.uniform(size=shape) * (rng.uniform(size=shape) < 0.4)
    names = tuple(f"random/{i:03d}" for i in range(count))
    return CheckSet(images, rng.integers(0, 10, count), names, seed)


def bundle_at(path, spec=None, count=7):
    """A bundle of random weights and random images."""
    spec = spec or small_spec()
    return write_bundle(path, spec, random_checks(spec, count))


def events_spec(seed=0, **presentation):
    """6x6x2-4c4s1-5-3o on frames of events: a convolution and a hidden dense layer."""
    rng = np.random.default_rng(seed)
    shown = {"steps": 20, "gap": 4, "readout_start": 0, "stream_length": 3, **presentation}
    conv1 = conv("conv1", (6, 6, 2), 4, 4, rng, scale=8.0)
    dense1 = Layer(
        name="dense1", operation=DeployedDense(5), input_shape=conv1.shape,
        neurons=LIF, synapse=0.002,
        weights=rng.normal(size=(5, conv1.size)), bias=np.full(5, 0.9),
    )  # fmt: skip
    return NetworkSpec(
        architecture="6x6x2-4c4-5-3o",
        input_shape=(6, 6, 2),
        stimulus=EventFrames(0.01),
        layers=(conv1, dense1, readout((5,), rng, classes=3)),
        presentation=Presentation(**shown),
        provenance={"simulated": True, "weights": "random"},
    )


def random_frames(spec, count, seed=0, share=0.05):
    """Frames of events that end at different steps, uint8."""
    rng = np.random.default_rng(seed)
    steps = spec.presentation.steps
    frames = rng.random((count, steps, *spec.input_shape)) < share
    for frame, end in zip(frames, rng.integers(1, steps + 1, count), strict=True):
        frame[end:] = False
    return frames.astype(np.uint8)
