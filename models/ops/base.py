"""The base class of the operations of an architecture."""

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


class Operation(DeployedOperation):
    """A layer of an architecture, with its notation and its training.

    A subclass is a frozen dataclass.  Its second base, the deployed operation, has its shapes and
    synapses.  It has `token` and `__str__`; the other methods have defaults, or are for one use:

    =============================  =================================================================
    `from_token`                   if the notation has more than numbers
    `kernel_shape`, `to_deployed`  if the trained kernel has other axes than the deployed weights
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
    has_neurons : bool
        True if neurons follow, unless the layer is the output.
    output : bool
        True for the output layer.
    """

    token: ClassVar[re.Pattern]
    noun: ClassVar[str] = "a layer"
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

    # --- networks on images -----------------------------------------------------------------------

    def keras_layer(self, name: str, gain: float | None = None):
        """The layer of Keras that computes its sums, or averages.

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
