"""A chain of Keras layers as an architecture and weights.

The chip has convolutions and dense layers of neurons with the curve of a ReLU, averaging between
them, and a linear output.  Between two layers with weights, Keras's layers are linear: they scale
(normalisation), move values (flatten, reshape, permute, pad) or average.
:class:`LayerConverter` keeps this linear function as a sparse matrix and an offset,

    signal = map @ built + offset,

with the signal of the Keras model on the left, and that of the layers built so far on the right.
The next layer with weights takes it in: for a dense layer with any map, ``kernel' = map^T kernel``
and ``bias' = bias + offset kernel``; for a convolution if the map scales channels and pads zeros.

`HANDLERS` has a function for each layer that can be converted, `REFUSED` an alternative for others.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from deploy.network.geometry import list_windows
from models.architecture import (
    MAX_LAYERS,
    MAX_VALUES,
    MAX_WEIGHTS,
    Architecture,
)
from models.keras.files import ModelFileError
from models.keras.model import KerasLayer, KerasModel, MaxPool
from models.keras.signal import Signal
from models.ops import Convolution, Dense, Pooling
from models.windows import Window, fit_to_chip, spread_kernel, sum_shifted

# Maximum number of weights of a convolution that is written as a matrix.
MAX_MATRIX_WEIGHTS = 20_000_000

# The least deviation of Keras's Normalization.
SMALLEST_DEVIATION = 1e-7

# The scale below which a first Rescaling is for pixels (1/127.5 is the largest in use), and the sum
# of mean and deviation above which a Normalization is.
MAX_PIXEL_SCALE = 0.01
MAX_STANDARDISED = 2.0

# Largest value of a pixel, with which an image of this project is multiplied where the first layer
# of a model takes pixels.
MAX_PIXEL = 255.0

RETRAIN = "with --retrain it becomes"


@dataclass
class _Sums:
    """Weighted sums: a layer, and its kernel and bias with what is folded into them."""

    layer: KerasLayer
    kernel: np.ndarray = field(repr=False)
    bias: np.ndarray = field(repr=False)
    curve: object = "relu"  # in the file; the architecture has ReLUs only
    maxima: MaxPool | None = None  # in the file between the built signal and the kernel


@dataclass(frozen=True)
class _Means:
    """Averages over windows of the built image, with a scale and offset for each channel."""

    size: tuple
    strides: tuple
    affine: tuple
    map: object  # of the signal, which tells if anything else followed


def convert_layers(
    input_shape, layers, retrain: bool = False, grid=None, pixels: bool = True
) -> KerasModel:
    """Turn a chain of layers into an architecture and its weights.

    Parameters
    ----------
    input_shape : tuple of int
        Shape of one sample.
    layers : sequence of KerasLayer
    retrain : bool
        Replace what cannot be converted exactly, where training makes up for it.
    grid : tuple of int, optional
        (rows, columns, channels) of an image, for a model whose input is a vector.
    pixels : bool
        Multiply images by 255 for a model that begins with the scaling of pixels.

    Raises
    ------
    ModelFileError
        A layer is not supported.
    """
    order = _find_input_order(input_shape, layers, grid)
    converter = LayerConverter(order, retrain, pixels)
    for layer in layers:
        converter.add(layer)
    return converter.finish()


def _find_input_order(input_shape, layers, grid):
    """The positions of an image's values in the model's input, and the shape of the image."""
    shape = tuple(input_shape)
    sizes = "x".join(map(str, shape[:6]))
    if None in shape or not 1 <= len(shape) <= 3 or math.prod(shape) > MAX_VALUES:
        raise ModelFileError(
            f"its input of {sizes} is not an image of a sensor's rows and columns; begin the model "
            "with keras.Input((rows, columns, channels))"
        )
    first = next((layer for layer in layers if layer.kind != "InputLayer"), None)
    if len(shape) == 1:
        image = _find_image_of_vector(shape[0], first, grid)
        return np.arange(shape[0]), image
    if len(shape) == 2:
        shape = (*shape, 1)
    formats = [layer.config["data_format"] for layer in layers if "data_format" in layer.config]
    if len(input_shape) == 3 and formats[:1] == ["channels_first"]:
        image = (*shape[1:], shape[0])
        return np.moveaxis(np.arange(math.prod(shape)).reshape(image), -1, 0), image
    return np.arange(math.prod(shape)).reshape(input_shape), shape


def _find_image_of_vector(length, first, grid):
    """The shape of the image that a vector of values has: what the model says, or a square."""
    if first is not None and first.kind == "Reshape":
        target = tuple(first.config["target_shape"])
        if len(target) in (2, 3) and math.prod(target) == length:
            return target if len(target) == 3 else (*target, 1)
    if grid is not None and math.prod(grid) == length:
        return tuple(grid)
    side = math.isqrt(length)
    if side * side == length:
        return side, side, 1
    raise ModelFileError(
        f"its input is a vector of {length} values; say of which rows and columns: "
        "--set skin.rows=... --set skin.columns=..."
    )


class LayerConverter:
    """The layers converted so far, and the linear function from their signal to the model's.

    Parameters
    ----------
    order : (ndarray, tuple)
        From `_find_input_order`.
    retrain, pixels : bool
        As for `convert_layers`.
    """

    def __init__(self, order, retrain, pixels=True):
        self.input_order, self.input_shape = order
        self.retrain = retrain
        self.pixels = pixels
        self.layers = []
        self.sums = []
        self.max_pools = {}  # by the index of their layer
        self.maxima = None  # over windows of the built image, which the next Dense takes in
        self.means = None  # over windows of the built image, which the next Conv2D may take in
        self.input_scale = 1.0
        self.paddings = {}  # by the index of their layer
        self.is_linear = False  # no activation since the last weighted sums
        self.end = None  # (layer, activation) of an output, if it is one
        self.notes = []
        self.replaced = []
        self.signal = Signal(self.input_shape)
        self.signal.arrange(self.input_order)

    @property
    def ends_dense(self) -> bool:
        """True if the last layer built is dense."""
        return bool(self.layers) and isinstance(self.layers[-1], Dense)

    # --- a layer ----------------------------------------------------------------------------------

    def add(self, layer: KerasLayer):
        if layer.kind == "InputLayer":
            return
        if layer.kind in IDLE:
            self.notes.append(f"{layer} left out: it only acts in training")
            return
        if layer.kind not in HANDLERS:
            layer.refuse(f"not supported; {REFUSED.get(layer.kind, USABLE)}")
        if not all(np.isfinite(array).all() for array in layer.arrays):
            layer.refuse("has NaN or infinite weights; train it again, with a lower learning rate")
        if len(self.layers) >= MAX_LAYERS:
            raise ModelFileError(f"has more than {MAX_LAYERS} layers; use fewer")
        if self.maxima is not None and layer.kind in WITH_WINDOWS:
            layer.refuse(
                "follows a maximum whose windows are cut off at the edge, or overlap so that "
                "averages without overlap have another shape; use MaxPooling2D(2) of an even "
                "number of rows and columns, or a stride of 2 with padding='same'"
            )
        if self.end is not None:  # no output, since a layer follows
            before, curve = self.end
            self.end = None
            if curve == "softmax":
                layer.refuse(f"follows the softmax of {before}; remove that softmax")
            self.use_curve(before, curve)
        is_channels_first = layer.config.get("data_format") == "channels_first"
        if is_channels_first and self.signal.is_image:
            self.signal.move_axis(0, -1)
        HANDLERS[layer.kind](self, layer)
        if is_channels_first and self.signal.is_image:
            self.signal.move_axis(-1, 0)

    def finish(self) -> KerasModel:
        is_dense = self.ends_dense and self.signal.is_unchanged
        if is_dense and not self.is_linear:
            self.end = self.sums[-1].layer, "relu"
        elif not is_dense:
            self.read_out()
        last = self.sums[-1]
        curve = "linear"
        if self.end is not None:
            layer, curve = self.end
            self.notes.append(
                f"{layer}: its {_name(curve)} left out, which does not change the prediction"
            )
        if self.layers[-1].units == 1:
            if curve != "sigmoid":
                last.layer.refuse(
                    "has one output; use one unit per class, or activation='sigmoid' for two "
                    "classes"
                )
            # Softmax of 0 and z is the sigmoid of z.
            last.kernel = np.concatenate([np.zeros_like(last.kernel), last.kernel], axis=1)
            last.bias = np.concatenate([[0.0], last.bias])
            self.layers[-1] = Dense(2)
            self.notes.append(f"{last.layer}: one output became two classes")
        return self._make_model(curve)

    def _make_model(self, end):
        layers = (*self.layers[:-1], replace(self.layers[-1], output=True))
        architecture = Architecture(self.input_shape, layers)
        names = architecture.names
        weighted = [name for name, one in zip(names, layers, strict=True) if one.has_neurons]
        weights = {}
        for name, sums in zip(weighted, self.sums, strict=True):
            kernel = sums.kernel
            if sums.maxima is not None:
                kernel = sums.maxima.means.T @ kernel
            with np.errstate(over="ignore"):  # infinite values are refused below
                kernel, bias = (np.asarray(a, np.float32) for a in (kernel, sums.bias))
            if not (np.isfinite(kernel).all() and np.isfinite(bias).all()):
                sums.layer.refuse("its weights are too large for single precision")
            weights |= {f"{name}.kernel": kernel, f"{name}.bias": bias}
        curves = {name: sums.curve for name, sums in zip(weighted, self.sums, strict=True)}
        max_pools = {names[index]: pool for index, pool in self.max_pools.items()}
        for name, sums in zip(weighted, self.sums, strict=True):
            if sums.maxima is not None:
                kernel = np.asarray(sums.kernel, np.float32)
                max_pools[name] = replace(sums.maxima, kernel=kernel)
        return KerasModel(
            architecture=architecture,
            weights=weights,
            notes=tuple(self.notes),
            replaced=tuple(self.replaced),
            curves={n: c for n, c in curves.items() if c != "relu" and n != "output"},
            max_pools=max_pools,
            paddings={names[index]: values for index, values in self.paddings.items()},
            end=end,
            input_order=self.input_order,
            input_scale=self.input_scale,
        )

    # --- layers with weights ----------------------------------------------------------------------

    def convert_convolution(self, layer):
        if not self.signal.is_image:
            layer.refuse("its input has no rows and columns")
        self.require_curve(layer)
        kernel, bias = _read_kernel_and_bias(layer)
        if kernel.shape[1] != self.signal.shape[2]:
            layer.refuse(NO_CHAIN)
        window, counts, (scale, offset) = self.find_window(layer, kernel)
        if window.stride[0] != window.stride[1]:
            layer.refuse("its strides along rows and columns differ; use the same")
        own = layer.config["padding"]
        paddings = (own, "same" if own == "valid" else "valid")
        built = self.signal.built
        fitting = fit_to_chip(window, built[:2], counts, paddings)
        if fitting is None:
            size = "x".join(map(str, window.kernel.shape[2:]))
            layer.refuse(
                f"its kernel of {size} with {window.before} zeros before the image has other "
                "windows than a square kernel with padding='same' or 'valid'; use one of these"
            )
        kernel = fitting["weights"]
        made = Convolution(kernel.shape[-1], len(kernel), fitting["stride"], fitting["padding"])
        if offset.any() and _reads_padding(window, built, counts):
            self.pad_without_offset(layer, scale, offset)
        if len(kernel) != max(layer.read_pair("kernel_size")):
            self.notes.append(
                f"{layer}: its windows became a kernel of {made.kernel}x{made.kernel}"
            )
        bias = bias + np.einsum("ijcf,c->f", kernel, offset)
        self.append_sums(layer, made, kernel * scale[:, None], bias)
        self.convert_activation(layer)

    def find_window(self, layer, kernel):
        """The windows of a convolution on the built image, their counts, and its affine input.

        Parameters
        ----------
        layer : KerasLayer
        kernel : ndarray, shape (filters, channels, rows, columns)
        """
        strides = layer.read_pair("strides")
        sides = self.signal.shape[:2]
        along = [
            list_windows(*side, layer.config["padding"])
            for side in zip(sides, kernel.shape[2:], strides, strict=True)
        ]
        counts = [count for count, _, _ in along]
        before = tuple(
            zeros + pads[0] for (_, zeros, _), pads in zip(along, self.signal.pads, strict=True)
        )
        if min(counts) < 1:
            layer.refuse("its kernel is larger than its input; use a smaller one")
        affine = self.signal.find_channel_affine()
        if affine is not None:
            return Window(kernel, strides, before), counts, affine
        means = self.means
        if means is None or means.map is not self.signal.map:
            layer.refuse(
                "its input is averaged over windows that overlap or are cut off, or is in another "
                "order than rows, columns and channels; use AveragePooling2D(2), or a Dense after "
                "it"
            )
        if any(zeros or after for _, zeros, after in along):
            layer.refuse(
                "pads zeros around averages over windows that overlap or are not square; use "
                "padding='valid', AveragePooling2D(2), or a Dense after the averages"
            )
        kernel = spread_kernel(kernel, 1, means.strides)
        kernel = sum_shifted(kernel, means.size, (1, 1)) / math.prod(means.size)
        strides = tuple(a * b for a, b in zip(strides, means.strides, strict=True))
        return Window(kernel, strides, before), counts, means.affine

    def pad_without_offset(self, layer, scale, offset):
        """Pad zeros of the built signal instead of zeros of the normalised one."""
        if not self.retrain or not scale.all():
            layer.refuse(
                "zero padding after a normalisation or rescaling with an offset cannot be folded "
                f"into weights; {RETRAIN} padding before the normalisation and is trained further; "
                "or use padding='valid', or normalise before the ReLU of the layer before"
            )
        self.paddings[len(self.layers)] = -offset / scale
        self.replaced.append(f"{layer}: zeros padded before the normalisation, not after it")

    def convert_dense(self, layer):
        if len(self.signal.shape) != 1:
            layer.refuse("is applied to each row and column; put a Flatten before it")
        kernel, bias = _read_kernel_and_bias(layer)
        if len(kernel) != len(self.signal.offset):
            layer.refuse(NO_CHAIN)
        self.append_dense(layer, kernel, bias)
        self.convert_activation(layer)

    def append_dense(self, layer, kernel, bias):
        """Append a dense layer; one that follows another without an activation is multiplied."""
        bias = self.signal.offset @ kernel + bias
        kernel = self.signal.map.T @ kernel
        if self.maxima is not None or (self.layers and isinstance(self.layers[-1], Pooling)):
            self.require_curve(layer)
        if self.is_linear:
            before = self.make_linear_dense()
            bias = before.bias @ kernel + bias
            kernel = before.kernel @ kernel
            self.maxima = before.maxima
            self.notes.append(f"{before.layer}: folded into {layer}, since it has no activation")
            self.layers.pop()
            self.sums.pop()
        self.append_sums(layer, Dense(kernel.shape[1]), kernel, bias)

    def make_linear_dense(self) -> _Sums:
        """The last sums, which have no activation, as those of a dense layer."""
        last = self.sums[-1]
        made = self.layers[-1]
        if isinstance(made, Dense):
            return last
        before = self.input_shape
        for layer in self.layers[:-1]:
            before = layer.compute_shape(before)
        if math.prod(before) * math.prod(self.signal.built) > MAX_MATRIX_WEIGHTS:
            last.layer.refuse("has no activation; use activation='relu'")
        from models.keras.keras2 import tf

        units = np.eye(math.prod(before)).reshape(-1, *before)
        matrix = tf.nn.conv2d(units, last.kernel, made.stride, made.padding.upper()).numpy()
        bias = np.broadcast_to(last.bias, self.signal.built).ravel()
        return _Sums(last.layer, matrix.reshape(len(units), -1), bias)

    def append_sums(self, layer, made, kernel, bias):
        weights = kernel.size
        if self.maxima is not None:
            weights = math.prod(self.maxima.image) * kernel.shape[1]
        if math.prod(made.compute_shape(self.signal.built)) > MAX_VALUES or weights > MAX_WEIGHTS:
            layer.refuse(f"has more than {MAX_VALUES} outputs or {MAX_WEIGHTS} weights")
        self.signal.begin(made.compute_shape(self.signal.built))
        self.layers.append(made)
        bias = np.broadcast_to(bias, kernel.shape[-1:])
        self.sums.append(_Sums(layer, kernel, bias, maxima=self.maxima))
        self.maxima = None
        self.is_linear = True

    def read_out(self):
        """Append an output that only passes on the signal, as after a global average."""
        if not self.sums or len(self.signal.shape) != 1:
            raise ModelFileError("does not end with a Dense; add one with one unit per class")
        outputs = len(self.signal.offset)
        self.append_dense(KerasLayer("Dense", "output", {}, ()), np.eye(outputs), np.zeros(outputs))

    # --- activations ------------------------------------------------------------------------------

    def convert_activation(self, layer):
        """Use the activation that a layer with weights, or an Activation, has."""
        curve = layer.config.get("activation")
        if not (curve is None or isinstance(curve, str)):
            layer.refuse(f"its activation is not one of Keras's; {USE_RELU}")
        if curve not in (None, "linear"):
            self.use_activation(layer, curve)

    def use_activation(self, layer, curve):
        """Use an activation for the output if possible, and otherwise for a hidden layer."""
        is_vector = len(self.signal.shape) == 1
        is_dense = self.is_linear and self.ends_dense and is_vector
        if curve == "softmax" and self.sums and is_vector and not is_dense:
            self.read_out()
            is_dense = True
        if is_dense and curve != "relu" and _is_monotone(curve):
            self.end = layer, curve
        else:
            self.use_curve(layer, curve)

    def use_curve(self, layer, curve):
        """Use the activation of a hidden layer."""
        if curve == "softmax":
            layer.refuse("its softmax does not follow the output; remove it")
        if not self.sums:
            layer.refuse("precedes the first Conv2D or Dense; remove it")
        last = self.sums[-1]
        if not self.is_linear:
            # A signal that is not negative passes a ReLU unchanged.
            is_positive = last.curve == "relu" and self.signal.is_never_negative
            if curve != "relu" or not is_positive:
                layer.refuse(
                    f"a second activation after that of {last.layer}; put the normalisation, or "
                    "the averaging, before or after both, or remove one"
                )
            return
        if not self.signal.is_moved:
            layer.refuse(
                "follows an average, or a normalisation of each position, of sums; put the "
                "activation before it, and the normalisation before the Flatten"
            )
        self.is_linear = False
        if curve == "relu":
            return
        if not self.retrain:
            layer.refuse(
                f"{_name(curve)!r} is not the curve of a spiking neuron, which is like a ReLU; "
                f"{RETRAIN} a ReLU and is trained further; or {USE_RELU}"
            )
        last.curve = curve
        self.replaced.append(f"{layer}: {_name(curve)} replaced by a ReLU")

    def require_curve(self, layer):
        """Refuse sums without an activation before a convolution."""
        if not self.is_linear:
            return
        last = self.sums[-1]
        if not self.retrain:
            last.layer.refuse(
                f"has no activation before {layer.name!r}; use activation='relu' ({RETRAIN} a ReLU)"
            )
        self.is_linear = False
        last.curve = "linear"
        self.replaced.append(f"{last.layer}: a ReLU added, since it has no activation")

    def convert_relu(self, layer):
        limits = {
            "max_value": layer.config.get("max_value"),
            "alpha": float(layer.config.get("negative_slope") or 0),
            "threshold": float(layer.config.get("threshold") or 0),
        }
        if limits["max_value"] is None and not limits["alpha"] + limits["threshold"]:
            self.use_activation(layer, "relu")
        else:
            self.use_activation(layer, _make_curve("ReLU with arguments", "relu", **limits))

    def convert_leaky_relu(self, layer):
        slope = layer.config.get("negative_slope", layer.config.get("alpha"))
        self.use_activation(
            layer, _make_curve("leaky_relu", "relu", alpha=float(np.asarray(slope)))
        )

    def convert_elu(self, layer):
        self.use_activation(layer, _make_curve("elu", "elu", alpha=float(layer.config["alpha"])))

    # --- layers that move values ------------------------------------------------------------------

    def convert_flatten(self, layer):
        self.signal.arrange(self.signal.positions.reshape(-1))

    def convert_reshape(self, layer):
        target = tuple(layer.config["target_shape"])
        try:
            self.signal.arrange(self.signal.positions.reshape(target))
        except ValueError:
            layer.refuse(NO_CHAIN)

    def convert_permute(self, layer):
        axes = [axis - 1 for axis in layer.config["dims"]]
        self.signal.arrange(self.signal.positions.transpose(axes))

    def convert_zero_padding(self, layer):
        pads = layer.config["padding"]
        pads = (pads, pads) if isinstance(pads, int) else pads
        pads = tuple((n, n) if isinstance(n, int) else tuple(n) for n in pads)
        sides = [n + sum(around) for n, around in zip(self.signal.shape, pads, strict=False)]
        if math.prod(sides) * self.signal.shape[2] > MAX_VALUES:
            layer.refuse(f"has more than {MAX_VALUES} values")
        self.signal.pad(pads)

    def convert_cropping(self, layer):
        cropped = layer.config["cropping"]
        (top, bottom), (left, right) = cropped
        rows, columns = self.signal.shape[:2]
        self.signal.arrange(self.signal.positions[top : rows - bottom, left : columns - right])

    # --- pooling ----------------------------------------------------------------------------------

    def convert_average_pooling(self, layer):
        self.pool_average(
            layer.read_pair("pool_size"), _read_strides(layer), layer.config["padding"]
        )

    def convert_global_average_pooling(self, layer):
        self.pool_average(self.signal.shape[:2], self.signal.shape[:2], "valid")
        self.end_global(layer)

    def end_global(self, layer):
        if not layer.config.get("keepdims", False):
            self.convert_flatten(layer)

    def pool_average(self, size, strides, padding):
        affine = (
            None if self.is_linear or self.signal.is_padded else self.signal.find_channel_affine()
        )
        sides = self.signal.shape[:2]
        fills = padding == "valid" or not any(n % k for n, k in zip(sides, size, strict=True))
        if affine is not None and size == strides and size[0] == size[1] and fills:
            if size != (1, 1):
                self.layers.append(Pooling(size[0]))
                self.signal.begin(self.layers[-1].compute_shape(self.signal.built), *affine)
            return
        is_inside = affine is not None and padding == "valid"
        self.signal.average(size, strides, padding)
        if is_inside:
            self.means = _Means(size, strides, affine, self.signal.map)

    def convert_max_pooling(self, layer):
        self.pool_maximum(
            layer, layer.read_pair("pool_size"), _read_strides(layer), layer.config["padding"]
        )

    def convert_global_max_pooling(self, layer):
        self.pool_maximum(layer, self.signal.shape[:2], self.signal.shape[:2], "valid")
        self.end_global(layer)

    def pool_maximum(self, layer, size, strides, padding):
        if not self.retrain:
            layer.refuse(
                f"the chip cannot take a maximum; {RETRAIN} an average and the network is trained "
                "further; or use AveragePooling2D, or a stride in the convolution before it"
            )
        affine = self.signal.find_channel_affine()
        sides = self.signal.shape[:2]
        counts = [list_windows(*of, padding)[0] for of in zip(sides, size, strides, strict=True)]
        is_like_average = strides[0] == strides[1] > 1 and counts == [
            n // strides[0] for n in sides
        ]
        if affine is None or self.signal.is_padded:
            layer.refuse(
                "its input is padded, or in another order than rows, columns and channels; use it "
                "right after a convolution"
            )
        scale, offset = affine
        pool = MaxPool(size, strides, padding, np.sign(scale))
        if is_like_average:
            self.max_pools[len(self.layers)] = pool
            self.layers.append(Pooling(strides[0]))
            self.signal.begin(self.layers[-1].compute_shape(self.signal.built), scale, offset)
            self.replaced.append(f"{layer}: replaced by AveragePooling2D({strides[0]})")
            return
        means = Signal(self.signal.built)
        means.average(size, strides, padding)
        self.maxima = replace(pool, means=means.map, image=self.signal.built)
        self.signal.begin(means.shape, scale, offset)
        self.replaced.append(f"{layer}: replaced by an average over the same windows")

    # --- layers that scale ------------------------------------------------------------------------

    def convert_batch_normalisation(self, layer):
        axis = layer.config["axis"]
        axis = axis[0] if isinstance(axis, (list, tuple)) and len(axis) == 1 else axis
        if not isinstance(axis, int):
            layer.refuse("normalises over several axes; use axis=-1")
        arrays = [array.astype(float) for array in layer.arrays]
        gamma = arrays.pop(0) if layer.config.get("scale", True) else 1.0
        beta = arrays.pop(0) if layer.config.get("center", True) else 0.0
        mean, variance = arrays
        scale = gamma / np.sqrt(variance + layer.config["epsilon"])
        shape = [1] * len(self.signal.shape)
        shape[axis if axis < 0 else axis - 1] = -1
        self.apply_affine(
            layer,
            *(np.reshape(a, shape) for a in (scale * np.ones_like(mean), beta - mean * scale)),
        )

    def convert_rescaling(self, layer):
        scale, offset = (np.asarray(layer.config[key], float) for key in ("scale", "offset"))
        self.take_pixels(layer, np.abs(scale).max() <= MAX_PIXEL_SCALE)
        self.apply_affine(layer, scale, offset)

    def convert_normalisation(self, layer):
        if layer.config.get("invert", False):
            layer.refuse("undoes a normalisation; use Rescaling")
        if layer.config.get("mean") is not None:
            mean, variance = (np.asarray(layer.config[key], float) for key in ("mean", "variance"))
        else:
            axis = layer.config["axis"]
            axes = axis if isinstance(axis, (list, tuple)) else [axis]
            shape = [1] * len(self.signal.shape)
            for one in axes if axis is not None else ():
                index = one if one < 0 else one - 1
                shape[index] = self.signal.shape[index]
            mean, variance = (np.reshape(a, shape).astype(float) for a in layer.arrays[:2])
        deviation = np.maximum(np.sqrt(variance), SMALLEST_DEVIATION)
        self.take_pixels(layer, (np.abs(mean) + deviation).max() > MAX_STANDARDISED)
        self.apply_affine(layer, 1 / deviation, -mean / deviation)

    def take_pixels(self, layer, has_pixels):
        """Multiply images, whose values end at 1, for a first layer whose input ends at 255."""
        if not has_pixels or self.layers or self.input_scale != 1:
            return
        if not self.pixels:
            self.notes.append(f"{layer}: scales pixels up to 255, and images here end at 1")
            return
        self.input_scale = MAX_PIXEL
        self.signal.scale(np.full(len(self.signal.offset), MAX_PIXEL), 0.0)
        self.notes.append(
            f"{layer}: is for pixels up to 255; images here end at 1 and are multiplied by 255"
        )

    def apply_affine(self, layer, scale, offset):
        """Fold ``scale * signal + offset``; they broadcast to the signal's shape."""
        try:
            scale, offset = (np.broadcast_to(a, self.signal.shape).ravel() for a in (scale, offset))
        except ValueError:
            layer.refuse(NO_CHAIN)
        with np.errstate(all="ignore"):  # infinite weights are refused in _model()
            if self.is_linear and self.fold_back(scale, offset):
                self.notes.append(f"{layer}: folded into {self.sums[-1].layer}")
                return
            has_means = self.means is not None and self.means.map is self.signal.map
            self.signal.scale(scale, offset)
            if has_means:
                self.scale_means(scale, offset)
        self.notes.append(f"{layer}: folded into the next layer")

    def scale_means(self, scale, offset):
        """Scale averages that a convolution may take in, if each channel is scaled as a whole."""
        scales, offsets = (a.reshape(-1, self.signal.shape[2]) for a in (scale, offset))
        if (scales == scales[0]).all() and (offsets == offsets[0]).all():
            before, constant = self.means.affine
            affine = (scales[0] * before, scales[0] * constant + offsets[0])
            self.means = replace(self.means, affine=affine, map=self.signal.map)

    def fold_back(self, scale, offset) -> bool:
        """Fold an affine function into the last weighted sums, if it is one for each channel."""
        if not self.signal.is_moved or self.signal.map.nnz != len(scale):
            return False
        last = self.sums[-1]
        scales, offsets = (
            (self.signal.map.T @ values).reshape(-1, len(last.bias)) for values in (scale, offset)
        )
        if (scales != scales[0]).any() or (offsets != offsets[0]).any():
            return False
        last.kernel = last.kernel * scales[0]
        last.bias = last.bias * scales[0] + offsets[0]
        return True


