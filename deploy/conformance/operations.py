"""Checks that every operation of a deployed layer must pass."""

import itertools
from dataclasses import replace

import nengo
import numpy as np

from ..network.blocks import BlockNeeds, choose_blocks
from ..network.chip import LOIHI
from ..network.layer import Layer, Neurons
from ..network.ops import DEPLOYED_OPERATIONS
from ..network.ops.base import DeployedOperation, list_ranges
from ..network.ops.dense import DeployedDense
from ..network.presentation import Presentation
from ..network.spec import NetworkSpec
from ..network.stimulus import ImageSpikes
from ..preflight.plan import make_plan

# Number of samples that sums are computed of.
N_SAMPLES = 4


def assert_deployed_operation_conforms(operation: DeployedOperation, input_shape):
    """Find the usual mistakes of a deployed operation; each is an error that names the mistake.

    These are wrong shapes and types, sums that Nengo does not compute, too few resources counted,
    and numbers that a bundle loses.  :func:`models.conformance.assert_operation_conforms` tries the
    notation and the training, too.

    Parameters
    ----------
    operation : DeployedOperation
        Its class is entered in `DEPLOYED_OPERATIONS`.
    input_shape : tuple of int

    Raises
    ------
    AssertionError
    """
    rng = np.random.default_rng(0)
    assert operation.kind in DEPLOYED_OPERATIONS, (
        f"the operation {operation.kind!r} is not entered in DEPLOYED_OPERATIONS"
    )
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
    if len(input_shape) == 3:
        _assert_counted(layer, rng)
        _assert_pooled(layer, rng)


def _assert_pooled(layer, rng):
    """Require the same with pooling, also with an input outside of complete windows."""
    rows, columns, channels = layer.input_shape
    complete = replace(layer, input_shape=(2 * rows, 2 * columns, channels), pool=2)
    larger = replace(complete, input_shape=(2 * rows + 1, 2 * columns + 1, channels))
    for pooled in (complete, larger):
        _assert_layer_written(pooled)
        _assert_built(pooled, rng)
    _assert_counted(complete, rng)


def assert_same_operation(operation, other, input_shape, loss):
    """Compare the numbers and the sums of an operation with those of one that was read.

    Parameters
    ----------
    operation, other : DeployedOperation
    input_shape : tuple of int
    loss : str
        What has lost a number if they differ.

    Raises
    ------
    AssertionError
    """
    assert other.to_file() == operation.to_file(), f"{loss}: to_file differs"
    shape = operation.compute_weight_shape(input_shape)
    assert other.compute_shape(input_shape) == operation.compute_shape(input_shape), loss
    assert other.compute_weight_shape(input_shape) == shape, loss
    rng = np.random.default_rng(1)
    weights = rng.normal(size=shape)
    values = rng.normal(size=(N_SAMPLES, *input_shape))
    sums = operation.compute_sums(weights, values)
    np.testing.assert_array_equal(
        other.compute_sums(weights, values), sums, err_msg=f"{loss}: the sums differ"
    )


def _assert_meaning(operation, input_shape, rng):
    """Require linear sums, and synapses that are those of the sums."""
    shape = operation.compute_shape(input_shape)
    assert len(shape) in (1, 3), f"shape {shape}: needs one or three dimensions"
    assert all(type(side) is int and side >= 1 for side in shape), f"shape {shape}"
    weights = rng.normal(size=operation.compute_weight_shape(input_shape))
    values = rng.normal(size=(N_SAMPLES, *input_shape))
    kept = values.copy()
    sums = operation.compute_sums(weights, values)
    assert np.array_equal(values, kept), "compute_sums changes its values"
    assert sums.shape == (N_SAMPLES, *shape), (
        f"sums of shape {sums.shape}, not {(N_SAMPLES, *shape)}"
    )
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
    flat = values.reshape(N_SAMPLES, -1)
    np.testing.assert_allclose(flat @ matrix.T, sums.reshape(N_SAMPLES, -1), err_msg="make_matrix")
    np.testing.assert_allclose(
        operation.find_largest_weights(weights, input_shape),
        DeployedOperation.find_largest_weights(operation, weights, input_shape),
        err_msg="find_largest_weights",
    )


def _assert_written(operation, input_shape):
    """Require that a bundle has its numbers; return the operation that is read from it."""
    cls = DEPLOYED_OPERATIONS[operation.kind]
    read = cls.from_file(operation.to_file(), operation.compute_shape(input_shape))
    assert type(read) is cls
    assert_same_operation(operation, read, input_shape, "to_file or from_file loses a number")
    return read


def _assert_layer_written(layer):
    """Require that a bundle has the layer, with distinct names of its own values."""
    arrays = {f"{layer.name}.{name}": getattr(layer, name) for name in layer.arrays}
    read = Layer.from_json(layer.to_json(), arrays, "layers[0]")
    assert read.to_json() == layer.to_json(), "the layer is read differently from a bundle"


def _assert_built(layer, rng):
    """Require that Nengo computes its sums."""
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


def _assert_counted(layer, rng):
    """Require that a core needs no more than what is counted.

    The memory is compared without pooling only: NengoLoihi needs more than is counted for a
    convolution that has zeros around its input and a pooling before it.
    """
    output = Layer(
        name="output",
        operation=DeployedDense(3),
        input_shape=layer.shape,
        neurons=None,
        synapse=0.005,
        weights=rng.normal(size=(3, layer.size)),
        bias=np.zeros(3),
    )
    shown = Presentation(steps=20, gap=2, readout_start=0)
    spec = NetworkSpec("tried", layer.input_shape, ImageSpikes(), (layer, output), shown)
    plan = make_plan(spec)
    assert plan.problems == []
    needs = BlockNeeds(layer)
    block = choose_blocks(spec.layers)[layer.name]
    along = (list_ranges(n, length) for n, length in zip(layer.shape, block))
    for ranges, core in zip(itertools.product(*along), plan.cores):
        axons, words = needs.count(ranges)
        assert axons >= core.used["input axons"], "resources counts too few axons"
        is_counted = layer.pool > 1 or words >= core.used["synapse words"]
        assert is_counted, "resources counts too few words"
