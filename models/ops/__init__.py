"""The operations of a network, convolutions and dense layers, and the pooling before them.

To add an operation, write two classes, and enter each in its table, or from another package,
in a plugin (:mod:`deploy.plugins`), call :func:`register_operation`:

1. A :class:`~deploy.network.ops.base.DeployedOperation` in :mod:`deploy.network.ops` has what runs
   a layer: its shapes, and its sums in NumPy.  It needs no TensorFlow.
2. A class here with the bases :class:`~models.ops.base.Operation` and that class adds the notation
   and the training.
"""

from deploy.network.ops import DeployedOperation, register_deployed_operation
from models.ops.base import NotatedLayer, Operation, Synapses
from models.ops.conv import Convolution
from models.ops.dense import Dense
from models.ops.pool import Pooling

OPERATIONS: dict[str, type[Operation]] = {
    "conv": Convolution,
    "dense": Dense,
}

# Notation of an output layer.
OUTPUT_EXAMPLE = "10o"

__all__ = [
    "OPERATIONS",
    "Convolution",
    "Dense",
    "NotatedLayer",
    "Operation",
    "Pooling",
    "Synapses",
    "register_operation",
]


def register_operation(operation: type[Operation], deployed: type[DeployedOperation]):
    """Add an operation of another package, and what runs it in a bundle.

    A copied bundle has no :mod:`models`: so that it can be run, an entry of its own registers the
    deployed operation (:func:`deploy.network.ops.register_deployed_operation`), in a module that
    imports nothing but :mod:`deploy`.

    Raises
    ------
    ValueError
        The two have different kinds, there is an operation of their kind, or one notation can be
        read as two layers.
    """
    if operation.kind != deployed.kind:
        raise ValueError(f"operation {operation.kind!r}: what runs it is {deployed.kind!r}")
    if operation.kind in OPERATIONS:
        raise ValueError(f"operation {operation.kind!r}: there is one already")
    _refuse_ambiguous_notation(operation)
    register_deployed_operation(deployed)
    OPERATIONS[operation.kind] = operation


def _refuse_ambiguous_notation(operation):
    """Raise a ValueError if an example of one layer is in the notation of another."""
    if operation.token.fullmatch(OUTPUT_EXAMPLE):
        raise ValueError(f"operation {operation.kind!r}: {OUTPUT_EXAMPLE} is an output already")
    for layer in (Pooling, *OPERATIONS.values()):
        for example in layer.examples:
            if operation.token.fullmatch(example):
                raise ValueError(f"operation {operation.kind!r}: {example} is {layer.noun} already")
        for example in operation.examples:
            if layer.token.fullmatch(example):
                raise ValueError(
                    f"operation {operation.kind!r}: its example {example} is {layer.noun} already"
                )
