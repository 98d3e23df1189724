"""The base classes of the layers and operations of an architecture."""

import math
import re
from dataclasses import fields
from typing import ClassVar, NamedTuple

import numpy as np

from deploy.network.ops import DEPLOYED_OPERATIONS, DeployedOperation

# Nine digits exceed every limit.
NUMBER = "([0-9]{1,9})"


class Synapses(NamedTuple):
    """The synapses of a layer by its inputs; see :mod:`models.spiking.compiled`.

    Entries ``first[i]`` to ``first[i + 1] - 1`` leave input i.  Entry k is ``width`` synapses: row
    ``row[k]`` of the kernel, reshaped to (-1, width), is added to the ``width`` neurons from
    ``position[k] * width`` on.

    Attributes
    ----------
    first : ndarray of int64, shape (inputs + 1,)
    position, row : ndarray of int64, shape (entries,)
    width : int
    """

    first: np.ndarray
    position: np.ndarray
    row: np.ndarray
    width: int

    @property
    def arrays(self) -> tuple:
        """The arrays, as the compiled functions take them."""
        return self.first, self.position, self.row

    @property
    def is_matrix(self) -> bool:
        """True if the kernel is the matrix of the layer: input i adds row i to all neurons."""
        inputs = len(self.first) - 1
        every = np.arange(inputs)
        return (
            np.array_equal(self.first[1:], every + 1)
            and np.array_equal(self.row, every)
            and not self.position.any()
        )


class NotatedLayer:
    """An entry between two hyphens of the notation: an operation, or a pooling before one.

    A subclass has `token`, `noun`, `examples` and `__str__`, and the methods
    ``compute_shape(input_shape)``, ``count_fan_out(input_shape)``,
    ``list_array_shapes(input_shape)`` and ``make_keras_layer(name, gain)`` of :class:`Operation`.

    Attributes
    ----------
    kind : str
        The prefix of the layers' names but for ``"output"``.
    token : re.Pattern
        The notation; numbers are its groups of digits.
    noun : str
        For messages, such as ``"a convolution"``.
    examples : tuple of str
        Notations that `token` matches, for messages, such as ``("6c4", "6c4s2")``.
    has_neurons : bool
        True if neurons follow, unless the layer is the output.
    is_output : bool
        True for the output layer.
    """

    kind: ClassVar[str]
    token: ClassVar[re.Pattern]
    noun: ClassVar[str] = "a layer"
    examples: ClassVar[tuple] = ()
    has_neurons: ClassVar[bool] = True
    is_output: bool = False

    @classmethod
    def from_token(cls, match: re.Match):
        """The layer of a match of `token`, whose groups are the fields in order, at least 1."""
        names = [field.name for field in fields(cls)]  # type: ignore[arg-type]
        numbers = zip(names, match.groups(), strict=False)
        return cls(**{name: int(digits) for name, digits in numbers if digits})


class Operation(NotatedLayer, DeployedOperation):
    """An operation of an architecture, with its notation and its training.

    A subclass has a second base, its deployed operation, which has its shapes and its sums.  It
    adds `token`, `noun`, `examples` and `__str__`, and is entered in `OPERATIONS` under its `kind`.
    The other methods follow from the sums; an operation overrides them where it can be faster, or
    where its numbers are not those of its notation:

    ===================================  ===========================================================
    `from_token`                         if the notation has more than numbers
    `compute_kernel_shape`,              if the trained kernel has other axes than the deployed
    `to_deployed`                        weights
    `count_fan_in`,                      for layers with many inputs
    `compute_tensor_sums`,
    `make_synapses`
    `gather_inputs`                      if rounding to integers should compensate errors of weights
    `make_keras_layer`                   if Keras has a layer of its own for it
    ===================================  ===========================================================
    """

    # --- weights ----------------------------------------------------------------------------------

    def compute_kernel_shape(self, pooled_shape) -> tuple:
        """Shape of the trained kernel."""
        return self.compute_weight_shape(pooled_shape)

    def list_array_shapes(self, pooled_shape) -> dict:
        """Shapes of the trained arrays, ``"kernel"`` and ``"bias"``."""
        bias = self.compute_shape(pooled_shape)[-1:]
        return {"kernel": self.compute_kernel_shape(pooled_shape), "bias": bias}

    def to_deployed(self, kernel, n_sections: int = 1) -> np.ndarray:
        """A trained kernel in the order of :attr:`deploy.network.layer.Layer.weights`.

        Parameters
        ----------
        kernel : ndarray
            The trained kernel; that of a readout has all sections along the first axis.
        n_sections : int
        """
        return kernel

    def to_layer_operation(self, shape) -> DeployedOperation:
        """The operation without its training, as a deployed layer with an output shape has it."""
        return DEPLOYED_OPERATIONS[self.kind].from_file(self.to_file(), shape)

    def count_fan_in(self, pooled_shape) -> int:
        """Largest number of inputs of a neuron; initial weights have a variance of one over it.

        `count_fan_out` is the number of synapses in the other direction.
        """
        return int((self.find_synapses(pooled_shape) >= 0).sum(0).max())

    def _find_kernel_entries(self, pooled_shape) -> np.ndarray:
        """As `find_synapses`, as an index into the flat kernel."""
        synapses = self.find_synapses(pooled_shape)
        kernel_shape = self.list_array_shapes(pooled_shape)["kernel"]
        numbers = np.arange(math.prod(kernel_shape)).reshape(kernel_shape)
        return np.where(synapses < 0, -1, self.to_deployed(numbers).ravel()[synapses])

    # --- training ---------------------------------------------------------------------------------

    def compute_tensor_sums(self, kernel, frames):
        """The sums of `compute_sums` in TensorFlow, which differentiates them.

        Parameters
        ----------
        kernel : tensor
        frames : tensor, shape (frames, ...)
            In the operation's ``pooled_shape`` each.

        Returns
        -------
        tensor, shape (frames, ...)
        """
        from models.keras.keras2 import tf

        pooled_shape = tuple(frames.shape[1:])
        entries = self._find_kernel_entries(pooled_shape)
        weights = tf.concat([tf.reshape(kernel, [-1]), tf.zeros(1, kernel.dtype)], 0)
        matrix = tf.gather(weights, np.where(entries < 0, weights.shape[0] - 1, entries))
        sums = tf.matmul(tf.reshape(frames, (-1, len(entries))), matrix)
        return tf.reshape(sums, (-1, *self.compute_shape(pooled_shape)))

    def make_keras_layer(self, name: str, gain: float | None = None):
        """The layer of Keras that computes its sums, for networks on images.

        Parameters
        ----------
        name : str
        gain : float, optional
            The layer then has the chip's quantised weights (:mod:`models.quantised`).
        """
        from models.keras.operation_layer import OperationLayer

        return OperationLayer(self, gain, name=name)

    def make_synapses(self, pooled_shape) -> Synapses:
        """The synapses for the compiled functions that train networks on events."""
        entries = self._find_kernel_entries(pooled_shape)
        source, target = np.nonzero(entries >= 0)
        first = np.concatenate([[0], np.cumsum((entries >= 0).sum(1))])
        return Synapses(first, target, entries[source, target], 1)

    # --- rounding to integers ---------------------------------------------------------------------

    def gather_inputs(self, values: np.ndarray) -> np.ndarray | None:
        """The inputs of each neuron, in the order of the kernel's axes without the last one.

        Parameters
        ----------
        values : ndarray, shape (n, ...)

        Returns
        -------
        ndarray, shape (..., inputs of a neuron), or None
            None if the rounding of weights is not compensated.
        """
        return None
