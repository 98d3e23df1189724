"""Dense layers; see :mod:`deploy.network.ops.dense` for deployed ones."""

import math
import re
from dataclasses import dataclass

import numpy as np

from deploy.network.ops.dense import DeployedDense
from models.ops.base import NUMBER, Operation, Synapses


@dataclass(frozen=True)
class Dense(Operation, DeployedDense):
    """A dense layer; its input is flattened in the order (row, column, channel).

    Its kernel has the shape (inputs, units).

    Attributes
    ----------
    units : int
    is_output : bool
        True for the output layer of the network.
    """

    is_output: bool = False
    token = re.compile(f"{NUMBER}(o?)")
    noun = "a hidden dense layer"
    examples = ("64",)

    def __post_init__(self):
        if self.units < 1:
            raise ValueError(f"{self}: units must be at least 1")

    @classmethod
    def from_token(cls, match):
        return cls(int(match[1]), is_output=bool(match[2]))

    def compute_kernel_shape(self, pooled_shape):
        return (math.prod(pooled_shape), self.units)

    def to_deployed(self, kernel, n_sections=1):
        by_section = kernel.reshape(n_sections, -1, self.units).swapaxes(1, 2)
        return by_section.reshape(-1, by_section.shape[2])

    def count_fan_in(self, pooled_shape):
        return math.prod(pooled_shape)

    def make_keras_layer(self, name, gain=None):
        from models.keras.keras2 import tf

        if gain is not None:
            return super().make_keras_layer(name, gain)
        return tf.keras.layers.Dense(self.units, name=name)  # which NengoDL converts

    def compute_tensor_sums(self, kernel, frames):
        from models.keras.keras2 import tf

        return tf.matmul(tf.reshape(frames, (-1, kernel.shape[0])), kernel)

    def make_synapses(self, pooled_shape):
        inputs = math.prod(pooled_shape)
        return Synapses(
            np.arange(inputs + 1), np.zeros(inputs, np.int64), np.arange(inputs), self.units
        )

    def gather_inputs(self, values):
        return values.reshape(len(values), -1)

    def __str__(self):
        return f"{self.units}{'o' * self.is_output}"
