"""A user's Keras model as an architecture and weights that compute the same function.

The chip supports a chain of convolutions and dense layers, each followed by a ReLU (except for the
output), with average pooling between them.  Layers that only act in training are left out.  Layers
that are affine per channel (batch normalisation, rescaling) are folded into the previous layer if
that layer has no ReLU yet, and otherwise into the next layer.  All other layers are refused, with
a message that names the layer and an alternative.  In the end the architecture is compared with the
model on random images.

Files of Keras 2 and 3 are loaded by the Keras that wrote them, in its safe mode.
"""

import functools
import json
import math
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deploy.errors import UserError
from deploy.files import reporting_os_errors, sha256_of
from models.architecture import MAX_LAYERS, MAX_VALUES, Architecture, Convolution, Dense, Pooling

# Random images on which the architecture is compared with the model.
TRIED = 8

REMEDY = "give a .keras or .h5 file that model.save() wrote"


class ModelFileError(UserError):
    """A file is not a Keras model, or the model is not supported; the message is one line."""


class KerasModel(NamedTuple):
    """A user's model as an architecture and its weights."""

    architecture: Architecture
    # ``"conv1.kernel"``, ... as float32, with the shapes of ``architecture.weight_shapes``. With a
    # ReLU after each convolution and hidden dense layer the network computes the model's logits.
    weights: dict
    # One line for each layer that was folded or left out.
    notes: tuple


class _Layer(NamedTuple):
    """A layer of a model: its class, name, arguments, and arrays in Keras's order."""

    kind: str
    name: str
    config: dict
    arrays: tuple

    def __str__(self):
        return f"layer {self.name!r} ({self.kind})"

    def refuse(self, problem):
        raise ModelFileError(f"{self}: {problem}")

    def pair(self, key) -> tuple:
        """(rows, columns) of an argument that is one number or two."""
        value = self.config[key]
        return tuple(value) if isinstance(value, (list, tuple)) else (value, value)


def read_keras(path) -> KerasModel:
    """Read a ``.keras`` or ``.h5`` file; a file is read once in a process.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    ModelFileError
        The file is no model, or the model is not supported; the message names the file, the layer
        if any, and a remedy.
    UserError
        The file cannot be read.
    """
    path = Path(path)
    try:
        with reporting_os_errors(path, "cannot read", "check the path"):
            return _read(path, sha256_of(path))
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


@functools.lru_cache(maxsize=2)
def _read(path, sha256) -> KerasModel:
    """Read a file whose content has a hash."""
    model = _loaded(path)
    if len(model.inputs) != 1 or len(model.outputs) != 1:
        raise ModelFileError("has several inputs or outputs; use one chain of layers")
    model_read = from_layers(model.inputs[0].shape[1:], [_layer(layer) for layer in model.layers])
    if not model_read.architecture.spiking:
        raise ModelFileError("has no layer of neurons before its output; add one with a ReLU")
    images = np.random.default_rng(0).uniform(0, 1, (TRIED, *model_read.architecture.input_shape))
    _compare(model, model_read, images.astype(np.float32))
    return model_read


def _loaded(path):
    """The model in a file, in the Keras that wrote it."""
    from models.keras.keras2 import tf  # noqa: F401  before Keras 3 imports TensorFlow

    try:
        if _version(path).startswith("2."):
            from tf_keras.models import load_model
        else:
            from keras.models import load_model
        model = load_model(path, compile=False, safe_mode=True)
        model.inputs[0].shape  # noqa: B018  refuses a model that was never built
        return model
    except Exception as error:  # Keras fails in many ways on other files and on custom classes
        reason = " ".join(str(error).split())[:200]
        raise ModelFileError(f"Keras cannot load it ({reason}); {REMEDY}") from error


