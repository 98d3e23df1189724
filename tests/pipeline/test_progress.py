"""Bars where somebody sees them."""

import importlib.util
import io

import pytest
from rich.console import Console

from pipeline import progress


@pytest.mark.parametrize(
    ("terminal", "notebook", "widgets", "drawn"),
    [(True, False, False, True), (False, False, True, False), (False, True, True, True),
     (False, True, False, False)],
)  # fmt: skip
def test_on_a_terminal_and_in_a_notebook_that_can(monkeypatch, terminal, notebook, widgets, drawn):
    console = Console(file=io.StringIO(), force_terminal=terminal, force_jupyter=notebook)
    found = importlib.util.find_spec
    monkeypatch.setattr(progress, "console", console)
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name: (object() if widgets else None) if name == "ipywidgets" else found(name),
    )
    assert progress.can_draw() is drawn


def test_elsewhere_it_is_silent_and_counts_all_the_same(monkeypatch):
    said = io.StringIO()
    monkeypatch.setattr(progress, "console", Console(file=said, force_terminal=False))
    with progress.progress("train", 2) as advance:
        advance(2, "all")
    assert said.getvalue() == ""
