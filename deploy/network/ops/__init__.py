"""Operations: the linear maps that a layer's weights can be, one file each.

`OPERATIONS` has them by the kind of a layer.  An operation of another package is an
:class:`~.base.Operation` that is added there.
"""

from .base import Operation
from .conv import CONVOLUTION
from .dense import DENSE

OPERATIONS = {operation.kind: operation for operation in (CONVOLUTION, DENSE)}

__all__ = ["OPERATIONS", "Operation"]
