"""Tables in plain text."""

from __future__ import annotations

from typing import List, Sequence


def aligned(rows: Sequence[Sequence[str]], left: int = 1) -> List[str]:
    """Lines of a table whose columns stand below each other.

    Parameters
    ----------
    rows : sequence of sequence of str
        The heads first.
    left : int
        How many columns are flush left; the others are flush right.
    """
    widths = [max(map(len, column)) for column in zip(*rows)]
    return [
        "  ".join(
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    ]
