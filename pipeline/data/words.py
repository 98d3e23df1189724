"""The names of classes in messages, and whether they are digits written on a skin."""

from __future__ import annotations

from pipeline.data.events import DIGITS, GRID


def are_digits(classes) -> bool:
    """True if the classes are the ten digits."""
    return tuple(classes) == DIGITS


def is_written(rows: int, columns: int, classes) -> bool:
    """True for digits on ST-MNIST's sensor, to which the paper's figures apply."""
    return are_digits(classes) and rows == columns == GRID


def listed(names) -> str:
    """The first twelve names, shortened but still different, separated by commas."""
    names = shortened_apart([str(name) for name in names], 24)
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def shortened(name: str, width: int) -> str:
    """A name of at most ``width`` characters, shortened in its middle.

    Both ends remain, since names of a set often begin or end alike.
    """
    if len(name) <= width:
        return name
    head = (width - 1) * 2 // 3
    return f"{name[:head]}…{name[len(name) - (width - 1 - head) :]}"


def shortened_apart(names, width: int) -> list:
    """Shortened names that are still different, in the same order.

    Names that would become equal are numbered at their end.
    """
    short = [shortened(name, width) for name in names]
    for index, name in enumerate(short):
        if short.count(name) > 1:
            number = f"~{index}"
            short[index] = shortened(names[index], max(width - len(number), 1)) + number
    return short
