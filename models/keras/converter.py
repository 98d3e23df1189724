"""The layers of a Keras model converted so far, and the linear function that follows them.

The chip has convolutions and dense layers of neurons with the curve of a ReLU, averaging between
them, and a linear output.  Between two layers with weights, Keras's layers are linear: they scale
(normalisation), move values (flatten, reshape, permute, pad) or average.
:class:`LayerConverter` keeps this linear function as a sparse matrix and an offset
(:class:`models.keras.signal.Signal`),

    signal = map @ built + offset,

with the signal of the Keras model on the left, and that of the layers built so far on the right.
The next layer with weights absorbs it: for a dense layer with any map, ``kernel' = map^T kernel``
and ``bias' = bias + offset kernel``; for a convolution if the map scales channels and pads zeros.
Any other convolution becomes a dense layer with its matrix.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse

from models.architecture import MAX_WEIGHTS, Architecture
from models.keras.files import ModelFileError
from models.keras.model import LINEAR, RELU, KerasLayer, KerasModel
from models.keras.signal import Signal, are_alike, make_matrix
from models.ops import Dense, Pooling

# Maximum number of weights of a convolution that is written as a matrix.
MAX_MATRIX_WEIGHTS = 20_000_000

# Largest value of a pixel, with which an image of this project is multiplied where the first layer
# of a model takes pixels.
MAX_PIXEL = 255.0

# Activations that do not change which output is the largest.
MONOTONE_ACTIVATIONS = (
    *("softmax", "log_softmax", "sigmoid", "tanh", "softplus", "softsign", "elu", "selu"),
    *("exponential", "leaky_relu", "log_sigmoid", "celu", "squareplus"),
)

RETRAIN = "with --retrain it becomes"
USE_RELU = "use activation='relu' (in the output 'softmax' or None)"


@dataclass
class WeightedSums:
    """Weighted sums of a layer, with what is folded into its kernel and bias.

    Attributes
    ----------
    layer : KerasLayer
    kernel, bias : ndarray
    """

    layer: KerasLayer
    kernel: np.ndarray = field(repr=False)
    bias: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class WindowMeans:
    """Averages over windows of the built image.

    Attributes
    ----------
    size, strides : tuple of int
        Lengths of the windows along rows and columns, and distances between them.
    affine : (ndarray, ndarray)
        Scale and offset of each channel.
    map : scipy.sparse.csr_array
        That of the signal after the average; the signal has another one if something else followed.
    """

    size: tuple
    strides: tuple
    affine: tuple
    map: object


class LayerConverter:
    """The layers converted so far, and the linear function from their signal to the model's.

    Parameters
    ----------
    order : (ndarray, tuple)
        Positions of an image's values in the model's input, and the shape of the image.
    retrain, pixels : bool
        As for :func:`models.keras.layers.convert_layers`.

    Attributes
    ----------
    layers : list of models.ops.base.Operation
        The layers of the architecture so far, pooling included.
    sums : list of WeightedSums
        Those of them with weights.
    signal : Signal
        The linear function from the signal of the last layer to the model's.
    is_linear : bool
        True if no activation has followed the last weighted sums.
    deferred : KerasLayer or None
        A maximum of sums, for which an average is taken once these have an activation.
    means : WindowMeans or None
        Averages over windows of the built image, which the next convolution may absorb.
    end : (KerasLayer, Activation) or None
        A layer and its activation, if it may be the output's.
    input_scale : float
        As in `KerasModel`.
    notes, replaced : list of str
        As in `KerasModel`.
    """

    def __init__(self, order, retrain, pixels=True):
        self.input_order, self.input_shape = order
        self.retrain = retrain
        self.pixels = pixels
        self.layers = []
        self.sums = []
        self.deferred = None
        self.means = None
        self.input_scale = 1.0
        self.is_linear = False
        self.end = None
        self.notes = []
        self.replaced = []
        self.signal = Signal(self.input_shape)
        self.signal.arrange(self.input_order)

    @property
    def ends_dense(self) -> bool:
        """True if the last layer built is dense."""
        return bool(self.layers) and isinstance(self.layers[-1], Dense)

    def finish(self) -> KerasModel:
        """The model of the layers so far, the last of which becomes the output.

        Raises
        ------
        ModelFileError
            The layers have no output, or their weights are too large.
        """
        is_dense = self.ends_dense and self.signal.is_unchanged
        if is_dense and not self.is_linear:
            self.end = self.sums[-1].layer, RELU
        elif not is_dense:
            self.read_out()
        last = self.sums[-1]
        activation = LINEAR
        if self.end is not None:
            layer, activation = self.end
            self.notes.append(
                f"{layer}: its {activation.name} left out, which does not change the prediction"
            )
        if self.layers[-1].units == 1:
            if activation.name != "sigmoid":
                last.layer.refuse(
                    "has one output; use one unit per class, or activation='sigmoid' for two "
                    "classes"
                )
            # Softmax of 0 and z is the sigmoid of z.
            last.kernel = np.concatenate([np.zeros_like(last.kernel), last.kernel], axis=1)
            last.bias = np.concatenate([[0.0], last.bias])
            self.layers[-1] = Dense(2)
            self.notes.append(f"{last.layer}: one output became two classes")
        return self._make_model(activation)

    def _make_model(self, end):
        layers = (*self.layers[:-1], replace(self.layers[-1], is_output=True))
        architecture = Architecture(self.input_shape, layers)
        names = architecture.names
        weighted = [name for name, layer in zip(names, layers, strict=True) if layer.has_neurons]
        weights = {}
        for name, sums in zip(weighted, self.sums, strict=True):
            with np.errstate(over="ignore"):  # infinite values are refused below
                kernel, bias = (np.asarray(a, np.float32) for a in (sums.kernel, sums.bias))
            if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
                sums.layer.refuse("its weights are too large for single precision")
            weights |= {f"{name}.kernel": kernel, f"{name}.bias": bias}
        return KerasModel(
            architecture=architecture,
            weights=weights,
            notes=tuple(self.notes),
            replaced=tuple(self.replaced),
            end=end,
            input_order=self.input_order,
            input_scale=self.input_scale,
        )

    # --- weighted sums ----------------------------------------------------------------------------

    def append_dense(self, layer, kernel, bias):
        """Append a dense layer; one that follows another without an activation is multiplied.

        Parameters
        ----------
        layer : KerasLayer
        kernel : ndarray or sparse array, shape (inputs, outputs)
        bias : ndarray
        """
        bias = self.signal.offset @ kernel + bias
        kernel = self.signal.map.T @ kernel
        if self.layers and isinstance(self.layers[-1], Pooling):
            self.require_activation(layer)
        if self.is_linear:
            before = self.sums[-1]
            matrix, offset = self.make_matrix_of_sums()
            bias = offset @ kernel + bias
            kernel = matrix @ kernel
            self.notes.append(f"{before.layer}: folded into {layer}, since it has no activation")
            self.layers.pop()
            self.sums.pop()
        self.append_sums(layer, Dense(kernel.shape[1]), kernel, bias)

    def make_matrix_of_sums(self) -> tuple:
        """The last sums, which have no activation, as a matrix (inputs, outputs) and a bias."""
        last = self.sums[-1]
        operation = self.layers[-1]
        if isinstance(operation, Dense):
            return last.kernel, last.bias
        before = self.input_shape
        for layer in self.layers[:-1]:
            before = layer.compute_shape(before)
        strides = (operation.stride, operation.stride)
        matrix = make_matrix(last.kernel.transpose(3, 2, 0, 1), before, strides, operation.padding)
        return matrix.T, np.tile(last.bias, matrix.shape[0] // len(last.bias))

    def average_sums(self):
        """Let the last sums, which have no activation, include the linear function after them."""
        last = self.sums[-1]
        shape = self.signal.shape
        matrix, offset = self.make_matrix_of_sums()
        kernel = matrix @ self.signal.map.T
        bias = self.signal.map @ offset + self.signal.offset
        self.layers.pop()
        self.sums.pop()
        self.append_sums(last.layer, Dense(len(bias)), kernel, bias)
        self.signal.arrange(self.signal.positions.reshape(shape))
        self.notes.append(f"{last.layer}: takes the memory of a dense layer, as what follows it")

    def append_sums(self, layer, operation, kernel, bias):
        """Append an operation with its kernel and bias."""
        weights = math.prod(kernel.shape)
        if weights > (MAX_MATRIX_WEIGHTS if sparse.issparse(kernel) else MAX_WEIGHTS):
            layer.refuse(
                f"as a matrix, which it would be on the chip, it has {weights} weights; use "
                "square kernels, equal strides, pooling of 2 on an even number of rows and "
                "columns, or a stride in the convolution before it"
            )
        kernel = kernel.toarray() if sparse.issparse(kernel) else kernel
        self.signal.begin(operation.compute_shape(self.signal.built))
        self.layers.append(operation)
        bias = np.broadcast_to(bias, kernel.shape[-1:])
        self.sums.append(WeightedSums(layer, kernel, bias))
        self.is_linear = True

    def read_out(self):
        """Append an output that only passes on the signal, as after a global average."""
        if not self.sums or len(self.signal.shape) != 1:
            raise ModelFileError("does not end with a Dense; add one with one unit per class")
        outputs = len(self.signal.offset)
        self.append_dense(KerasLayer("Dense", "output", {}, ()), np.eye(outputs), np.zeros(outputs))

    # --- activations ------------------------------------------------------------------------------

    def use_activation(self, layer, activation):
        """Use an activation for the output if possible, and otherwise for a hidden layer."""
        if activation.name == "linear":
            return
        is_vector = len(self.signal.shape) == 1
        is_dense = self.is_linear and self.ends_dense and is_vector
        if activation.name == "softmax" and self.sums and is_vector and not is_dense:
            self.read_out()
            is_dense = True
        if is_dense and activation.name in MONOTONE_ACTIVATIONS:
            self.end = layer, activation
        else:
            self.use_hidden_activation(layer, activation)

    def use_hidden_activation(self, layer, activation):
        """Use the activation of a hidden layer."""
        if activation.name == "softmax" and len(self.signal.shape) > 1:
            layer.refuse(
                "its softmax is that of the channels at each place of an image; put it after the "
                "Reshape or Flatten, as the last layer"
            )
        if activation.name == "softmax":
            layer.refuse("its softmax does not follow the output; remove it")
        if not self.sums:
            layer.refuse("precedes the first Conv2D or Dense; remove it")
        if not self.is_linear:
            # A signal that is not negative passes a ReLU unchanged.
            if activation.name != "relu" or not self.signal.is_never_negative:
                layer.refuse(
                    f"a second activation after that of {self.sums[-1].layer}; put the "
                    "normalisation, or the averaging, before or after both, or remove one"
                )
            return
        if not self.signal.is_moved:
            self.average_sums()
        self.is_linear = False
        if activation.name == "relu":
            return
        if not self.retrain:
            layer.refuse(
                f"{activation.name!r} is not the curve of a spiking neuron, which is like a ReLU; "
                f"{RETRAIN} a ReLU and is trained further; or {USE_RELU}"
            )
        self.replaced.append(f"{layer}: {activation.name} replaced by a ReLU")

    def require_activation(self, layer):
        """Refuse sums without an activation before a convolution."""
        if not self.is_linear:
            return
        last = self.sums[-1]
        if not self.retrain:
            last.layer.refuse(
                f"has no activation before {layer.name!r}; use activation='relu' ({RETRAIN} a ReLU)"
            )
        self.is_linear = False
        self.replaced.append(f"{last.layer}: a ReLU added, since it has no activation")

    # --- scales -----------------------------------------------------------------------------------

    def apply_affine(self, layer, scale, offset):
        """Fold ``scale * signal + offset``, one of each for a value of the signal."""
        with np.errstate(all="ignore"):  # infinite weights are refused in _make_model
            if self.is_linear and self.fold_back(scale, offset):
                self.notes.append(f"{layer}: folded into {self.sums[-1].layer}")
                return
            has_means = self.means is not None and self.means.map is self.signal.map
            self.signal.scale(scale, offset)
            if has_means:
                self.scale_means(scale, offset)
        self.notes.append(f"{layer}: folded into the next layer")

    def scale_means(self, scale, offset):
        """Scale averages that a convolution may absorb, if each channel is scaled as a whole."""
        scales, offsets = (a.reshape(-1, self.signal.shape[2]) for a in (scale, offset))
        if are_alike(scales) and are_alike(offsets):
            before, constant = self.means.affine
            affine = (scales[0] * before, scales[0] * constant + offsets[0])
            self.means = replace(self.means, affine=affine, map=self.signal.map)

    def fold_back(self, scale, offset) -> bool:
        """Fold an affine function into the last weighted sums, if it is one for each channel."""
        if not self.signal.is_moved or self.signal.map.nnz != len(scale):
            return False
        last = self.sums[-1]
        units = len(last.bias)
        scales, offsets = (
            (self.signal.map.T @ values).reshape(-1, units) for values in (scale, offset)
        )
        if not (are_alike(scales) and are_alike(offsets)):
            return False
        last.kernel = last.kernel * scales[0]
        last.bias = last.bias * scales[0] + offsets[0]
        return True
