"""Progress with an estimate of the time: a bar on a terminal or in a notebook, lines elsewhere."""

import contextlib
import importlib.util

from rich.console import Console
from rich.progress import Progress

from deploy.progress import ProgressLines

console = Console(stderr=True)

_hidden = False


@contextlib.contextmanager
def hide_progress():
    """Hide all bars inside the block, for code whose caller shows a bar of its own."""
    global _hidden
    before = _hidden
    _hidden = True
    try:
        yield
    finally:
        _hidden = before


@contextlib.contextmanager
def hide_inner_bars():
    """Hide the bars inside the block, whose caller draws one itself; lines are printed."""
    with hide_progress() if _draws_bars() else contextlib.nullcontext():
        yield


def _draws_bars():
    in_notebook = console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
    return console.is_terminal or in_notebook


@contextlib.contextmanager
def ignore_progress(label: str, total: int, unit: str = "samples"):
    """Display nothing: the default where a function takes :func:`progress` as an argument."""
    yield lambda n=1, note=None: None


@contextlib.contextmanager
def progress(label: str, total: int, unit: str = "samples"):
    """Display a bar, or now and then a line, while the block runs.

    Parameters
    ----------
    label : str
        The activity, such as ``"import"``.
    total : int
        Total number of units of work.
    unit : str
        What they are, in the plural; on a terminal, a bar says as much.

    Yields
    ------
    callable
        ``advance(n=1, note=None)``: n more units are done; ``note`` is printed after the label.
    """
    if _hidden:
        yield lambda n=1, note=None: None
        return
    if not _draws_bars():
        yield ProgressLines(label, total, unit).advance
        return
    with Progress(console=console) as bar:
        task = bar.add_task(label, total=total)

        def advance(n=1, note=None):
            description = label if note is None else f"{label} {note}"
            bar.update(task, advance=n, description=description)

        yield advance
