"""The check that every operation must pass; the test of a new one calls it.

It is :func:`assert_operation_conforms`.
"""

import math

import numpy as np

from deploy.conformance.operations import (
    N_SAMPLES,
    assert_deployed_operation_conforms,
    assert_same_operation,
)
from models.architecture import Architecture, parse_architecture
from models.ops import OPERATIONS, Dense, NotatedLayer, Operation


def assert_operation_conforms(operation: Operation, input_shape):
    """Find the usual mistakes of an operation; each is an error that names the mistake.

    These are the mistakes of
    :func:`~deploy.conformance.operations.assert_deployed_operation_conforms`, and a notation
    without a noun or examples for messages, one that is read differently, or sums that TensorFlow
    does not compute.

    Parameters
    ----------
    operation : Operation
        Its classes are entered in `OPERATIONS` and `DEPLOYED_OPERATIONS`.
    input_shape : tuple of int

    Raises
    ------
    AssertionError
    """
    assert operation.kind in OPERATIONS, (
        f"the operation {operation.kind!r} is not entered in OPERATIONS"
    )
    _assert_words(type(operation))
    assert_deployed_operation_conforms(operation, input_shape)
    _assert_notation(operation, input_shape)
    _assert_trained(operation, input_shape, np.random.default_rng(0))


def _assert_words(kind_of_layer):
    """The messages about notations have a noun and right examples of it."""
    name = kind_of_layer.__name__
    assert kind_of_layer.noun != NotatedLayer.noun, f"{name} has no 'noun', such as 'a convolution'"
    assert kind_of_layer.examples, f"{name} has no 'examples' of its notation"
    for example in kind_of_layer.examples:
        assert kind_of_layer.token.fullmatch(example), (
            f"{name}: the example {example!r} is not in its own notation, "
            f"{kind_of_layer.token.pattern!r}"
        )


def _assert_notation(operation, input_shape):
    """An architecture with the operation is read as it was written."""
    output = Dense(3, is_output=True)
    if len(input_shape) == 3:
        architecture = Architecture(input_shape, (operation, output))
    else:  # an architecture has an image as input, and the layer before has its values in a row
        architecture = Architecture((1, 1, 1), (Dense(*input_shape), operation, output))
    text = str(architecture)
    problem = f"the notation {text} is read differently"
    read = parse_architecture(text)
    assert read.layers[-2] == operation, problem
    assert str(read) == text, problem
    assert_same_operation(operation, read.layers[-2], input_shape, problem)


def _assert_trained(operation, input_shape, rng):
    """TensorFlow computes its sums, and so do the synapses of the compiled functions."""
    from models.spiking.compiled import sum_inputs

    shapes = operation.list_array_shapes(input_shape)
    assert shapes["bias"] == operation.compute_shape(input_shape)[-1:]
    kernel = rng.normal(size=shapes["kernel"]).astype(np.float32)
    spikes = (rng.random((N_SAMPLES, *input_shape)) < 0.3).astype(np.float32)
    weights = operation.to_deployed(kernel)
    assert weights.shape == operation.compute_weight_shape(input_shape), "to_deployed"
    sums = operation.compute_sums(weights, spikes).reshape(N_SAMPLES, -1)
    result = np.reshape(operation.compute_tensor_sums(kernel, spikes), (N_SAMPLES, -1))
    np.testing.assert_allclose(result, sums, atol=1e-4, err_msg="compute_tensor_sums")
    synapses = operation.make_synapses(input_shape)
    by_synapse = np.empty((1, *sums.shape), np.float32)
    sum_inputs(
        spikes.reshape(1, N_SAMPLES, -1).astype(np.uint8),
        np.ones((1, math.prod(input_shape)), np.float32),
        *synapses.arrays,
        kernel.reshape(-1, synapses.width),
        by_synapse,
    )
    np.testing.assert_allclose(by_synapse[0], sums, atol=1e-4, err_msg="make_synapses")
    reads = (operation.find_synapses(input_shape) >= 0).sum(0).max()
    assert operation.count_fan_in(input_shape) >= reads >= 1, "count_fan_in"