def _read_kernel_and_bias(layer):
    """Kernel and bias of a layer: (inputs, outputs) of a Dense, else (filters, channels, ...)."""
    kernel, *others = (array.astype(float) for array in layer.arrays)
    groups = layer.config.get("groups", 1)
    if layer.kind in ("DepthwiseConv2D", "SeparableConv2D"):
        groups = kernel.shape[2]
        kernel = kernel.reshape(*kernel.shape[:2], 1, -1)
    if layer.kind != "Dense":
        kernel = spread_kernel(
            kernel.transpose(3, 2, 0, 1), groups, layer.read_pair("dilation_rate")
        )
    if layer.kind == "SeparableConv2D":
        kernel = np.einsum("fcij,fo->ocij", kernel, others.pop(0)[0, 0])
    outputs = kernel.shape[1] if layer.kind == "Dense" else kernel.shape[0]
    return kernel, others[0] if others else np.zeros(outputs)


def _reads_padding(window, image, counts) -> bool:
    """True if windows read zeros beside the image."""
    if any(window.before):
        return True
    reach = window.kernel.shape[2:]
    sides = zip(image, reach, counts, strict=False)
    return any((count - 1) * window.stride[0] + size > n for n, size, count in sides)


def _read_strides(layer):
    return (
        layer.read_pair("pool_size")
        if layer.config["strides"] is None
        else layer.read_pair("strides")
    )


