"""Checks that every operation and every target must pass; tests of new ones call them.

``assert_operation_conforms(MyOperation(3), (6, 6, 2))`` and ``assert_target_conforms(my_target)``
find the usual mistakes: wrong shapes and types, sums that Nengo or TensorFlow does not compute, too
few resources counted, numbers that a bundle loses, samples or streams that disturb each other, and
outputs of a target that are not those of the equations.
"""

import itertools
import math
from dataclasses import replace
from functools import partial

import nengo
import numpy as np

from deploy.network.blocks import BlockNeeds, choose_blocks
from deploy.network.chip import LOIHI
from deploy.network.layer import Layer, Neurons
from deploy.network.ops import DEPLOYED_OPERATIONS
from deploy.network.ops.base import DeployedOperation, list_ranges
from deploy.network.ops.dense import DeployedDense
from deploy.network.presentation import Presentation
from deploy.network.reference import make_input_spikes, run_reference
from deploy.network.responses import make_responses
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes
from deploy.preflight.plan import make_plan
from deploy.targets.registry import find_target, run_target
from models.architecture import Architecture, parse
from models.ops import OPERATIONS, Dense, Operation
from tests.deploy.networks import events_spec, random_checks, random_frames, readout, small_spec

SAMPLES = 4


def assert_operation_conforms(operation, input_shape):
    """Try a deployed operation, or one of an architecture, on inputs of a shape.

    It is entered in `DEPLOYED_OPERATIONS`, and one of an architecture in `OPERATIONS`.
    """
    rng = np.random.default_rng(0)
    _assert_meaning(operation, input_shape, rng)
    deployed = _assert_written(operation, input_shape)
    layer = Layer(
        name="tried",
        operation=deployed,
        input_shape=input_shape,
        neurons=Neurons(amplitude=0.01),
        synapse=0.005,
        weights=rng.normal(size=deployed.compute_weight_shape(input_shape)),
        bias=np.ones(deployed.compute_shape(input_shape)[-1]),
    )
    _assert_layer_written(layer)
    _assert_built(layer, rng)
    if isinstance(operation, Operation):
        _assert_trained(operation, input_shape, rng)


def _assert_meaning(operation, input_shape, rng):
    """Its sums are linear, and its synapses are those of its sums."""
    shape = operation.compute_shape(input_shape)
    assert len(shape) in (1, 3), f"shape {shape}: needs one or three dimensions"
    assert all(type(side) is int and side >= 1 for side in shape), f"shape {shape}"
    weights = rng.normal(size=operation.compute_weight_shape(input_shape))
    values = rng.normal(size=(SAMPLES, *input_shape))
    kept = values.copy()
    sums = operation.compute_sums(weights, values)
    assert np.array_equal(values, kept), "compute_sums changes its values"
    assert sums.shape == (SAMPLES, *shape), f"sums of shape {sums.shape}, not {(SAMPLES, *shape)}"
    np.testing.assert_allclose(
        operation.compute_sums(weights, values[:1] + values[1:2]),
        sums[:1] + sums[1:2],
        err_msg="compute_sums is not linear in the values",
    )
    synapses = operation.find_synapses(input_shape)  # refuses other sums than of one weight each
    fan_out = operation.count_fan_out(input_shape)
    assert fan_out.shape == tuple(input_shape)
    np.testing.assert_array_equal(fan_out.ravel(), (synapses >= 0).sum(1), "count_fan_out")
    matrix = operation.make_matrix(weights, input_shape)
    flat = values.reshape(SAMPLES, -1)
    np.testing.assert_allclose(flat @ matrix.T, sums.reshape(SAMPLES, -1), err_msg="make_matrix")
    np.testing.assert_allclose(
        operation.find_largest_weights(weights, input_shape),
        DeployedOperation.find_largest_weights(operation, weights, input_shape),
        err_msg="find_largest_weights",
    )


