"""The sensor of recordings: its size, its classes, and where its taxels are."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from deploy.tables import format_count
from pipeline.paper import DURATION_S

# Taxels of the array, 10 x 10 (paper, Section 2.1).
N_TAXELS = 100

# Taxels along each side of the array.
GRID = 10

# Rows and columns from which on a sensor is a grid: convolutions need as many.
MIN_GRID_SIDE = 6

# Classes of the published recordings.
DIGITS = tuple("0123456789")


@dataclass(frozen=True)
class Sensor:
    """The sensor and the classes of recordings; by default those of ST-MNIST.

    Attributes
    ----------
    rows, columns : int
        Size of the tactile image.  Some places may have no taxel.
    polarities : int
        2 for ON and OFF events, 1 if there are only ON events.
    duration_s : float
        Longest time from the start of a recording to its end, in seconds.
    classes : tuple of str
        Names of the classes 0, 1, ...
    """

    rows: int = GRID
    columns: int = GRID
    polarities: int = 2
    duration_s: float = DURATION_S
    classes: tuple = DIGITS

    def __str__(self):
        classes = format_count(len(self.classes), "class", "classes")
        return f"{self.rows}x{self.columns} taxels, {classes}"

    @property
    def is_grid(self) -> bool:
        """True if it has as many rows and columns as convolutions need."""
        return min(self.rows, self.columns) >= MIN_GRID_SIDE


@dataclass(frozen=True)
class TaxelMap:
    """Position of each taxel on the array, zero-based.

    Attributes
    ----------
    row : ndarray of int, shape (n_taxels,)
        Row of the tactile image, from the top.  X in the paper is this plus one.
    column : ndarray of int, shape (n_taxels,)
        Column of the tactile image, from the left.  Y in the paper is this plus one.
    positions : ndarray of float, shape (n_taxels, 2), or None
        x (to the right) and y (downwards) of each taxel on the sensor in any unit, for drawing, if
        the source has them (``taxels.csv``).
    """

    row: np.ndarray = field(default_factory=lambda: np.arange(N_TAXELS) % GRID)
    column: np.ndarray = field(default_factory=lambda: np.arange(N_TAXELS) // GRID)
    positions: np.ndarray | None = None

    @classmethod
    def grid(cls, rows: int, columns: int) -> TaxelMap:
        """A taxel at every place, numbered column by column as in the published array."""
        taxels = np.arange(rows * columns)
        return cls(taxels % rows, taxels // rows)

    def __len__(self):
        return len(self.row)


def are_digits(classes) -> bool:
    """True if the classes are the ten digits."""
    return tuple(classes) == DIGITS


def is_st_mnist_sensor(rows: int, columns: int, classes) -> bool:
    """True for digits on ST-MNIST's sensor, to which the paper's figures apply."""
    return are_digits(classes) and rows == columns == GRID


def describe_size(sensor: Sensor) -> str:
    """Rows and columns of a sensor in words."""
    return format_size(sensor.rows, sensor.columns)


def format_size(rows: int, columns: int) -> str:
    """Numbers of rows and columns in words."""
    return f"{format_count(rows, 'row')} x {format_count(columns, 'column')}"


def make_class_sort_key(name: str):
    """Key that sorts names as people do: 2 before 10."""
    pieces = re.split(r"([0-9]+)", name)
    # The longer of two numbers is the larger one; int() refuses those of thousands of digits.
    numbers = [piece.lstrip("0") if piece[:1] in DIGITS else "" for piece in pieces]
    return [
        (piece[:1] in DIGITS, len(number), number, piece)
        for piece, number in zip(pieces, numbers, strict=True)
    ], name