def _make_curve(name, function, **arguments) -> Callable:
    """An activation of Keras 2 with arguments."""

    def compute(values):
        from models.keras.keras2 import tf

        return getattr(tf.keras.activations, function)(values, **arguments)

    compute.__name__ = name
    return compute


def _name(curve) -> str:
    return curve if isinstance(curve, str) else curve.__name__


def _is_monotone(curve) -> bool:
    return _name(curve) in MONOTONE


HANDLERS = {
    "Conv2D": LayerConverter.convert_convolution,
    "DepthwiseConv2D": LayerConverter.convert_convolution,
    "SeparableConv2D": LayerConverter.convert_convolution,
    "Dense": LayerConverter.convert_dense,
    "Activation": LayerConverter.convert_activation,
    "ReLU": LayerConverter.convert_relu,
    "LeakyReLU": LayerConverter.convert_leaky_relu,
    "ELU": LayerConverter.convert_elu,
    "Softmax": lambda chain, layer: chain.use_activation(layer, "softmax"),
    "BatchNormalization": LayerConverter.convert_batch_normalisation,
    "Rescaling": LayerConverter.convert_rescaling,
    "Normalization": LayerConverter.convert_normalisation,
    "Flatten": LayerConverter.convert_flatten,
    "Reshape": LayerConverter.convert_reshape,
    "Permute": LayerConverter.convert_permute,
    "ZeroPadding2D": LayerConverter.convert_zero_padding,
    "Cropping2D": LayerConverter.convert_cropping,
    "AveragePooling2D": LayerConverter.convert_average_pooling,
    "GlobalAveragePooling2D": LayerConverter.convert_global_average_pooling,
    "MaxPooling2D": LayerConverter.convert_max_pooling,
    "GlobalMaxPooling2D": LayerConverter.convert_global_max_pooling,
}
# Layers that read windows of an image.
WITH_WINDOWS = (
    *("Conv2D", "DepthwiseConv2D", "SeparableConv2D", "AveragePooling2D", "MaxPooling2D"),
    *("GlobalAveragePooling2D", "GlobalMaxPooling2D", "ZeroPadding2D"),
)
# Layers that only act in training.
IDLE = (
    *("Dropout", "SpatialDropout2D", "AlphaDropout", "GaussianDropout", "GaussianNoise"),
    *("ActivityRegularization", "RandomFlip", "RandomRotation", "RandomZoom", "RandomContrast"),
    *("RandomTranslation", "RandomBrightness", "Identity"),
)
# Activations that do not change which output is the largest.
MONOTONE = (
    *("softmax", "log_softmax", "sigmoid", "tanh", "softplus", "softsign", "elu", "selu"),
    *("exponential", "relu", "leaky_relu"),
)

NO_CHAIN = "is not one chain of layers, each called once and with its input only; build one"
USABLE = "use Conv2D (with a stride), AveragePooling2D, Dense, Flatten, ReLU, BatchNormalization"
USE_RELU = "use activation='relu' (in the output 'softmax' or None)"
# Alternatives to layers that are not supported.
REFUSED = {
    "LayerNormalization": "use BatchNormalization",
    "Conv1D": "use Conv2D on an input of rows, columns, channels",
    "PReLU": USE_RELU,
    "Resizing": "train the model on images of the sensor's size",
    **dict.fromkeys(
        ("Add", "Concatenate", "Multiply", "Average"), "use one chain, without branches"
    ),
}
