"""Dense layers; see :mod:`deploy.network.ops.dense` for deployed ones."""

import math
import re
from dataclasses import dataclass

import numpy as np

from models.ops.base import NUMBER, Operation


@dataclass(frozen=True)
class Dense(Operation):
    """A dense layer; its input is flattened in the order (row, column, channel).

    Attributes
    ----------
    units : int
    output : bool
        True for the output layer of the network.
    """

    units: int
    output: bool = False
    noun = "a dense layer"
    token = re.compile(f"{NUMBER}(o?)")

    def __post_init__(self):
        if self.units < 1:
            raise ValueError(f"{self}: units must be at least 1")

    @property
    def kind(self) -> str:  # type: ignore[override]
        """``"dense"`` or ``"output"``."""
        return "output" if self.output else "dense"

    @classmethod
    def from_token(cls, match):
        return cls(int(match[1]), output=bool(match[2]))

    def shape(self, input_shape) -> tuple:
        """(units,)."""
        return (self.units,)

    def weight_shapes(self, input_shape) -> dict:
        """Shapes of ``"kernel"`` (inputs, units) and of ``"bias"``."""
        return {"kernel": (math.prod(input_shape), self.units), "bias": (self.units,)}

    def fan_out(self, input_shape) -> np.ndarray:
        """Synapses that leave each input position, int64, of shape ``input_shape``."""
        return np.full(input_shape, self.units, np.int64)

    def keras_layer(self, name, gain=None):
        from models.keras.keras2 import tf

        if gain is None:
            return tf.keras.layers.Dense(self.units, name=name)
        from models.cnn import OnChipDense

        return OnChipDense(self.units, gain, name=name)

    def sums(self, kernel, frames):
        from models.keras.keras2 import tf

        return tf.matmul(tf.reshape(frames, (-1, kernel.shape[0])), kernel)

    @classmethod
    def from_link(cls, link, output):
        return cls(link.size, output=output)

    @staticmethod
    def currents(link, weights, spikes):
        lead = spikes.shape[:2]
        return (spikes.reshape(-1, spikes.shape[-1]) @ weights).reshape(*lead, -1)

    @staticmethod
    def windows(link, values):
        return values

    @staticmethod
    def deployed_weights(link):
        by_section = link.weights.reshape(len(link.starts), -1, link.size).swapaxes(1, 2)
        return by_section.reshape(-1, by_section.shape[2])

    def __str__(self):
        return f"{self.units}{'o' * self.output}"
