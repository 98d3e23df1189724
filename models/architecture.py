"""The paper's architecture notation (Section 3.2), extended: ``10x10x2-12c4s2p-2a-64-10o``.

Layers are separated by ``-``.  The first token gives the input's dimensions, separated by ``x`` or
the multiplication sign; the rest are the layers, in the order of the data flow:

=========  ====================================================================================
``FcK``    a convolution of F filters of K x K, stride 1, no padding
``FcKsS``  the same with stride S
``p``      suffix: zero padding so that the output size is the input size over the stride, rounded
           up (TensorFlow's "same": an odd number of zeros has the larger half at the end)
``Ka``     average pooling over K x K without overlap; incomplete windows at the end are dropped
``N``      a hidden dense layer with N units
``No``     the dense output layer with N units, exactly one and last
=========  ====================================================================================
"""

import re
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from deploy.errors import UserError
from deploy.network.geometry import convolution_fan_out, convolution_shape, count_windows, windows

# Maximum number of layers in a text, including the output.
MAX_LAYERS = 64

# Maximum number of values in the input or in the output of a layer.
MAX_VALUES = 1_000_000

# Maximum number of weights of a layer.
MAX_WEIGHTS = 100_000_000


class NotationError(UserError):
    """A text cannot be parsed as an architecture; the message names the token and its position."""


@dataclass(frozen=True)
class Convolution:
    """A convolution with square filters.

    Attributes
    ----------
    filters, kernel : int
        Number of filters and side length of each.
    stride : int
    padding : str
        ``"valid"`` or ``"same"``, as in TensorFlow; of an imported network also a number of zeros
        on each side.
    """

    filters: int
    kernel: int
    stride: int = 1
    padding: str = "valid"
    kind = "conv"

    def __post_init__(self):
        if min(self.filters, self.kernel, self.stride) < 1:
            raise ValueError(f"{self}: filters, kernel and stride must be at least 1")
        if self.padding not in ("valid", "same") and not self.padding.isdecimal():
            raise ValueError(f"{self}: padding is neither 'valid' nor 'same' nor a number")

    def pads(self, input_shape) -> tuple:
        """Numbers of zeros padded to rows and columns: ((before, after), (before, after))."""
        return tuple(
            windows(n, self.kernel, self.stride, self.padding)[1:] for n in input_shape[:2]
        )

    def shape(self, input_shape) -> tuple:
        """(rows, columns, channels) of the output.

        Raises
        ------
        ValueError
            The kernel is larger than the input.
        """
        shape = convolution_shape(input_shape, self.kernel, self.filters, self.stride, self.padding)
        if min(shape) < 1:
            rows, columns = input_shape[:2]
            raise ValueError(f"does not fit: its kernel is larger than its {rows}x{columns} input")
        return shape

    def weight_shapes(self, input_shape) -> dict:
        """Shapes of ``"kernel"`` (rows, columns, input channels, filters) and of ``"bias"``."""
        kernel = (self.kernel, self.kernel, input_shape[2], self.filters)
        return {"kernel": kernel, "bias": (self.filters,)}

    def fan_out(self, input_shape) -> np.ndarray:
        """Synapses that leave each input position, int64, of shape ``input_shape``."""
        return convolution_fan_out(
            input_shape, self.kernel, self.filters, self.stride, self.padding
        )

    def __str__(self):
        stride = f"s{self.stride}" if self.stride > 1 else ""
        padding = {"valid": "", "same": "p"}.get(self.padding, f"p{self.padding}")
        return f"{self.filters}c{self.kernel}{stride}{padding}"