def _version(path) -> str:
    """The version of Keras that wrote a file."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            return json.loads(archive.read("metadata.json"))["keras_version"]
    import h5py

    with h5py.File(path, "r") as file:
        return str(file.attrs["keras_version"])


def _layer(layer) -> _Layer:
    return _Layer(type(layer).__name__, layer.name, layer.get_config(), tuple(layer.get_weights()))


def _compare(model, read, images):
    """Refuse a model that is no chain of its layers, or that has an effect in prediction only."""
    from models.cnn import build_cnn, predict, set_weights

    network = build_cnn(read.architecture)
    set_weights(network, read.weights)
    shown = images.reshape(len(images), *model.inputs[0].shape[1:])
    with np.errstate(all="ignore"):
        logits, outputs = predict(network, images), np.asarray(model(shown, training=False))
        ends = [logits, np.exp(logits - logits.max(1, keepdims=True))]
        ends[1] /= ends[1].sum(1, keepdims=True)
        size = np.abs(outputs).max()
        if not any(np.abs(end - outputs).max() <= 1e-3 * size for end in ends):
            raise ModelFileError(_NO_CHAIN)


def from_layers(input_shape, layers) -> KerasModel:
    """Turn a chain of layers into an architecture and its weights.

    Parameters
    ----------
    input_shape : tuple of int
        Shape of one sample.
    layers : sequence of _Layer

    Raises
    ------
    ModelFileError
        A layer is not supported.
    """
    if len(input_shape) == 1:
        raise ModelFileError(
            f"its input is a vector of {input_shape[0]} values; use the sensor's rows and "
            "columns: keras.Input((rows, columns, channels)) and Flatten"
        )
    shape = tuple(input_shape) + (1,) * (len(input_shape) == 2)
    if None in shape or len(shape) != 3 or math.prod(shape) > MAX_VALUES:
        sizes = "x".join(map(str, input_shape[:6]))
        raise ModelFileError(
            f"its input of {sizes} is not an image of a sensor's rows and columns; begin the model "
            "with keras.Input((rows, columns, channels))"
        )
    chain = _Chain(shape)
    for layer in layers:
        chain.add(layer)
    return chain.finished()


class _Chain:
    """The layers converted so far.

    ``scale`` and ``offset`` are the affine function that still has to be folded into the next
    layer: the model's signal is ``scale * signal + offset`` of the converted layers' signal.
    """

    def __init__(self, shape):
        self.input_shape = self.shape = shape
        self.layers = []
        self.trained = []  # for each convolution and dense layer: [its _Layer, kernel, bias]
        self.scale, self.offset = np.ones(shape[2]), np.zeros(shape[2])
        self.is_linear = False  # the last layer is a convolution or dense layer without a ReLU
        self.softmax = None
        self.notes = []

    def add(self, layer: _Layer):
        if layer.kind == "InputLayer":
            return
        if layer.kind in _IDLE:
            self.notes.append(f"{layer} left out: it only acts in training")
            return
        if self.softmax is not None:
            layer.refuse(f"follows the softmax of {self.softmax}; remove that softmax")
        if layer.kind not in _HANDLERS:
            layer.refuse(f"not supported; {_INSTEAD.get(layer.kind, _USABLE)}")
        if layer.config.get("data_format") == "channels_first":
            layer.refuse("expects channels first; use data_format='channels_last'")
        if not all(np.isfinite(array).all() for array in layer.arrays):
            layer.refuse("has NaN or infinite weights; train it again, with a lower learning rate")
        if len(self.layers) >= MAX_LAYERS:
            raise ModelFileError(f"has more than {MAX_LAYERS} layers; use fewer")
        _HANDLERS[layer.kind](self, layer)

    def finished(self) -> KerasModel:
        if not self.layers or self.layers[-1].kind != "dense":
            last = "no layer" if not self.layers else str(self.layers[-1])
            raise ModelFileError(
                f"ends with {last}, not with a dense layer; add a Dense with one unit per class"
            )
        layer = self.trained[-1][0]
        if not self.is_linear:
            layer.refuse("the output has a ReLU; use activation='softmax' or None")
        if self.layers[-1].units < 2:
            layer.refuse("has one output; use one unit per class, at least 2")
        layers = (*self.layers[:-1], replace(self.layers[-1], output=True))
        architecture = Architecture(self.input_shape, layers)
        names = [n for n, one in zip(architecture.names, layers, strict=True) if one.kind != "pool"]
        weights = {}
        for name, (layer, kernel, bias) in zip(names, self.trained, strict=True):
            with np.errstate(over="ignore"):  # infinite values are refused below
                kernel, bias = (np.asarray(array, np.float32) for array in (kernel, bias))
            if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
                layer.refuse("its weights are too large for single precision")
            weights |= {f"{name}.kernel": kernel, f"{name}.bias": bias}
        return KerasModel(architecture, weights, tuple(self.notes))

    # --- layers with weights ----------------------------------------------------------------------

    def convolution(self, layer):
        (rows, columns), strides = layer.pair("kernel_size"), layer.pair("strides")
        if rows != columns:
            layer.refuse(f"its kernel of {rows}x{columns} is not square; use a square one")
        if strides[0] != strides[1]:
            layer.refuse("its strides along rows and columns differ; use the same")
        if layer.pair("dilation_rate") != (1, 1):
            layer.refuse("is dilated; use dilation_rate=1 and a larger kernel or a stride")
        if layer.config["groups"] != 1:
            layer.refuse("is a grouped convolution; use groups=1")
        conv = Convolution(layer.config["filters"], rows, strides[0], layer.config["padding"])
        kernel, bias = self._weights(layer, conv)
        if self.offset.any() and any(map(any, conv.pads(self.shape))):
            layer.refuse(
                "zero padding after a normalisation or rescaling with an offset cannot be folded "
                "into weights; use padding='valid', or normalise after the convolution and before "
                "its ReLU"
            )
        bias = bias + np.einsum("ijcf,c->f", kernel, self.offset)
        self._append(layer, conv, kernel * self.scale[:, None], bias)

    def dense(self, layer):
        if len(self.shape) == 3:
            layer.refuse("is applied to each row and column; put a Flatten before it")
        dense = Dense(layer.config["units"])
        kernel, bias = self._weights(layer, dense)
        self._append(layer, dense, kernel * self.scale[:, None], bias + self.offset @ kernel)

    def _weights(self, layer, made):
        """Kernel and bias of a layer in the file."""
        if self.is_linear:
            self.trained[-1][0].refuse(f"has no ReLU before {layer.name!r}; use activation='relu'")
        if math.prod(made.shape(self.shape)) > MAX_VALUES:
            layer.refuse(f"has more than {MAX_VALUES} output values")
        kernel, *biases = (array.astype(float) for array in layer.arrays)
        if kernel.shape != made.weight_shapes(self.shape)["kernel"]:
            layer.refuse(_NO_CHAIN)
        return kernel, biases[0] if biases else np.zeros(kernel.shape[-1])

    def _append(self, layer, made, kernel, bias):
        self.layers.append(made)
        self.trained.append([layer, kernel, bias])
        self.shape = made.shape(self.shape)
        self.scale, self.offset = np.ones(self.shape[-1]), np.zeros(self.shape[-1])
        self.is_linear = True
        self.activation(layer)

    # --- layers without weights -------------------------------------------------------------------

    def pooling(self, layer):
        size = layer.pair("pool_size")
        padded = layer.config["padding"] != "valid" and any(n % size[0] for n in self.shape[:2])
        if size[0] != size[1] or layer.pair("strides") != size or padded:
            layer.refuse(
                "its windows overlap, are padded or are not square; "
                "use AveragePooling2D(2), strides=None, padding='valid'"
            )
        if self.is_linear:
            before = self.trained[-1][0]
            before.refuse(f"has no ReLU before {layer.name!r}; put the ReLU before it")
        if size != (1, 1):
            self.layers.append(Pooling(size[0]))
            self.shape = self.layers[-1].shape(self.shape)

    def flatten(self, layer):
        if len(self.shape) == 3:
            positions = self.shape[0] * self.shape[1]
            self.shape = (math.prod(self.shape),)
            self.scale, self.offset = (np.tile(a, positions) for a in (self.scale, self.offset))

    def relu(self, layer):
        for key in ("max_value", "negative_slope", "threshold"):
            if layer.config.get(key) not in ((None,) if key == "max_value" else (None, 0)):
                layer.refuse(f"has a {key}; use a plain ReLU")
        if self.is_linear:
            self.is_linear = False
        elif not self.trained:
            layer.refuse("precedes the first Conv2D or Dense; remove it")
        elif (self.scale != 1).any() or self.offset.any():
            layer.refuse(
                "the normalisation or rescaling before it follows a ReLU; "
                "put the normalisation between the layer and its ReLU"
            )
        # Otherwise the signal is not negative (after a ReLU, maybe pooled), and passes unchanged.

    def activation(self, layer):
        what = layer.config.get("activation")
        if what == "relu":
            self.relu(layer)
        elif what == "softmax":
            self.end(layer)
        elif what not in (None, "linear"):
            what = repr(what) if isinstance(what, str) else "object"
            layer.refuse(f"activation {what} is not supported; {_USE_RELU}")

    def end(self, layer):
        if not self.is_linear or self.layers[-1].kind != "dense":
            layer.refuse("its softmax does not follow the output; remove it")
        self.softmax = layer
        self.notes.append(f"{layer}: its softmax left out, which does not change the prediction")

    def normalisation(self, layer):
        axis = layer.config["axis"]
        axis = axis[0] if isinstance(axis, (list, tuple)) and len(axis) == 1 else axis
        if axis not in (-1, len(self.shape)):
            layer.refuse("does not normalise over channels; use axis=-1")
        arrays = [array.astype(float) for array in layer.arrays]
        gamma = arrays.pop(0) if layer.config["scale"] else 1.0
        beta = arrays.pop(0) if layer.config["center"] else 0.0
        mean, variance = arrays
        scale = gamma / np.sqrt(variance + layer.config["epsilon"])
        self._affine(layer, np.broadcast_to(scale, mean.shape), beta - mean * scale)

    def rescaling(self, layer):
        values = [np.asarray(layer.config[key], float) for key in ("scale", "offset")]
        if any(value.size not in (1, self.shape[-1]) for value in values):
            layer.refuse("its scale and offset are not one number, or one per channel")
        self._affine(layer, *(np.broadcast_to(value, self.shape[-1:]) for value in values))

    def _affine(self, layer, scale, offset):
        """Fold ``scale * signal + offset``, with one value per channel."""
        if scale.shape != self.shape[-1:]:
            layer.refuse(_NO_CHAIN)
        with np.errstate(all="ignore"):  # infinite weights are refused in finished()
            if not self.is_linear:
                self.scale, self.offset = scale * self.scale, scale * self.offset + offset
                self.notes.append(f"{layer}: folded into the next layer")
                return
            before, kernel, bias = self.trained[-1]
            # In a flattened signal the channels of a convolution repeat at each position.
            scales, offsets = (a.reshape(-1, len(bias)) for a in (scale, offset))
            if (scales != scales[0]).any() or (offsets != offsets[0]).any():
                layer.refuse("normalises each position separately; put it before the Flatten")
            self.trained[-1] = [before, kernel * scales[0], bias * scales[0] + offsets[0]]
        self.notes.append(f"{layer}: folded into {before}")


_HANDLERS = {
    "Conv2D": _Chain.convolution,
    "Dense": _Chain.dense,
    "AveragePooling2D": _Chain.pooling,
    "Flatten": _Chain.flatten,
    "ReLU": _Chain.relu,
    "Activation": _Chain.activation,
    "Softmax": _Chain.end,
    "BatchNormalization": _Chain.normalisation,
    "Rescaling": _Chain.rescaling,
}
# Layers that only act in training.
_IDLE = (
    *("Dropout", "SpatialDropout2D", "AlphaDropout", "GaussianDropout", "GaussianNoise"),
    *("ActivityRegularization",),
)

_NO_CHAIN = "is not one chain of layers, each called once and with its input only; build one"
_USABLE = "use Conv2D (with a stride), AveragePooling2D, Dense, Flatten, ReLU, BatchNormalization"
_USE_RELU = "use activation='relu' (in the output 'softmax' or None)"
# Alternatives to layers that are not supported.
_INSTEAD = {
    "MaxPooling2D": "use AveragePooling2D, or a stride in the convolution before it",
    "GlobalAveragePooling2D": "use AveragePooling2D over all rows and columns, and Flatten",
    "LayerNormalization": "use BatchNormalization",
    "Normalization": "use Rescaling, or BatchNormalization",
    "DepthwiseConv2D": "use Conv2D",
    "SeparableConv2D": "use Conv2D",
    "ZeroPadding2D": "use padding='same' in the convolution after it",
    "Reshape": "use an input of rows, columns, channels: keras.Input((10, 10, 1))",
    "Sequential": "nested models are not supported; build one model of all layers",
    "Functional": "nested models are not supported; build one model of all layers",
    "LeakyReLU": _USE_RELU,
    "PReLU": _USE_RELU,
    "ELU": _USE_RELU,
}
