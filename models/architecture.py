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

import math
import re
from dataclasses import dataclass
from typing import NoReturn

from deploy.errors import UserError
from models.ops import OPERATIONS, Pooling
from models.ops.base import NUMBER

# Maximum number of layers in a text, including the output.
MAX_LAYERS = 64

# Maximum number of values in the input or in the output of a layer.
MAX_VALUES = 1_000_000

# Maximum number of weights of a layer.
MAX_WEIGHTS = 100_000_000


class NotationError(UserError):
    """A text cannot be parsed as an architecture; the message names the token and its position."""


@dataclass(frozen=True)
class Architecture:
    """A network, layer by layer.

    Attributes
    ----------
    input_shape : tuple of int
        (rows, columns, channels).
    layers : tuple of models.ops.base.NotatedLayer
        Operations, and the pooling before them, in order; the last one is the only output layer.

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
        if not self.layers or not self.layers[-1].is_output:
            raise ValueError("the last layer is not an output")
        shape = self.input_shape
        for layer in self.layers:
            _require_position(layer, shape, layer is self.layers[-1])
            shape = layer.compute_shape(shape)

    @property
    def shapes(self) -> tuple:
        """Shapes of the input and of every layer's output, the last one (outputs,).

        ``zip(architecture.shapes, architecture.layers)`` pairs each layer with its input shape.
        """
        shapes = [self.input_shape]
        for layer in self.layers:
            shapes.append(layer.compute_shape(shapes[-1]))
        return tuple(shapes)

    @property
    def names(self) -> tuple:
        """Names of the layers: ``"conv1"``, ``"conv2"``, ``"pool1"``, ``"dense1"``, ``"output"``.

        Layers are numbered separately for each kind.
        """
        names: list = []
        numbers: dict = {}
        for layer in self.layers:
            numbers[layer.kind] = numbers.get(layer.kind, 0) + 1
            names.append("output" if layer.is_output else f"{layer.kind}{numbers[layer.kind]}")
        return tuple(names)

    @property
    def spiking(self) -> dict:
        """The layers with neurons by name, in order: all but pooling and the output."""
        layers = zip(self.names, self.layers, strict=True)
        return {name: layer for name, layer in layers if layer.has_neurons and not layer.is_output}

    @property
    def outputs(self) -> int:
        """Number of units of the output layer."""
        return math.prod(self.shapes[-1])

    @property
    def weight_shapes(self) -> dict:
        """Shape of each trained array by name, ``"conv1.kernel"`` to ``"output.bias"``."""
        return {
            f"{name}.{array}": shape
            for name, layer, before in zip(self.names, self.layers, self.shapes, strict=False)
            for array, shape in layer.list_array_shapes(before).items()
        }

    def list_event_weight_shapes(self, n_sections: int = 1) -> dict:
        """Shapes of the trained arrays of a spiking network on events (:mod:`models.spiking`).

        In addition to `weight_shapes`, each layer with neurons has two time constants; the output
        has no bias, and weights for each section of a sample.
        """
        shapes = {n: s for n, s in self.weight_shapes.items() if n != "output.bias"}
        inputs, outputs = shapes["output.kernel"]
        shapes["output.kernel"] = n_sections * inputs, outputs
        for name in self.names[:-1]:
            shapes |= {f"{name}.tau_u": (), f"{name}.tau_v": ()}
        return shapes

    @property
    def parameters(self) -> int:
        """Number of trained values."""
        return sum(math.prod(shape) for shape in self.weight_shapes.values())

    @property
    def n_values(self) -> dict:
        """Number of output values of each layer, by its name."""
        return {
            name: math.prod(shape) for name, shape in zip(self.names, self.shapes[1:], strict=False)
        }

    @property
    def fan_out(self) -> dict:
        """Synapses that leave each position of a layer's input, by the name of that layer."""
        return {
            name: layer.count_fan_out(before)
            for name, layer, before in zip(self.names, self.layers, self.shapes, strict=False)
        }

    @property
    def multiply_accumulates(self) -> dict:
        """Multiply-accumulates of one forward pass by layer, without those on padding."""
        return {name: int(fan_out.sum()) for name, fan_out in self.fan_out.items()}

    def __str__(self):
        size = self.input_shape[:2] if self.input_shape[2] == 1 else self.input_shape
        return "-".join(["x".join(map(str, size)), *map(str, self.layers)])


