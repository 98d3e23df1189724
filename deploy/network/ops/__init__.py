"""The operations that a deployed layer can have, one file each.

`DEPLOYED_OPERATIONS` has their classes by the kind of a layer; :class:`~.base.DeployedOperation`
says what a class has.  :mod:`models.ops` has the rest of each operation, its notation and training.
A package of yours calls :func:`register_deployed_operation` instead, in a plugin
(:mod:`deploy.plugins`).
"""

from typing import Dict, Type

from .base import DeployedOperation
from .conv import DeployedConvolution
from .dense import DeployedDense

DEPLOYED_OPERATIONS: Dict[str, Type[DeployedOperation]] = {
    "conv": DeployedConvolution,
    "dense": DeployedDense,
}

__all__ = ["DEPLOYED_OPERATIONS", "DeployedOperation", "register_deployed_operation"]


def register_deployed_operation(operation: Type[DeployedOperation]):
    """Add what runs an operation of another package, also on hosts without :mod:`models`.

    To register the same class again does nothing: :func:`models.ops.register_operation` does it,
    too, and the order of both does not matter.

    Raises
    ------
    ValueError
        There is another operation of its kind.
    """
    if DEPLOYED_OPERATIONS.setdefault(operation.kind, operation) is not operation:
        raise ValueError(f"operation {operation.kind!r}: there is one already")
