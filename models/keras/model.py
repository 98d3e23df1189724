"""A layer of a Keras model, and a model as an architecture and its weights."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, NoReturn

import numpy as np

from models.architecture import Architecture
from models.keras.files import ModelFileError

NO_CHAIN = (
    "does not compute what its layers do one after the other; build one chain of layers, each "
    "called once and with its input only"
)

# Images that a model computes together.
BATCH = 256


class Activation(NamedTuple):
    """A function after weighted sums, by its name in Keras."""

    name: str
    function: Callable


def _compute_relu(values):
    from models.keras.keras2 import tf

    return tf.nn.relu(values)


RELU = Activation("relu", _compute_relu)
LINEAR = Activation("linear", lambda values: values)


class KerasLayer(NamedTuple):
    """A layer of a Keras model.

    Attributes
    ----------
    kind : str
        Name of its class.
    name : str
    config : dict
        The arguments of the layer.
    arrays : tuple of ndarray
        The trained arrays, in Keras's order.
    function : callable
        What the layer computes of a batch, in prediction.
    activation : Activation
        The activation of a layer that also has weights.
    size : int
        Number of its output values.
    """

    kind: str
    name: str
    config: dict
    arrays: tuple
    function: Callable = LINEAR.function
    activation: Activation = LINEAR
    size: int = 0

    def __str__(self):
        return f"layer {self.name!r} ({self.kind})"

    def compute(self, values) -> np.ndarray:
        """Compute the layer's output for a sample, in double precision.

        Raises
        ------
        ModelFileError
            The sample does not have the shape that the layer expects.
        """
        try:
            return np.asarray(self.function(np.asarray(values, np.float32)[None])).astype(float)[0]
        except Exception:  # each Keras has its own for a sample of another shape
            self.refuse(NO_CHAIN)

    def refuse(self, problem) -> NoReturn:
        """Raise a ModelFileError with the layer's name and a problem."""
        raise ModelFileError(f"{self}: {problem}")

    def read_pair(self, key) -> tuple:
        """(rows, columns) of an argument that is one number or two."""
        value = self.config[key]
        return tuple(value) if isinstance(value, (list, tuple)) else (value, value)


@dataclass(frozen=True)
class KerasModel:
    """A user's model as an architecture and its weights.

    Attributes
    ----------
    architecture : Architecture
    weights : dict
        ``"conv1.kernel"``, ... as float32, with the shapes of ``architecture.weight_shapes``.  With
        a ReLU after each convolution and hidden dense layer the network computes the model's
        logits, unless something is ``replaced``.
    notes : tuple of str
        One line for each layer that was folded or left out.
    replaced : tuple of str
        One line for each layer with another function than in the file.
    end : Activation
        That of the output in the file.
    input_order : ndarray of int
        The values of an image, in the order (row, column, channel), that the model's input has, in
        its shape.
    input_scale : float
        What an image is multiplied with to be the model's input: 255 for a model of pixels.
    function : callable
        What the file's model computes of its input.
    """

    architecture: Architecture
    weights: dict
    notes: tuple
    replaced: tuple
    end: Activation
    input_order: np.ndarray
    input_scale: float = 1.0
    function: Callable = LINEAR.function

    def compute_outputs(self, images) -> np.ndarray:
        """Outputs of the file's model, one for each class.

        Parameters
        ----------
        images : ndarray, shape (n, rows, columns, channels)
        """
        values = images.reshape(len(images), -1)[:, self.input_order.ravel()]
        inputs = (self.input_scale * values).reshape(len(images), *self.input_order.shape)
        inputs = inputs.astype(np.float32)
        batches = [inputs[n : n + BATCH] for n in range(0, len(inputs), BATCH)]
        outputs = np.concatenate([np.asarray(self.function(batch)) for batch in batches])
        outputs = outputs.reshape(len(images), -1)
        return np.hstack([1 - outputs, outputs]) if outputs.shape[1] == 1 else outputs
