"""Operations of a notation: convolution, pooling and dense layers, one file each.

`OPERATIONS` has their classes by kind.  What a deployed layer needs without TensorFlow is in
:mod:`deploy.network.ops`.  To add an operation, write one class here and one there, and enter the
class in this `OPERATIONS` and an instance of the other in that of :mod:`deploy.network.ops`.
"""

from models.ops.base import Operation, Synapses
from models.ops.conv import Convolution
from models.ops.dense import Dense
from models.ops.pool import Pooling

OPERATIONS: dict[str, type[Operation]] = {
    "conv": Convolution,
    "pool": Pooling,
    "dense": Dense,
}

__all__ = ["OPERATIONS", "Convolution", "Dense", "Operation", "Pooling", "Synapses"]