def _assert_written(operation, input_shape):
    """A bundle has its numbers; return the operation that is read from it."""
    cls = DEPLOYED_OPERATIONS[operation.kind]
    read = cls.from_file(operation.to_file(), operation.compute_shape(input_shape))
    assert type(read) is cls
    assert read.to_file() == operation.to_file(), "to_file and from_file"
    assert read.compute_shape(input_shape) == operation.compute_shape(input_shape), (
        "to_file loses a number"
    )
    return read


def _assert_layer_written(layer):
    """A bundle has the layer, whose numbers beside the operation's are others."""
    arrays = {f"{layer.name}.{name}": getattr(layer, name) for name in layer.arrays}
    read = Layer.from_json(layer.to_json(), arrays, "layers[0]")
    assert read.to_json() == layer.to_json(), "the layer is read differently from a bundle"


def _assert_built(layer, rng):
    """Nengo computes its sums, and a core needs no more than what is counted."""
    transform, inputs = layer.operation.make_transform(layer, LOIHI)
    values = rng.normal(size=layer.operation.count_fan_out(layer.input_shape).size)
    with nengo.Network() as network:
        source = nengo.Node(values)
        target = nengo.Node(size_in=layer.size)
        read = source if inputs is None else source[inputs]
        nengo.Connection(read, target, transform=transform, synapse=None)
        probe = nengo.Probe(target)
    with nengo.Simulator(network, progress_bar=False) as sim:
        sim.run_steps(1)
    np.testing.assert_allclose(
        sim.data[probe], layer.compute_sums(values), atol=1e-9, err_msg="make_transform"
    )
    output = Layer(
        name="output",
        operation=DeployedDense(3),
        input_shape=layer.shape,
        neurons=None,
        synapse=0.005,
        weights=rng.normal(size=(3, layer.size)),
        bias=np.zeros(3),
    )
    if len(layer.input_shape) != 3:
        return
    shown = Presentation(steps=20, gap=2, readout_start=0)
    spec = NetworkSpec("tried", layer.input_shape, ImageSpikes(), (layer, output), shown)
    plan = make_plan(spec)
    assert plan.problems == []
    needs = BlockNeeds(layer)
    block = choose_blocks(spec.layers)[layer.name]
    along = (list_ranges(n, length) for n, length in zip(layer.shape, block, strict=True))
    for ranges, core in zip(itertools.product(*along), plan.cores, strict=True):
        axons, words = needs.count(ranges)
        assert axons >= core.used["input axons"], "resources counts too few axons"
        assert words >= core.used["synapse words"], "resources counts too few words"


def _assert_trained(operation, input_shape, rng):
    """TensorFlow computes its sums, and so do the synapses of the compiled functions."""
    from models.spiking.compiled import sum_inputs

    if len(input_shape) == 3 and operation.kind in OPERATIONS:
        output = Dense(3, output=True)
        text = str(Architecture(input_shape, (operation, output)))
        assert parse(text).layers[0] == operation, f"the notation {text} is read differently"
    shapes = operation.list_array_shapes(input_shape)
    assert shapes["bias"] == operation.compute_shape(input_shape)[-1:]
    kernel = rng.normal(size=shapes["kernel"]).astype(np.float32)
    spikes = (rng.random((SAMPLES, *input_shape)) < 0.3).astype(np.float32)
    weights = operation.to_deployed(kernel)
    assert weights.shape == operation.compute_weight_shape(input_shape), "to_deployed"
    sums = operation.compute_sums(weights, spikes).reshape(SAMPLES, -1)
    result = np.reshape(operation.compute_tensor_sums(kernel, spikes), (SAMPLES, -1))
    np.testing.assert_allclose(result, sums, atol=1e-4, err_msg="compute_tensor_sums")
    synapses = operation.make_synapses(input_shape)
    by_synapse = np.empty((1, *sums.shape), np.float32)
    sum_inputs(
        spikes.reshape(1, SAMPLES, -1).astype(np.uint8),
        np.ones((1, math.prod(input_shape)), np.float32),
        *synapses.arrays,
        kernel.reshape(-1, synapses.width),
        by_synapse,
    )
    np.testing.assert_allclose(by_synapse[0], sums, atol=1e-4, err_msg="make_synapses")
    reads = (operation.find_synapses(input_shape) >= 0).sum(0).max()
    assert operation.count_fan_in(input_shape) >= reads >= 1, "count_fan_in"


