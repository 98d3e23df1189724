"""The operations that a deployed layer can have, one file each.

`DEPLOYED_OPERATIONS` has their classes by the kind of a layer; :class:`~.base.DeployedOperation`
says what a class has.  :mod:`models.ops` has the rest of each operation, its notation and training.
"""

from typing import Dict, Type

from .base import DeployedOperation
from .conv import DeployedConvolution
from .dense import DeployedDense

DEPLOYED_OPERATIONS: Dict[str, Type[DeployedOperation]] = {
    "conv": DeployedConvolution,
    "dense": DeployedDense,
}

__all__ = ["DEPLOYED_OPERATIONS", "DeployedOperation"]