@dataclass(frozen=True)
class Pooling:
    """Average pooling over square windows that do not overlap.

    Attributes
    ----------
    size : int
        Side length of a window, and the stride.
    """

    size: int
    kind = "pool"

    def __post_init__(self):
        if self.size < 1:
            raise ValueError(f"{self}: the size must be at least 1")

    def shape(self, input_shape) -> tuple:
        """(rows, columns, channels) of the output.

        Raises
        ------
        ValueError
            The window is larger than the input.
        """
        rows, columns, channels = input_shape
        if self.size > min(rows, columns):
            raise ValueError(f"does not fit: its window is larger than its {rows}x{columns} input")
        return (rows // self.size, columns // self.size, channels)

    def weight_shapes(self, input_shape) -> dict:
        """An empty dict: pooling has no weights."""
        return {}

    def fan_out(self, input_shape) -> np.ndarray:
        """Synapses that leave each input position, int64: 1, or 0 outside of complete windows."""
        reach = [
            count_windows(n, outputs, self.size, self.size, 0)
            for n, outputs in zip(input_shape[:2], self.shape(input_shape), strict=False)
        ]
        return np.repeat(np.outer(*reach)[..., None], input_shape[2], axis=2)

    def __str__(self):
        return f"{self.size}a"


@dataclass(frozen=True)
class Dense:
    """A dense layer; its input is flattened in the order (row, column, channel).

    Attributes
    ----------
    units : int
    output : bool
        True for the output layer of the network.
    """

    units: int
    output: bool = False

    def __post_init__(self):
        if self.units < 1:
            raise ValueError(f"{self}: units must be at least 1")

    @property
    def kind(self) -> str:
        """``"dense"`` or ``"output"``."""
        return "output" if self.output else "dense"

    def shape(self, input_shape) -> tuple:
        """(units,)."""
        return (self.units,)

    def weight_shapes(self, input_shape) -> dict:
        """Shapes of ``"kernel"`` (inputs, units) and of ``"bias"``."""
        return {"kernel": (_size(input_shape), self.units), "bias": (self.units,)}

    def fan_out(self, input_shape) -> np.ndarray:
        """Synapses that leave each input position, int64, of shape ``input_shape``."""
        return np.full(input_shape, self.units, np.int64)

    def __str__(self):
        return f"{self.units}{'o' * self.output}"


@dataclass(frozen=True)
class Architecture:
    """A network, layer by layer.

    Attributes
    ----------
    input_shape : tuple of int
        (rows, columns, channels).
    layers : tuple of Convolution, Pooling or Dense
        In order; the last one is the only output layer.

    Raises
    ------
    ValueError
        The order of the layers is invalid, or a layer does not fit the shape of its input.
    """

    input_shape: tuple
    layers: tuple

    def __post_init__(self):
        object.__setattr__(self, "input_shape", tuple(self.input_shape))
        object.__setattr__(self, "layers", tuple(self.layers))
        if len(self.input_shape) != 3 or min(self.input_shape) < 1:
            raise ValueError(f"input of shape {self.input_shape}: not (rows, columns, channels)")
        if not self.layers or self.layers[-1].kind != "output":
            raise ValueError("the last layer is not an output")
        shape = self.input_shape
        for layer in self.layers:
            _check_place(layer, shape, layer is self.layers[-1])
            shape = layer.shape(shape)

    @property
    def shapes(self) -> tuple:
        """Shapes of the input and of every layer's output, the last one (outputs,).

        ``zip(architecture.shapes, architecture.layers)`` pairs each layer with its input shape.
        """
        shapes = [self.input_shape]
        for layer in self.layers:
            shapes.append(layer.shape(shapes[-1]))
        return tuple(shapes)

    @property
    def names(self) -> tuple:
        """Names of the layers: ``"conv1"``, ``"conv2"``, ``"pool1"``, ``"dense1"``, ``"output"``.

        Layers are numbered separately for each kind.
        """
        names: list = []
        seen: dict = {}
        for layer in self.layers:
            seen[layer.kind] = seen.get(layer.kind, 0) + 1
            names.append("output" if layer.kind == "output" else f"{layer.kind}{seen[layer.kind]}")
        return tuple(names)

    @property
    def spiking(self) -> dict:
        """The layers with neurons by name, in order: convolutions and hidden dense layers."""
        layers = zip(self.names, self.layers, strict=True)
        return {name: layer for name, layer in layers if layer.kind in ("conv", "dense")}

    @property
    def outputs(self) -> int:
        """Number of units of the output layer."""
        return self.layers[-1].units

    @property
    def weight_shapes(self) -> dict:
        """Shape of each trained array by name, ``"conv1.kernel"`` to ``"output.bias"``."""
        return {
            f"{name}.{array}": shape
            for name, layer, before in zip(self.names, self.layers, self.shapes, strict=False)
            for array, shape in layer.weight_shapes(before).items()
        }

    def event_weight_shapes(self, parts: int = 1) -> dict:
        """Shapes of the trained arrays of a spiking network on events (:mod:`models.spiking`).

        In addition to `weight_shapes`, each layer with neurons has two time constants; the output
        has no bias, and weights for each part of a sample.
        """
        shapes = {n: s for n, s in self.weight_shapes.items() if n != "output.bias"}
        inputs, outputs = shapes["output.kernel"]
        shapes["output.kernel"] = parts * inputs, outputs
        for name in self.names[:-1]:
            shapes |= {f"{name}.tau_u": (), f"{name}.tau_v": ()}
        return shapes

    @property
    def parameters(self) -> int:
        """Number of trained values."""
        return sum(_size(shape) for shape in self.weight_shapes.values())

    @property
    def neurons(self) -> dict:
        """Number of output values of each layer, by its name."""
        return {
            name: _size(shape) for name, shape in zip(self.names, self.shapes[1:], strict=False)
        }

    @property
    def fan_out(self) -> dict:
        """Synapses that leave each position of a layer's input, by the name of that layer."""
        return {
            name: layer.fan_out(before)
            for name, layer, before in zip(self.names, self.layers, self.shapes, strict=False)
        }

    @property
    def multiply_accumulates(self) -> dict:
        """Multiply-accumulates of one forward pass by layer, without those on padding."""
        return {name: int(fan_out.sum()) for name, fan_out in self.fan_out.items()}

    def __str__(self):
        size = self.input_shape[:2] if self.input_shape[2] == 1 else self.input_shape
        return "-".join(["x".join(map(str, size)), *map(str, self.layers)])


def parse(text: str) -> Architecture:
    """Parse the architecture notation; ``str()`` of an architecture is the inverse.

    Parameters
    ----------
    text : str
        For example ``"10x10x2-12c4s2-64-10o"``; ``×`` may stand for ``x``.

    Returns
    -------
    Architecture

    Raises
    ------
    NotationError
        A token cannot be parsed, is misplaced, does not fit the layer before it, or exceeds a size
        limit.  The message names the token.

    Examples
    --------
    >>> parse("10x10x2-12c4s2-64-10o").shapes
    ((10, 10, 2), (4, 4, 12), (64,), (10,))
    """
    tokens = [token.strip() for token in text.replace("×", "x").split("-")]

    def fail(position: int, problem: str) -> NoReturn:
        shown = text if len(text) <= 100 else f"{text[:97]}..."
        token = tokens[position]
        token = token if len(token) <= 40 else f"{token[:37]}..."
        raise NotationError(f"architecture {shown!r}: token {position + 1} ({token!r}) {problem}")

    size = _SIZE.fullmatch(tokens[0])
    if not size:
        fail(0, "must be the input's size, such as 10x10 or 10x10x2")
    shape = input_shape = tuple(int(n) if n else 1 for n in size.groups())
    if min(input_shape) < 1:
        fail(0, "has a dimension of zero")
    if _size(input_shape) > MAX_VALUES:
        fail(0, f"has more than {MAX_VALUES} values")
    last = len(tokens) - 1
    if last < 1 or not _TOKENS["output"].fullmatch(tokens[last]):
        fail(last, "must be the output layer, such as 10o, at the end")
    if last > MAX_LAYERS:
        fail(MAX_LAYERS + 1, f"is one layer too many: at most {MAX_LAYERS}")
    layers = []
    for position, token in enumerate(tokens[1:], 1):
        try:
            layer = _parse_layer(token, shape, position == last)
        except ValueError as error:
            fail(position, str(error))
        shape = layer.shape(shape)
        layers.append(layer)
    return Architecture(input_shape, tuple(layers))


def _parse_layer(token: str, shape: tuple, is_last: bool):
    """The layer of a token that has an input of this shape.

    Raises
    ------
    ValueError
        What is wrong with the token, as the end of a sentence.
    """
    layer = _layer(token)
    if layer is None:
        raise ValueError(
            "must be a layer: a convolution such as 6c4, 6c4s2 or 6c4p, "
            "a pooling such as 2a, or a hidden dense layer such as 64"
        )
    if layer is _ZERO:
        raise ValueError("has a zero")
    _check_place(layer, shape, is_last)
    weights = [_size(s) for s in layer.weight_shapes(shape).values()]
    shape = layer.shape(shape)
    if is_last and layer.units < 2:
        raise ValueError("must have at least 2 output neurons")
    if _size(shape) > MAX_VALUES:
        raise ValueError(f"has more than {MAX_VALUES} values")
    if max(weights, default=0) > MAX_WEIGHTS:
        raise ValueError(f"has more than {MAX_WEIGHTS} weights")
    return layer


_NUMBER = "([0-9]{1,9})"  # nine digits exceed every limit
_SIZE = re.compile(f"{_NUMBER}x{_NUMBER}(?:x{_NUMBER})?")
_TOKENS = {
    "conv": re.compile(f"{_NUMBER}c{_NUMBER}(?:s{_NUMBER})?(p?)"),
    "pool": re.compile(f"{_NUMBER}a"),
    "dense": re.compile(_NUMBER),
    "output": re.compile(f"{_NUMBER}o"),
}
_ZERO = object()


def _layer(token):
    """The layer that a token describes; None if it describes none, `_ZERO` if a number is zero."""
    for kind, pattern in _TOKENS.items():
        match = pattern.fullmatch(token)
        if not match:
            continue
        numbers = [int(n) for n in match.groups() if n and n != "p"]
        if min(numbers) < 1:
            return _ZERO
        if kind == "conv":
            filters, kernel, *stride = numbers
            return Convolution(filters, kernel, *(stride or [1]), "same" if match[4] else "valid")
        return Pooling(*numbers) if kind == "pool" else Dense(*numbers, output=kind == "output")
    return None


def _check_place(layer, input_shape, last):
    """Raise ValueError for a layer at a position where its kind is not allowed."""
    if layer.kind in ("conv", "pool") and len(input_shape) == 1:
        what = {"conv": "a convolution", "pool": "a pooling"}[layer.kind]
        raise ValueError(f"is {what} after a dense layer, which has no rows and columns")
    if layer.kind == "output" and not last:
        raise ValueError("is an output layer, which must be the last layer")


def _size(shape) -> int:
    size = 1
    for n in shape:  # Python integers do not overflow, whatever shape a text declares
        size *= n
    return size
