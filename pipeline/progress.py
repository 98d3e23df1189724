"""Progress bars: with an estimate on a terminal's standard error or in a notebook, else silent."""

from __future__ import annotations

import contextlib
import importlib.util

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

console = Console(stderr=True)
_hidden = False


@contextlib.contextmanager
def hidden():
    """Show no bars inside the block: one around it, or in another process, says enough."""
    global _hidden
    before, _hidden = _hidden, True
    try:
        yield
    finally:
        _hidden = before


@contextlib.contextmanager
def progress(label: str, total: int):
    """Show a bar while the block runs.

    Parameters
    ----------
    label : str
        What is being done, such as ``"import"``.
    total : int
        Steps until done.

    Yields
    ------
    callable
        ``advance(n=1, note=None)``: n more steps are done; ``note`` is shown beside the label.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=_hidden or not can_draw()) as bar:
        task = bar.add_task(label, total=total)

        def advance(n=1, note=None):
            description = label if note is None else f"{label} {note}"
            bar.update(task, advance=n, description=description)

        yield advance


def can_draw() -> bool:
    """Whether a bar would be seen: on a terminal, or in a notebook with ipywidgets."""
    in_notebook = console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
    return console.is_terminal or in_notebook