def assert_target_conforms(target, computes_network: bool = True, options=None):
    """Try a target on images, on events, and on a readout in sections.

    It need not be entered in `TARGETS`.  Its readout and spikes must be those of the chip's
    emulator if it is exact, and otherwise similar to those of
    :func:`deploy.network.reference.run_reference`, unless it does not compute the network.  A
    target that computes it only with some options, such as noise of 0, is tried with these.
    """
    if options is not None:
        target = replace(target, run=partial(target.run, options=options))
    images = small_spec(stream_length=3)
    samples = random_checks(images, 5).inputs
    _assert_streams(target, images, samples)
    if computes_network:
        _assert_values(target, images, samples)
    on_chip = small_spec(on_chip_output=True, stream_length=2)
    _assert_streams(target, on_chip, random_checks(on_chip, 3).inputs)
    events = events_spec(stream_length=2)
    output = readout((5,), np.random.default_rng(0), classes=3, starts=(0, 12))
    for spec in (events, replace(events, layers=(*events.layers[:2], output))):
        _assert_streams(target, spec, random_frames(spec, 3))


def _assert_values(target, spec, samples):
    """Its outputs are those of the chip's integers, or about those of the equations."""
    stream = spec.flatten_samples(samples)[: spec.presentation.stream_length]
    run_expected = find_target("fast").run if target.is_exact else run_reference
    (expected,) = run_expected(spec, [stream], 0)
    (result,) = target.run(spec, [stream], 0)
    actual = _sum_tenths(result.readout)
    reference = _sum_tenths(expected.readout)
    error = np.abs(actual - reference).max() / np.abs(reference).max()
    assert error < 0.1, f"the readout differs by {error:.0%} from the expected one"
    for name, spikes in (result.spikes or {}).items():
        total = np.sum(expected.spikes[name])
        difference = abs(np.sum(spikes) - total) / total
        assert difference < 0.1, f"{name} has {difference:.0%} more or fewer spikes"


def _sum_tenths(readout):
    """The readout summed over tenths of the presentation, shape (n_samples, 10, classes)."""
    return np.stack([part.sum(1) for part in np.array_split(readout, 10, axis=1)], axis=1)


def _assert_streams(target, spec, samples):
    """Its output has the right shapes, and a stream begins with a fresh network."""
    flat = spec.flatten_samples(samples)
    streams = [flat[stream] for stream in spec.presentation.list_streams(len(flat))]
    outputs = list(target.run(spec, streams, 0))
    assert len(outputs) == len(streams), f"{len(outputs)} outputs of {len(streams)} streams"
    for output, stream in zip(outputs, streams, strict=True):
        make_responses(spec, output, len(stream), target.name)
    (alone,) = target.run(spec, streams[-1:], 0)
    np.testing.assert_array_equal(
        alone.readout, outputs[-1].readout, "a stream depends on the streams before it"
    )
    (first,) = target.run(spec, [streams[0][:1]], 0)
    np.testing.assert_array_equal(
        first.readout[0], outputs[0].readout[0], "a sample depends on the samples after it"
    )
    if outputs[0].spikes is not None:
        sent = make_input_spikes(spec, streams[0]).reshape(len(streams[0]), -1, flat.shape[-1])
        np.testing.assert_array_equal(
            outputs[0].spikes["input"], sent.sum(1), "the input neurons spike at other times"
        )
    if target.is_exact:
        expected = run_target(spec, samples, "fast").spike_hashes
        result = np.concatenate([output.spike_hashes for output in outputs])
        np.testing.assert_array_equal(result, expected, "spikes differ from the emulator's")