def parse_architecture(text: str) -> Architecture:
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
    >>> parse_architecture("10x10x2-12c4s2-64-10o").shapes
    ((10, 10, 2), (4, 4, 12), (64,), (10,))
    """
    tokens = [token.strip() for token in text.replace("×", "x").split("-")]

    def fail(position: int, problem: str) -> NoReturn:
        shortened = text if len(text) <= 100 else f"{text[:97]}..."
        token = tokens[position]
        token = token if len(token) <= 40 else f"{token[:37]}..."
        raise NotationError(
            f"architecture {shortened!r}: token {position + 1} ({token!r}) {problem}"
        )

    size = _SIZE.fullmatch(tokens[0])
    if not size:
        fail(0, "must be the input's size, such as 10x10 or 10x10x2")
    shape = input_shape = tuple(int(n) if n else 1 for n in size.groups())
    if min(input_shape) < 1:
        fail(0, "has a dimension of zero")
    if math.prod(input_shape) > MAX_VALUES:
        fail(0, f"has more than {MAX_VALUES} values")
    last = len(tokens) - 1
    if last < 1 or not _OUTPUT.fullmatch(tokens[last]):
        fail(last, "must be the output layer, such as 10o, at the end")
    if last > MAX_LAYERS:
        fail(MAX_LAYERS + 1, f"is one layer too many: at most {MAX_LAYERS}")
    layers = []
    for position, token in enumerate(tokens[1:], 1):
        try:
            layer = _parse_layer(token, shape, position == last)
        except ValueError as error:
            fail(position, str(error))
        shape = layer.compute_shape(shape)
        layers.append(layer)
    return Architecture(input_shape, tuple(layers))


def _parse_layer(token: str, shape: tuple, is_last: bool):
    """The layer of a token that has an input of this shape.

    Raises
    ------
    ValueError
        What is wrong with the token, as the end of a sentence.
    """
    layer = _read_token(token)
    if layer is None:
        raise ValueError(f"must be a layer: {_describe_tokens()}")
    _require_position(layer, shape, is_last)
    weights = [math.prod(s) for s in layer.list_array_shapes(shape).values()]
    shape = layer.compute_shape(shape)
    if is_last and math.prod(shape) < 2:
        raise ValueError("must have at least 2 output neurons")
    if math.prod(shape) > MAX_VALUES:
        raise ValueError(f"has more than {MAX_VALUES} values")
    if max(weights, default=0) > MAX_WEIGHTS:
        raise ValueError(f"has more than {MAX_WEIGHTS} weights")
    return layer


def _list_notated_layers() -> tuple:
    """The classes of what a token can be."""
    return (*OPERATIONS.values(), Pooling)


def _describe_tokens() -> str:
    """The layers and examples of their notation, for a message."""
    texts = []
    for layer in _list_notated_layers():
        examples = " or ".join(layer.examples)
        texts.append(f"{layer.noun} such as {examples}" if examples else layer.noun)
    return "; ".join(texts)


_SIZE = re.compile(f"{NUMBER}x{NUMBER}(?:x{NUMBER})?")
_OUTPUT = re.compile(f"{NUMBER}o")


def _read_token(token):
    """The layer that a token describes; None if it describes none.

    Raises
    ------
    ValueError
        A number is zero.
    """
    for layer in _list_notated_layers():
        match = layer.token.fullmatch(token)
        if match is None:
            continue
        if any(group.isdecimal() and int(group) == 0 for group in match.groups("")):
            raise ValueError("has a zero")
        return layer.from_token(match)
    return None


def _require_position(layer, input_shape, last):
    """Refuse a layer at a position where its kind is not allowed, by a ValueError."""
    if layer.is_spatial and len(input_shape) == 1:
        raise ValueError(f"is {layer.noun} after a layer without rows and columns")
    if layer.is_output and not last:
        raise ValueError("is an output layer, which must be the last layer")
