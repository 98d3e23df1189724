"""The base class of the operations of an architecture."""

import math
import re
from typing import ClassVar, NamedTuple

import numpy as np

from deploy.errors import UserError
from deploy.network.ops import DeployedOperation

# Nine digits exceed every limit.
NUMBER = "([0-9]{1,9})"


class Synapses(NamedTuple):
    """The synapses of a layer by its inputs; see :mod:`models.spiking_kernels`.

    Synapses ``first[i]`` to ``first[i + 1] - 1`` leave input i.  Synapse k adds row ``row[k]`` of
    the kernel, reshaped to (-1, n) with its last axis n, to the n neurons from ``place[k] * n`` on.

    Attributes
    ----------
    first : ndarray of int64, shape (inputs + 1,)
    place, row : ndarray of int64, shape (synapses,)
    """

    first: np.ndarray
    place: np.ndarray
    row: np.ndarray

    @property
    def is_matrix(self) -> bool:
        """True if the kernel is the matrix of the layer: input i adds row i to all neurons."""
        inputs = len(self.first) - 1
        every = np.arange(inputs)
        return (
            np.array_equal(self.first[1:], every + 1)
            and np.array_equal(self.row, every)
            and not self.place.any()
        )


class Operation(DeployedOperation):
    """A layer of an architecture, with its notation and its training.

    A subclass is a frozen dataclass.  Its second base, the deployed operation, has its shapes and
    synapses.  It has `token` and `__str__`; the other methods have defaults, or are for one use:

    =============================  =================================================================
    `from_token`                   if the notation has more than numbers
    `kernel_shape`, `to_deployed`  if the trained kernel has other axes than the deployed weights
    `fan_in`                       if the kernel's last axis is not that of the outputs
    `keras_layer`                  for networks on images
    `sums`, `synapses`             for networks trained on events
    `currents`, `windows`          for networks that are rounded to integers, such as NIR graphs
    =============================  =================================================================

    Without the methods for a use, that use is refused.

    Attributes
    ----------
    kind : str
        The key in `OPERATIONS`, and the prefix of the layers' names but for ``"output"``.
    token : re.Pattern
        The notation; numbers are its groups of digits.
    noun : str
        For messages, such as ``"a convolution"``.
    examples : tuple of str
        Notations, for messages, such as ``("6c4", "6c4s2")``.
    has_neurons : bool
        True if neurons follow, unless the layer is the output.
    output : bool
        True for the output layer.
    """

    token: ClassVar[re.Pattern]
    noun: ClassVar[str] = "a layer"
    examples: ClassVar[tuple] = ()
    has_neurons: ClassVar[bool] = True
    output: bool = False

    @classmethod
    def from_token(cls, match: re.Match) -> "Operation":
        """The layer of a match of `token`, whose numbers are at least 1."""
        return cls(*(int(digits) for digits in match.groups() if digits))

    # --- weights ----------------------------------------------------------------------------------

    def kernel_shape(self, input_shape) -> tuple | None:
        """Shape of the trained kernel; None without weights."""
        return self.weight_shape(input_shape)

    def array_shapes(self, input_shape) -> dict:
        """Shapes of the trained arrays, ``"kernel"`` and ``"bias"``; empty without weights."""
        kernel = self.kernel_shape(input_shape)
        if kernel is None:
            return {}
        return {"kernel": kernel, "bias": self.shape(input_shape)[-1:]}

    def to_deployed(self, kernel, sections: int = 1) -> np.ndarray:
        """A trained kernel in the order of :attr:`deploy.network.spec.Layer.weights`.

        Parameters
        ----------
        kernel : ndarray
            Of a readout, those of all sections along the first axis.
        sections : int
        """
        return kernel

    def fan_in(self, input_shape) -> int:
        """Number of inputs of each neuron; initial weights have a variance of one over it.

        Here it is the product of all axes of the kernel but the last.  `fan_out` is the number of
        synapses in the other direction.
        """
        return math.prod(self.array_shapes(input_shape)["kernel"][:-1])

    # --- networks on images -----------------------------------------------------------------------

    def keras_layer(self, name: str, gain: float | None = None):
        """The layer of Keras that computes its sums, or averages.

        Its trained variables have the names of the arrays in :meth:`array_shapes`.

        Parameters
        ----------
        name : str
        gain : float, optional
            The layer then has the chip's quantised weights (:mod:`models.quantised`).
        """
        raise self._refuse("networks on images")

    # --- networks on events -----------------------------------------------------------------------

    def sums(self, kernel, frames):
        """Weighted sums in TensorFlow.

        Parameters
        ----------
        kernel : tensor
        frames : tensor, shape (frames, ...)
        """
        raise self._refuse("networks on events")

    def synapses(self, input_shape) -> Synapses:
        """The synapses for the kernels that train networks on events."""
        raise self._refuse("networks on events")

    # --- rounding to integers ---------------------------------------------------------------------

    def currents(self, link, weights, spikes) -> np.ndarray:
        """Input currents W s of a link; see :func:`models.integers.currents`."""
        raise self._refuse("networks that are rounded to integers")

    def windows(self, link, values) -> np.ndarray:
        """What each neuron of a link reads, shape (frames..., inputs) in the weights' order."""
        raise self._refuse("networks that are rounded to integers")

    def _refuse(self, use):
        return UserError(f"the layer {self} is not available in {use}")
