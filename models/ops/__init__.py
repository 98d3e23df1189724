"""Operations of a notation: convolution, pooling and dense layers, one file each.

`OPERATIONS` has their classes by kind.  What a deployed layer needs without TensorFlow is in
:mod:`deploy.network.ops`.  An operation of another package is a class of either kind that is added
to both.
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
