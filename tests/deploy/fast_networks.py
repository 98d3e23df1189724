"""Random bundle networks, and networks whose integers overflow."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from deploy.network.build import build_nengo_network
from deploy.network.geometry import compute_pooled_shape
from deploy.network.layer import Layer, Neurons
from deploy.network.loihi_import import nengo_loihi
from deploy.network.ops.conv import DeployedConvolution
from deploy.network.ops.dense import DeployedDense
from deploy.network.presentation import Presentation
from deploy.network.simulation import present_samples
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames, ImageSpikes

LOUD = 300.0


def random_neurons(rng):
    """Refractory periods of 0 to 3 or 200 steps; minimum voltages."""
    return Neurons(
        amplitude=rng.choice([0.005, 0.01, 0.02]),
        tau_rc=rng.choice([0.002, 0.02, 0.1]),
        tau_ref=rng.choice([0.0, 0.001, 0.002, 0.003, 0.2]),
        min_voltage=rng.choice([0.0, 0.0, -0.7, -6.0, -1e6]),
    )


def random_spec(seed):
    """Any network that a bundle can describe, but small."""
    rng = np.random.default_rng(seed)
    input_shape = shape = (*(int(n) for n in rng.integers(3, 9, 2)), int(rng.integers(1, 3)))
    layers = []
    # Weights of every size: silent networks, usual ones, and loud ones, whose integers overflow.
    size = rng.choice([0.0, 0.5, 1.0, 2.0, 3.0, 30.0, LOUD, LOUD])
    n_convs = rng.integers(0, 3)
    for index in range(n_convs):
        layers.append(_convolution(rng, f"conv{index + 1}", shape, size))
        shape = layers[-1].shape
    for index in range(rng.integers(0 if n_convs else 1, 3)):
        layers.append(_dense(rng, f"dense{index + 1}", shape, size))
        shape = layers[-1].shape
    layers = [_perhaps_recurrent(np.random.default_rng([seed, 1]), x, size) for x in layers]
    layers.append(_output(rng, shape, size))
    steps = 40 if size == LOUD else int(rng.integers(6, 30))
    if rng.random() < 0.3:
        stimulus = EventFrames()
    else:
        stimulus = ImageSpikes(rng.choice([200.0, 500.0, 1000.0]), rng.choice([0, 0.5]))
    return NetworkSpec(
        architecture="random",
        input_shape=input_shape,
        stimulus=stimulus,
        layers=tuple(layers),
        presentation=Presentation(
            steps=steps,
            gap=int(rng.integers(0, 7)),
            readout_start=int(rng.integers(0, steps)),
            stream_length=2,
        ),
    )


def _convolution(rng, name, before, size):
    pool = int(rng.choice([1, 1, 2, 3])) if min(before[:2]) >= 3 else 1
    read = compute_pooled_shape(before, pool)
    padding = str(rng.choice(["valid", "valid", "same"]))
    kernel = int(rng.integers(1, (3 if padding == "same" else min(3, *read[:2])) + 1))
    stride = int(rng.choice([1, 1, 2, 3]))
    filters = int(rng.choice([1, 3, 4]))
    operation = DeployedConvolution(filters, kernel, stride, padding)
    block = [int(rng.integers(1, n + 1)) for n in operation.compute_shape(read)]
    weights = _weights(rng, size, (kernel, kernel, before[2], filters))
    return Layer(
        name=name,
        operation=operation,
        input_shape=before,
        neurons=random_neurons(rng),
        synapse=rng.choice([0.02, 0.1]) if size == LOUD else rng.choice([None, 0.002, 0.005]),
        block_shape=tuple(block),
        weights=weights,
        bias=rng.normal(1.2, 1, filters),
        pool=pool,
    )


def _dense(rng, name, before, size):
    pool = int(rng.choice([1, 2])) if len(before) == 3 and min(before[:2]) >= 2 else 1
    read = compute_pooled_shape(before, pool) if pool > 1 else before
    units = int(rng.integers(2, 9))
    return Layer(
        name=name,
        operation=DeployedDense(units),
        input_shape=before,
        neurons=random_neurons(rng),
        synapse=rng.choice([0.02, 0.1]) if size == LOUD else rng.choice([None, 0.002, 0.005]),
        block_shape=(int(rng.integers(1, units + 1)),),
        weights=_weights(rng, size, (units, int(np.prod(read)))),
        bias=rng.normal(1.2, 1, units),
        pool=pool,
    )


def _perhaps_recurrent(rng, layer, size):
    if layer.kind == "conv" or rng.random() < 0.6:
        return layer
    recurrent = _weights(rng, size, layer.shape * 2)
    return replace(layer, recurrent=recurrent, synapses_per_weight=int(rng.integers(1, 4)))


def _weights(rng, size, shape):
    if size == LOUD:  # all near the largest, and of one sign
        return size * rng.uniform(0.9, 1, shape) * rng.choice([-1, 1, 1, 1])
    return rng.normal(0, size, shape)


def _output(rng, before, size):
    classes = int(rng.integers(2, 6))
    on_chip = rng.random() < 0.25
    return Layer(
        name="output",
        operation=DeployedDense(classes),
        input_shape=before,
        neurons=random_neurons(rng) if on_chip else None,
        synapse=rng.choice([None, 0.005]),
        block_shape=(int(rng.integers(1, classes + 1)),) if on_chip else None,
        weights=_weights(rng, max(size, 1.0), (classes, int(np.prod(before)))),
        bias=rng.normal(0, 0.5, classes),
    )


def loud_spec(filters, sign):
    """36 neurons a filter, all spiking at every other step, onto three with one large weight."""
    conv = Layer(
        name="conv1",
        operation=DeployedConvolution(filters, 1),
        input_shape=(6, 6, 1),
        neurons=Neurons(amplitude=0.01),
        synapse=None,
        weights=np.full((1, 1, 1, filters), 1000.0),
        bias=np.zeros(filters),
    )
    output = Layer(
        name="output",
        operation=DeployedDense(3),
        input_shape=(6, 6, filters),
        neurons=Neurons(amplitude=1.0),
        synapse=0.1,
        weights=np.full((3, 36 * filters), sign * 3.0),
        bias=np.array([-9.0, 0.0, 9.0]),
    )
    presentation = Presentation(steps=60, gap=3, readout_start=0)
    return NetworkSpec("loud", (6, 6, 1), ImageSpikes(1000.0), (conv, output), presentation)


def images_for(spec, n, seed=0):
    """Images between 0 and 1, some pixels of them black, shape (n, n_pixels), or event frames."""
    rng = np.random.default_rng(seed)
    if not spec.stimulus.is_static:
        shape = (n, *spec.stimulus.find_sample_shape(spec.input_shape, spec.presentation.steps))
        return spec.stimulus.flatten((rng.random(shape) < 0.2).astype(np.uint8))
    shape = (n, int(np.prod(spec.input_shape)))
    return rng.random(shape) * (rng.random(shape) < 0.7)


def overflows_of(spec, images) -> np.ndarray:
    """Overflows in q0, current and u2 of NengoLoihi's emulator on one stream, shape (3,)."""
    built, counts = build_nengo_network(spec), np.zeros(3, int)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:

            def counting(x, bits, name=None):
                _, over = nengo_loihi.builder.discretize.overflow_signed(x, bits=bits, out=x)
                counts[("q0", "current", "u2").index(name)] += over.sum()

            sim.sims["emulator"].compartment._overflow = counting
            list(present_samples(built, sim, images))
    return counts
