"""A layer of a Keras model, and a model as an architecture and its weights."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, NoReturn

import numpy as np

from models.architecture import Architecture
from models.keras.files import ModelFileError

NO_CHAIN = (
    "does not compute what its layers do one after the other; build one chain of layers, each "
    "called once and with its input only"
)


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
        """What the layer computes of a sample, in double precision.

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
class MaxPool:
    """A maximum over windows in the file's model, where the architecture averages.

    Attributes
    ----------
    size, strides : (int, int)
        Along rows and columns.
    padding : str
    signs : ndarray, shape (channels,)
        -1 for channels of which a later normalisation changes the sign, so that the file's model
        has their minimum.
    image : tuple of int
        Shape of the image before it, if the next layer has absorbed the averages.
    means : scipy.sparse.csr_array, shape (averages, values of the image)
    shape : tuple of int
        Shape of the maxima.
    widen : callable
        The kernel on the image, with averages in it, of a convolution's kernel on the averages.
    kernel : ndarray
        The kernel of that layer in the file: (maxima, units), or that of a convolution.
    conv_strides : tuple of int
        Strides of a convolution without padding that has absorbed the averages.
    """

    size: tuple
    strides: tuple
    padding: str
    signs: np.ndarray
    image: tuple = ()
    means: Any = None
    shape: tuple = ()
    widen: Callable | None = None
    kernel: np.ndarray | None = None
    conv_strides: tuple = ()

    def before_dense(self) -> "MaxPool":
        """The maxima that a dense layer absorbs."""
        return replace(self, widen=self.means.T.__matmul__, conv_strides=())

    def change_signs(self, scale) -> "MaxPool":
        """The maxima of channels with a factor, or minima if it is negative."""
        return replace(self, signs=self.signs * np.where(scale < 0, -1, 1))


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
    activations : dict
        The functions in the file that ReLUs replace, by the name of the layer of neurons.
    max_pools : dict of str to MaxPool
        The layers in the file that averages replace, by the name of the pooling, or of the dense
        layer that has absorbed the averages.
    paddings : dict of str to ndarray
        Values of the channels with which the file's model pads a convolution's input, where the
        architecture pads zeros, by the name of the convolution.
    end : Activation
        That of the output in the file.
    input_order : ndarray of int
        The values of an image, in the order (row, column, channel), that the model's input has, in
        its shape.
    input_scale : float
        What an image is multiplied with to be the model's input: 255 for a model of pixels.
    """

    architecture: Architecture
    weights: dict
    notes: tuple
    replaced: tuple
    activations: dict
    max_pools: dict
    paddings: dict
    end: Activation
    input_order: np.ndarray
    input_scale: float = 1.0
