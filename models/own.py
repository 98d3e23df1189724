"""Convert a user's Keras model to an architecture and weights that compute the same function.

The chip supports a chain of convolutions and dense layers, each followed by a ReLU (except for the
output), with average pooling between them.  Layers that only act in training are left out.  Layers
that are affine per channel (batch normalisation, rescaling) are folded into the previous layer if
that layer has no ReLU yet, and otherwise into the next layer.  All other layers are refused, with
a message that names the layer and an alternative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from models.architecture import (
    MAX_LAYERS,
    MAX_VALUES,
    Architecture,
    Convolution,
    Dense,
    Pooling,
)
from models.keras_file import ModelFileError, SavedLayer, SavedModel, read_model_file, shown

__all__ = ["ModelFileError", "OwnModel", "as_architecture", "read_own_model"]


@dataclass(frozen=True)
class OwnModel:
    """A user's model as an architecture and its weights.

    Attributes
    ----------
    architecture : Architecture
    weights : dict of str to ndarray, float32
        ``"conv1.kernel"``, ..., with the shapes of ``architecture.weight_shapes``.  With a ReLU
        after each convolution and hidden dense layer the network computes the model's logits.
    notes : tuple of str
        One line for each layer that was folded or left out.
    """

    architecture: Architecture
    weights: dict
    notes: tuple


def read_own_model(path) -> OwnModel:
    """Read a ``.keras`` or ``.h5`` file; nothing in it is executed.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    ModelFileError
        The model is not supported; the message names the file, the layer if any, and a remedy.
    """
    model = read_model_file(path)
    try:
        return as_architecture(model)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


def as_architecture(model: SavedModel) -> OwnModel:
    """Turn a saved chain of layers into an architecture and its weights.

    Raises
    ------
    ModelFileError
        A layer is not supported, weights have wrong shapes or are not finite, or the model was
        never trained.
    """
    if len(model.input_shape) == 1:
        raise ModelFileError(
            f"its input is a vector of {model.input_shape[0]} values; use the sensor's rows and "
            "columns: keras.Input((rows, columns, channels)) and Flatten"
        )
    shape = model.input_shape + (1,) * (len(model.input_shape) == 2)
    if len(shape) != 3 or math.prod(shape) > MAX_VALUES:
        sizes = "x".join(str(n)[:12] for n in model.input_shape[:6])
        raise ModelFileError(f"its input of {sizes} is not an image of a sensor's rows and columns")
    chain = _Chain(shape)
    for layer in model.layers:
        chain.add(layer)
    return chain.finished()


class _Chain:
    """The layers converted so far.

    ``scale`` and ``offset`` are the affine function that still has to be folded into the next
    layer: the model's signal is ``scale * signal + offset`` of the converted layers' signal.
    """

    def __init__(self, shape):
        self.input_shape = shape
        self.shape = shape
        self.layers = []
        self.trained = []  # for each convolution and dense layer: [its SavedLayer, kernel, bias]
        self.scale, self.offset = np.ones(shape[2]), np.zeros(shape[2])
        self.is_linear = False  # the last layer is a convolution or dense layer without a ReLU
        self.softmax = None
        self.notes = []
        self.has_biases, self.is_new = False, True

    def add(self, layer: SavedLayer):
        if layer.kind in _IDLE:
            self.notes.append(f"{layer} left out: it only acts in training")
            return
        if self.softmax is not None:
            raise ModelFileError(
                f"{layer}: follows the softmax of {self.softmax}; remove that softmax"
            )
        handler = _HANDLERS.get(layer.kind)
        if handler is None:
            raise ModelFileError(f"{layer}: not supported; {_instead(layer.kind)}")
        handler(self, layer)

    def finished(self) -> OwnModel:
        if not self.layers or self.layers[-1].kind != "dense":
            last = "no layer" if not self.layers else str(self.layers[-1])
            raise ModelFileError(
                f"ends with {last}, not with a dense layer; add a Dense with one unit per class"
            )
        layer = self.trained[-1][0]
        if not self.is_linear:
            raise ModelFileError(
                f"{layer}: the output has a ReLU; use activation='softmax' or None"
            )
        if self.layers[-1].units < 2:
            raise ModelFileError(f"{layer}: has one output; use one unit per class, at least 2")
        if self.has_biases and self.is_new:
            raise ModelFileError(
                "was never trained (all biases are zero, as Keras initialises them); "
                "train it, then save it"
            )
        layers = (*self.layers[:-1], replace(self.layers[-1], output=True))
        architecture = Architecture(self.input_shape, layers)
        names = [n for n, one in zip(architecture.names, layers, strict=True) if one.kind != "pool"]
        weights = {}
        for name, (layer, kernel, bias) in zip(names, self.trained, strict=True):
            with np.errstate(over="ignore"):  # infinite values are refused below
                kernel, bias = (np.asarray(array, np.float32) for array in (kernel, bias))
            if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
                raise ModelFileError(f"{layer}: its weights are too large for single precision")
            weights |= {f"{name}.kernel": kernel, f"{name}.bias": bias}
        return OwnModel(architecture, weights, tuple(self.notes))

    # --- layers with weights ----------------------------------------------------------------------

    def convolution(self, layer):
        rows, columns = _pair(layer, "kernel_size")
        strides = _pair(layer, "strides")
        if rows != columns:
            _refuse(layer, f"its kernel of {rows}x{columns} is not square; use a square one")
        if strides[0] != strides[1]:
            _refuse(layer, "its strides along rows and columns differ; use the same")
        if _pair(layer, "dilation_rate", [1, 1]) != (1, 1):
            _refuse(layer, "is dilated; use dilation_rate=1 and a larger kernel or a stride")
        if layer.config.get("groups", 1) != 1:
            _refuse(layer, "is a grouped convolution; use groups=1")
        _channels_last(layer)
        padding = layer.config.get("padding")
        if padding not in ("valid", "same"):
            _refuse(layer, f"padding {shown(padding)}; use 'valid' or 'same'")
        self._is_image(layer)
        conv = Convolution(_count(layer, "filters"), rows, strides[0], padding)
        kernel, bias = self._weights(layer, conv)
        if self.offset.any() and any(map(any, conv.pads(self.shape))):
            _refuse(
                layer,
                "zero padding after a normalisation or rescaling with an offset cannot be folded "
                "into weights; use padding='valid', or "
                "normalise after the convolution and before its ReLU",
            )
        bias = bias + np.einsum("ijcf,c->f", kernel, self.offset)
        self._append(layer, conv, kernel * self.scale[:, None], bias)

    def dense(self, layer):
        if len(self.shape) == 3:
            _refuse(layer, "is applied to each row and column; put a Flatten before it")
        dense = Dense(_count(layer, "units"))
        kernel, bias = self._weights(layer, dense)
        self._append(layer, dense, kernel * self.scale[:, None], bias + self.offset @ kernel)

    def _weights(self, layer, made):
        """Kernel and bias of a layer in the file."""
        if self.is_linear:
            before = self.trained[-1][0]
            _refuse(before, f"has no ReLU before {shown(layer.name)}; use activation='relu'")
        if len(self.layers) + 1 > MAX_LAYERS:
            raise ModelFileError(f"has more than {MAX_LAYERS} layers; use fewer")
        try:
            shapes, after = made.weight_shapes(self.shape), made.shape(self.shape)
        except ValueError as error:
            raise ModelFileError(f"{layer}: {error}") from error
        if math.prod(after) > MAX_VALUES:
            raise ModelFileError(f"{layer}: has more than {MAX_VALUES} output values")
        use_bias = layer.config.get("use_bias", True)
        if not isinstance(use_bias, bool):
            _refuse(layer, "its use_bias is neither true nor false; save the model again")
        expected = [shapes["kernel"], shapes["bias"]][: 1 + use_bias]
        _check(layer, ["kernel", "bias"][: 1 + use_bias], expected)
        kernel, *biases = layer.arrays
        bias = biases[0] if use_bias else np.zeros(shapes["bias"])
        self.has_biases |= use_bias
        self.is_new &= not bias.any()
        return kernel, bias

    def _append(self, layer, made, kernel, bias):
        self.layers.append(made)
        self.trained.append([layer, kernel, bias])
        self.shape = made.shape(self.shape)
        self.scale, self.offset = np.ones(self.shape[-1]), np.zeros(self.shape[-1])
        self.is_linear = True
        self._activate(layer)

    # --- layers without weights -------------------------------------------------------------------

    def pooling(self, layer):
        size = _pair(layer, "pool_size")
        strides = size if layer.config.get("strides") is None else _pair(layer, "strides")
        _channels_last(layer)
        self._is_image(layer)
        padded = layer.config.get("padding") != "valid" and (
            layer.config.get("padding") != "same" or any(n % size[0] for n in self.shape[:2])
        )
        if size[0] != size[1] or strides != size or padded:
            _refuse(layer, "its windows overlap, are padded or are not square; "
                    "use AveragePooling2D(2), strides=None, padding='valid'")  # fmt: skip
        if self.is_linear:
            before = self.trained[-1][0]
            _refuse(before, f"has no ReLU before {shown(layer.name)}; put the ReLU before it")
        if size == (1, 1):
            return
        if len(self.layers) + 1 > MAX_LAYERS:
            raise ModelFileError(f"has more than {MAX_LAYERS} layers; use fewer")
        made = Pooling(size[0])
        try:
            self.shape = made.shape(self.shape)
        except ValueError as error:
            raise ModelFileError(f"{layer}: {error}") from error
        self.layers.append(made)

    def flatten(self, layer):
        _channels_last(layer)
        if len(self.shape) == 3:
            positions = self.shape[0] * self.shape[1]
            self.shape = (math.prod(self.shape),)
            self.scale, self.offset = (np.tile(a, positions) for a in (self.scale, self.offset))

    def relu(self, layer):
        for key in ("max_value", "negative_slope", "threshold"):
            none = (None,) if key == "max_value" else (None, 0)
            if _plain(layer.config.get(key)) not in none:
                _refuse(layer, f"has a {key}; use a plain ReLU")
        self._relu(layer)

    def _relu(self, layer):
        if self.is_linear:
            self.is_linear = False
        elif not self.trained:
            _refuse(layer, "precedes the first Conv2D or Dense; remove it")
        elif (self.scale != 1).any() or self.offset.any():
            _refuse(layer, "the normalisation or rescaling before it follows a ReLU; "
                    "put the normalisation between the layer and its ReLU")  # fmt: skip
        # Otherwise the signal is not negative (after a ReLU, maybe pooled), and passes unchanged.

    def activation(self, layer):
        self._activate(layer)

    def _activate(self, layer):
        what = layer.config.get("activation")
        if what == "relu":
            self._relu(layer)
        elif what == "softmax":
            self._end(layer)
        elif what not in (None, "linear"):
            what = "object" if isinstance(what, dict) else shown(what)
            _refuse(layer, f"activation {what} is not supported; {_USE_RELU}")

    def softmax_layer(self, layer):
        if layer.config.get("axis", -1) not in (-1, len(self.shape), [-1]):
            _refuse(layer, "its softmax is not over the last axis; use axis=-1")
        self._end(layer)

    def _end(self, layer):
        if not self.is_linear or self.layers[-1].kind != "dense":
            _refuse(layer, "its softmax does not follow the output; remove it")
        self.softmax = layer
        self.notes.append(f"{layer}: its softmax left out, which does not change the prediction")

    def normalisation(self, layer):
        axis = layer.config.get("axis", -1)
        axis = axis[0] if isinstance(axis, list) and len(axis) == 1 else axis
        if axis not in (-1, len(self.shape)):
            _refuse(layer, "does not normalise over channels; use axis=-1")
        if layer.config.get("renorm"):
            _refuse(layer, "uses renorm; use renorm=False")
        epsilon = _number(layer, "epsilon", 0.001)
        has = {
            "gamma": layer.config.get("scale", True) is not False,
            "beta": layer.config.get("center", True) is not False,
            "moving_mean": True,
            "moving_variance": True,
        }
        names = [name for name, is_there in has.items() if is_there]
        _check(layer, names, [self.shape[-1:]] * len(names))
        found = dict(zip(names, layer.arrays, strict=True))
        gamma, beta = found.get("gamma", 1.0), found.get("beta", 0.0)
        mean, variance = found["moving_mean"], found["moving_variance"]
        if (variance + epsilon <= 0).any():
            _refuse(layer, "has a negative variance; train it again")
        self.has_biases = True
        self.is_new &= not (
            np.any(gamma != 1) or np.any(beta) or mean.any() or (variance - 1).any()
        )
        scale = gamma / np.sqrt(variance + epsilon)
        self._affine(layer, np.broadcast_to(scale, mean.shape), beta - mean * scale)

    def rescaling(self, layer):
        values = []
        for key, default in (("scale", None), ("offset", 0.0)):
            value = _plain(layer.config.get(key, default))
            one_by_one = value if isinstance(value, list) else [value]
            if not all(map(_is_number, one_by_one)) or len(one_by_one) not in (1, self.shape[-1]):
                _refuse(layer, f"its {key} is not a number; use one number, or one per channel")
            values.append(np.broadcast_to(np.array(one_by_one, float), self.shape[-1:]))
        self._affine(layer, *values)

    def _affine(self, layer, scale, offset):
        """Fold ``scale * signal + offset``, with one value per channel."""
        with np.errstate(all="ignore"):  # infinite weights are refused in finished()
            if not self.is_linear:
                self.scale, self.offset = scale * self.scale, scale * self.offset + offset
                self.notes.append(f"{layer}: folded into the next layer")
                return
            before, kernel, bias = self.trained[-1]
            # In a flattened signal the channels of a convolution repeat at each position.
            scales, offsets = (a.reshape(-1, len(bias)) for a in (scale, offset))
            if (scales != scales[0]).any() or (offsets != offsets[0]).any():
                _refuse(layer, "normalises each position separately; put it before the Flatten")
            self.trained[-1] = [before, kernel * scales[0], bias * scales[0] + offsets[0]]
        self.notes.append(f"{layer}: folded into {before}")

    def _is_image(self, layer):
        if len(self.shape) != 3:
            _refuse(layer, "follows a Flatten or Dense; remove it")


_HANDLERS = {
    "Conv2D": _Chain.convolution,
    "Dense": _Chain.dense,
    "AveragePooling2D": _Chain.pooling,
    "Flatten": _Chain.flatten,
    "ReLU": _Chain.relu,
    "Activation": _Chain.activation,
    "Softmax": _Chain.softmax_layer,
    "BatchNormalization": _Chain.normalisation,
    "Rescaling": _Chain.rescaling,
}
_IDLE = (
    *("Dropout", "SpatialDropout2D", "AlphaDropout", "GaussianDropout", "GaussianNoise"),
    *("ActivityRegularization",),
)
"""Layers that only act in training."""

_INSTEAD = {
    "MaxPooling2D": "use AveragePooling2D, or a stride in the convolution before it",
    "GlobalAveragePooling2D": "use AveragePooling2D over all rows and columns, and Flatten",
    "LayerNormalization": "use BatchNormalization",
    "GroupNormalization": "use BatchNormalization",
    "Normalization": "use Rescaling, or BatchNormalization",
    "DepthwiseConv2D": "use Conv2D",
    "SeparableConv2D": "use Conv2D",
    "Conv2DTranspose": "use Conv2D",
    "Conv1D": "use Conv2D on the sensor's rows and columns",
    "Conv3D": "use Conv2D on the sensor's rows and columns",
    "ZeroPadding2D": "use padding='same' in the convolution after it",
    "Cropping2D": "use a convolution with a stride",
    "Reshape": "use an input of rows, columns, channels: keras.Input((10, 10, 1))",
    "Lambda": "nothing in a model file is executed; use Keras's own layers",
    "TFOpLambda": "use Keras's own layers",
    "SlicingOpLambda": "use Keras's own layers",
    "Add": "use a chain of layers without branches",
    "Concatenate": "use a chain of layers without branches",
}
"""Alternatives to layers that are not supported."""

_USE_RELU = "use activation='relu' (in the output 'softmax' or None)"
for _kind in ("LeakyReLU", "PReLU", "ELU", "ThresholdedReLU", "Relu", "Relu6", "LeakyRelu"):
    _INSTEAD[_kind] = _USE_RELU


def _instead(kind) -> str:
    """An alternative to a layer that is not supported."""
    return _INSTEAD.get(
        kind,
        "use Conv2D (with a stride), AveragePooling2D, Dense, Flatten, ReLU, BatchNormalization",
    )


def _refuse(layer, problem):
    raise ModelFileError(f"{layer}: {problem}")


def _check(layer, names, shapes):
    """Refuse a layer whose arrays have other shapes or are not finite."""
    if [array.shape for array in layer.arrays] != [tuple(shape) for shape in shapes]:
        found = ", ".join(shown(array.shape)[1:-1] for array in layer.arrays) or "none"
        expected = ", ".join(str(tuple(shape)) for shape in shapes)
        _refuse(layer, f"its arrays have shapes {found}, not {expected}; save the model again")
    for name, array in zip(names, layer.arrays, strict=True):
        if not np.isfinite(array).all():
            _refuse(layer, f"its {name} has NaN or infinite values; "
                    "train the model again, with a lower learning rate")  # fmt: skip


def _channels_last(layer):
    if layer.config.get("data_format", "channels_last") != "channels_last":
        _refuse(layer, "expects channels first; use data_format='channels_last'")


def _count(layer, key) -> int:
    value = layer.config.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MAX_VALUES:
        _refuse(layer, f"its {key} is not from 1 to {MAX_VALUES}; save the model again")
    return value


def _pair(layer, key, default=None) -> tuple:
    """(rows, columns) of a setting that is one number or two."""
    value = layer.config.get(key, default)
    value = value if isinstance(value, list) else [value, value]
    counts = [n for n in value if isinstance(n, int) and not isinstance(n, bool)]
    if len(value) != 2 or len(counts) != 2 or not 1 <= min(counts) <= max(counts) <= MAX_VALUES:
        _refuse(layer, f"its {key} is not a pair of positive integers; save the model again")
    return tuple(counts)


def _plain(value):
    """A number or list, also where Keras saved it as a NumPy object."""
    if isinstance(value, dict) and value.get("class_name") == "__numpy__":
        config = value.get("config")
        return config.get("value") if isinstance(config, dict) else None
    return value


def _is_number(value) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and abs(value) < 1e30  # False for NaN


def _number(layer, key, default) -> float:
    value = _plain(layer.config.get(key, default))
    if not _is_number(value):
        _refuse(layer, f"its {key} is not a number; save the model again")
    return float(value)
