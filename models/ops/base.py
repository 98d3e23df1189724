"""The base class of the operations of an architecture."""

import math
import re
from typing import ClassVar, NamedTuple

import numpy as np

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


class Operation:
    """A layer of an architecture.  A subclass is a frozen dataclass.

    Every subclass has `from_token`, `shape`, `weight_shapes`, `fan_out`, `geometry`, `from_link`,
    `deployed_weights` and `__str__`.  Networks on images need `keras_layer`, those on events
    `sums` and `synapses`, and imported graphs `currents` and `windows`.

    A link is a :class:`models.chain.Link` of this kind.

    Attributes
    ----------
    kind : str
        Prefix of the layers' names, and but for ``"output"`` the key in `OPERATIONS`.
    noun : str
        Such as ``"a convolution"``.
    token : re.Pattern
        The notation; numbers are its groups of digits.
    is_spatial : bool
        True if the input must have rows, columns and channels.
    has_neurons : bool
        True if neurons follow, unless the layer is the output.
    output : bool
        True for the output layer.
    """

    kind: str
    noun: ClassVar[str]
    token: ClassVar[re.Pattern]
    is_spatial: ClassVar[bool] = False
    has_neurons: ClassVar[bool] = True
    output: bool = False

    @classmethod
    def from_token(cls, match: re.Match) -> "Operation":
        """The layer of a match of `token`, whose numbers are at least 1."""
        raise NotImplementedError

    def shape(self, input_shape) -> tuple:
        """Shape of the output.

        Raises
        ------
        ValueError
            The layer does not fit its input.
        """
        raise NotImplementedError

    def weight_shapes(self, input_shape) -> dict:
        """Shapes of ``"kernel"`` and ``"bias"``; an empty dict without weights."""
        raise NotImplementedError

    def fan_out(self, input_shape) -> np.ndarray:
        """Synapses that leave each input position, int64, of shape ``input_shape``."""
        raise NotImplementedError

    def keras_layer(self, name: str, gain: float | None = None):
        """The layer of Keras that computes its sums, or averages.

        Parameters
        ----------
        name : str
        gain : float, optional
            The layer then has the chip's quantised weights (:func:`models.cnn.on_chip`).
        """
        raise NotImplementedError

    def sums(self, kernel, frames):
        """Weighted sums in TensorFlow.

        Parameters
        ----------
        kernel : tensor
        frames : tensor, shape (frames, ...)
        """
        raise NotImplementedError

    def synapses(self, input_shape) -> Synapses:
        """The synapses for the kernels that train networks on events."""
        inputs = math.prod(input_shape)
        return Synapses(np.arange(inputs + 1), np.zeros(inputs, np.int64), np.arange(inputs))

    # --- links ------------------------------------------------------------------------------------

    def geometry(self) -> dict:
        """Attributes of a link that are no shapes, such as ``stride``."""
        return {}

    @classmethod
    def from_link(cls, link, output: bool) -> "Operation":
        """The layer of a link."""
        raise NotImplementedError

    @staticmethod
    def currents(link, weights, spikes) -> np.ndarray:
        """Input currents W s of a link; see :func:`models.integers.currents`."""
        raise NotImplementedError

    @staticmethod
    def windows(link, values) -> np.ndarray:
        """What each neuron of a link reads, shape (frames..., inputs) in the weights' order."""
        raise NotImplementedError

    @staticmethod
    def deployed_weights(link) -> np.ndarray:
        """A link's weights in the shape of :attr:`deploy.network.spec.Layer.weights`."""
        raise NotImplementedError
