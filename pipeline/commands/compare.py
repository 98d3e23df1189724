"""``stmnist compare``: runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import options
from pipeline.results.compare import compare_runs, read_runs, runs_text


def compare_(
    runs: Annotated[list[Path], typer.Argument(help="Folders of two or more runs.")],
    whole: Annotated[
        bool, typer.Option("--whole", help="Use the complete test split, not the check's samples.")
    ] = False,
    as_json: options.Json = False,
):
    """Compare runs: settings, accuracy of each stage, operations, cores, time to decide.

    Every run is compared with the first one.  If both have the same samples, the comparison is
    paired, with McNemar's test.
    """
    options.tell(compare_runs(read_runs(runs, whole)), runs_text, as_json)
