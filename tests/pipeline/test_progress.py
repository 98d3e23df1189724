"""Bars where somebody sees them."""

import io

from rich.console import Console

from pipeline import progress


def test_elsewhere_it_is_silent_and_counts_all_the_same(monkeypatch):
    said = io.StringIO()
    monkeypatch.setattr(progress, "console", Console(file=said, force_terminal=False))
    with progress.progress("train", 2) as advance:
        advance(2, "all")
    assert said.getvalue() == ""
