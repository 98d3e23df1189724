"""The paper's architecture notation (Section 3.2), such as ``10x10-6c4-24c3-10o``.

Layers are separated by ``-``; the first gives the input's dimensions, separated by ``x`` or the
multiplication sign; ``6c4`` is a convolution of 6 filters of 4x4; ``10o`` a dense output of 10.
"""

from __future__ import annotations

import re
from dataclasses import dataclass


class NotationError(ValueError):
    """The text is not an architecture; the message names the offending token and its position."""


@dataclass(frozen=True)
class Conv:
    """A convolution of ``filters`` filters of ``kernel`` x ``kernel``, stride 1, valid padding."""

    filters: int
    kernel: int


@dataclass(frozen=True)
class Architecture:
    """A parsed architecture.

    Attributes
    ----------
    input_shape : tuple of int
        (rows, columns, channels).
    convs : tuple of Conv
        The convolutions in order, possibly none.
    outputs : int
        Neurons of the dense output layer.
    """

    input_shape: tuple
    convs: tuple
    outputs: int

    @property
    def shapes(self) -> tuple:
        """(rows, columns, channels) of the input and of every convolution's output."""
        shapes = [self.input_shape]
        for conv in self.convs:
            rows, columns, _ = shapes[-1]
            shapes.append((rows - conv.kernel + 1, columns - conv.kernel + 1, conv.filters))
        return tuple(shapes)

    @property
    def weight_shapes(self) -> dict:
        """Shape of each trained array by name, ``"conv1.kernel"`` to ``"output.bias"``."""
        shapes = {}
        for index, (conv, before) in enumerate(zip(self.convs, self.shapes, strict=False)):
            kernel = (conv.kernel, conv.kernel, before[2], conv.filters)
            shapes |= {f"conv{index + 1}.kernel": kernel, f"conv{index + 1}.bias": kernel[-1:]}
        rows, columns, channels = self.shapes[-1]
        shapes["output.kernel"] = (rows * columns * channels, self.outputs)
        return {**shapes, "output.bias": (self.outputs,)}

    def __str__(self):
        size = self.input_shape[:2] if self.input_shape[2] == 1 else self.input_shape
        convs = [f"{conv.filters}c{conv.kernel}" for conv in self.convs]
        return "-".join(["x".join(map(str, size)), *convs, f"{self.outputs}o"])


def parse(text: str) -> Architecture:
    """Parse the paper's notation.

    Parameters
    ----------
    text : str
        For example ``"10x10x2-6c2-24c3-10o"``; ``×`` may stand for ``x``.

    Returns
    -------
    Architecture

    Raises
    ------
    NotationError
        Naming the token that cannot be read, is out of place, or does not fit the layer before it.

    Examples
    --------
    >>> parse("10x10-6c4-24c3-10o").shapes
    ((10, 10, 1), (7, 7, 6), (5, 5, 24))
    """

    def fail(position, problem):
        raise NotationError(
            f"architecture {text!r}: token {position + 1} ({tokens[position]!r}) {problem}"
        )

    tokens = [token.strip() for token in text.replace("×", "x").split("-")]
    size = re.fullmatch(r"(\d+)x(\d+)(?:x(\d+))?", tokens[0])
    if not size:
        fail(0, "must be the input's size, such as 10x10 or 10x10x2")
    input_shape = tuple(int(n) if n else 1 for n in size.groups())
    if min(input_shape) < 1:
        fail(0, "has a dimension of zero")
    output = re.fullmatch(r"(\d+)o", tokens[-1])
    if len(tokens) < 2 or not output:
        fail(len(tokens) - 1, "must be the output layer, such as 10o, at the end")
    if int(output[1]) < 2:
        fail(len(tokens) - 1, "must have at least 2 output neurons")
    convs, (rows, columns, _) = [], input_shape
    for position, token in enumerate(tokens[1:-1], 1):
        conv = re.fullmatch(r"(\d+)c(\d+)", token)
        if not conv:
            fail(position, "must be a convolution, such as 6c4 (6 filters of 4x4)")
        filters, kernel = map(int, conv.groups())
        if filters < 1 or kernel < 1:
            fail(position, "has a zero")
        if kernel > min(rows, columns):
            fail(position, f"does not fit: its kernel is larger than its {rows}x{columns} input")
        rows, columns = rows - kernel + 1, columns - kernel + 1
        convs.append(Conv(filters, kernel))
    return Architecture(input_shape, tuple(convs), int(output[1]))
