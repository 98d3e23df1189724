"""``stmnist report``: a run as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy.files import replacing
from pipeline.commands import options
from pipeline.report.gather import gather
from pipeline.report.page import render
from pipeline.run.folder import RunFolder


def report(
    run: options.Run,
    benchmark: Annotated[
        Optional[Path],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(help="Folder of 'stmnist benchmark table2' (default: table2 beside the run)."),
    ] = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="The file to write (default: report.html in the run's folder)."),
    ] = None,
    beside: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="A run of images to show beside one of events, from the same recordings."
        ),
    ] = None,
    jobs: options.Jobs = 2,
):
    """Write the run as one self-contained HTML file, with whatever has been measured so far."""
    folder = RunFolder(run)
    other = RunFolder(beside) if beside else None
    html = render(gather(folder, benchmark or run.parent / "table2", jobs, options.say, other))
    path = out or run / "report.html"
    with replacing(path, "w") as file:
        file.write(html)
    options.say(f"report: {path} ({len(html) // 1024} KiB)")
