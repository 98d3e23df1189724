"""Average pooling in the notation of architectures.

It is not an operation: a link and a deployed layer have the pooling before their operation as a
property.
"""

import re
from dataclasses import dataclass

import numpy as np

from deploy.network.geometry import count_windows
from models.ops.base import NUMBER, NotatedLayer


@dataclass(frozen=True)
class Pooling(NotatedLayer):
    """Average pooling over square windows that do not overlap.

    Attributes
    ----------
    size : int
        Side length of a window, and the stride.
    """

    size: int
    kind = "pool"
    noun = "a pooling"
    examples = ("2a",)
    token = re.compile(f"{NUMBER}a")
    is_spatial = True
    has_neurons = False

    def __post_init__(self):
        if self.size < 1:
            raise ValueError(f"{self}: the size must be at least 1")

    def compute_shape(self, input_shape):
        """Shape of the averages."""
        rows, columns, channels = input_shape
        if self.size > min(rows, columns):
            raise ValueError(f"does not fit: its window is larger than its {rows}x{columns} input")
        return (rows // self.size, columns // self.size, channels)

    def list_array_shapes(self, input_shape):
        """As `Operation.list_array_shapes`: it has no weights."""
        return {}

    def count_fan_out(self, input_shape):
        """As `DeployedOperation.count_fan_out`: 1, or 0 outside of complete windows."""
        reach = [
            count_windows(n, outputs, self.size, self.size, 0)
            for n, outputs in zip(input_shape[:2], self.compute_shape(input_shape), strict=False)
        ]
        return np.repeat(np.outer(*reach)[..., None], input_shape[2], axis=2)

    def make_keras_layer(self, name, gain=None):
        """As `Operation.make_keras_layer`."""
        from models.keras.keras2 import tf

        return tf.keras.layers.AveragePooling2D(self.size, name=name)

    def __str__(self):
        return f"{self.size}a"
