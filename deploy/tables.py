"""Tables in plain text, and the format of their cells."""

from __future__ import annotations

from typing import List, Sequence

from .terminal import SIGNIFICANT, escape_control


def align_rows(rows: Sequence[Sequence[str]], left: int = 1) -> List[str]:
    """Lines of a table with aligned columns.

    Parameters
    ----------
    rows : sequence of sequence of str
        Headings first.  Control sequences of terminals are escaped.
    left : int
        Number of columns that are flush left; the others are flush right.
    """
    rows = [list(map(escape_control, row)) for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = []
    for row in rows:
        flush_left = [cell.ljust(width) for cell, width in zip(row[:left], widths)]
        flush_right = [cell.rjust(width) for cell, width in zip(row[left:], widths[left:])]
        lines.append("  ".join(flush_left + flush_right).rstrip())
    return lines


# Maximum width of a table in characters.
MAX_LINE_WIDTH = 80


def align_in_blocks(
    rows: Sequence[Sequence[str]], left: int = 1, width: int = MAX_LINE_WIDTH
) -> List[str]:
    """Align a table as :func:`align_rows` does, and divide a wide one into blocks of columns.

    Each block begins with the columns that are flush left; blocks are separated by an empty line.

    Parameters
    ----------
    rows, left
        As in :func:`align_rows`.
    width : int
        Maximum number of characters of a line.
    """
    fitting = left + 1
    for columns in range(left + 1, len(rows[0]) + 1):
        if max(map(len, align_rows([row[:columns] for row in rows], left))) <= width:
            fitting = columns
    lines = align_rows([row[:fitting] for row in rows], left)
    if fitting < len(rows[0]):
        remaining = [[*row[:left], *row[fitting:]] for row in rows]
        lines += ["", *align_in_blocks(remaining, left, width)]
    return lines


# p-value below which a difference is significant.
SIGNIFICANCE = 0.05


def mark_significance(p_value: float) -> str:
    """The last cell of a row: a star if the difference is significant."""
    return SIGNIFICANT.strip() if p_value < SIGNIFICANCE else ""


def format_p(p_value: float) -> str:
    """A p-value with three decimals; smaller values are "< 0.001"."""
    return "< 0.001" if p_value < 0.001 else f"{p_value:.3f}"


def format_value(value) -> str:
    """A setting's value for a table."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return ", ".join(map(format_value, value))
    return str(value) if value != "" else "-"


def format_count(number: int, noun: str, nouns: str = "") -> str:
    """A number and its noun, such as ``"3 cores"``.

    Parameters
    ----------
    number : int
    noun : str
    nouns : str
        The noun for other numbers than one; default: with an "s".
    """
    return f"{number:,} {noun if number == 1 else nouns or noun + 's'}"


def list_names(names) -> str:
    """The first twelve names, shortened but still different, separated by commas."""
    names = shorten_apart([str(name) for name in names], 24)
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def shorten_name(name: str, width: int) -> str:
    """A name of at most ``width`` characters, shortened in its middle.

    Both ends remain, since names of a set often begin or end alike.
    """
    if len(name) <= width:
        return name
    head = (width - 1) * 2 // 3
    return f"{name[:head]}…{name[len(name) - (width - 1 - head) :]}"


def shorten_apart(names, width: int) -> list:
    """Shortened names that are still different, in the same order.

    Names that would become equal are numbered at their end.
    """
    short = [shorten_name(name, width) for name in names]
    for index, name in enumerate(short):
        if short.count(name) > 1:
            number = f"~{index}"
            short[index] = shorten_name(names[index], max(width - len(number), 1)) + number
    return short
