"""Tables in plain text, and what stands in their cells."""

from __future__ import annotations

from typing import List, Sequence

from .terminal import printable


def aligned(rows: Sequence[Sequence[str]], left: int = 1) -> List[str]:
    """Lines of a table whose columns stand below each other.

    Parameters
    ----------
    rows : sequence of sequence of str
        The heads first.  What a terminal would obey is escaped.
    left : int
        How many columns are flush left; the others are flush right.
    """
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows)]
    return [
        "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    ]


def p_text(p_value: float) -> str:
    """A p-value to three decimals; what would be 0 then is below 0.001."""
    return "< 0.001" if p_value < 0.001 else f"{p_value:.3f}"
