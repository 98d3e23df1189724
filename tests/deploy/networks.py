"""More small networks with random weights, and bundles of such networks."""

from dataclasses import replace

import numpy as np

from deploy.check.bundle import CheckSet, write_bundle
from deploy.conformance.networks import (
    draw_images,
    make_convolution,
    make_dense,
    make_image_network,
    make_readout,
    make_two_convolutions,
)
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes


def make_mixed_network(seed=0):
    """8x8-4c3s2p-2a-9-4o: a stride, "same" padding, pooling, a dense layer, several cores each."""
    rng = np.random.default_rng(seed)
    conv1 = replace(
        make_convolution("conv1", (8, 8, 1), 4, 3, rng, stride=2, padding="same"),
        block_shape=(3, 4, 2),
    )
    dense1 = replace(make_dense("dense1", conv1.shape, 9, rng, pool=2), block_shape=(4,))
    return NetworkSpec(
        architecture="8x8-4c3s2p-2a-9-4o",
        input_shape=(8, 8, 1),
        stimulus=ImageSpikes(),
        layers=(conv1, dense1, make_readout((9,), rng, classes=4)),
        presentation=Presentation(steps=30, gap=5, readout_start=8, stream_length=3),
        provenance={"simulated": True, "weights": "random"},
    )


def make_paper_network(seed=0, **presentation):
    """10x10-6c4-24c3-10o, the size of the paper's network."""
    spec = make_two_convolutions(10, (6, 4), (24, 3), seed)
    return replace(spec, presentation=Presentation(**presentation))


def draw_checks(spec, count, seed=0):
    """Sparse random images as the samples of a check."""
    rng = np.random.default_rng(seed)
    images = draw_images(spec, count, rng)
    names = tuple(f"random/{i:03d}" for i in range(count))
    return CheckSet(images, rng.integers(0, 10, count), names, seed)


def bundle_at(path, spec=None, count=7):
    """A bundle of random weights and random images."""
    spec = spec or make_image_network()
    return write_bundle(path, spec, draw_checks(spec, count))
