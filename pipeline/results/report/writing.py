"""Writing the report of a run to a file."""

from __future__ import annotations

from pathlib import Path

from deploy.files import replacing
from pipeline.results.report.gather import gather
from pipeline.results.report.page import render
from pipeline.run import RunFolder


def write_report(run, path=None, beside=None, jobs: int = 1) -> Path:
    """Write a run's results so far as one self-contained HTML file.

    Parameters
    ----------
    run : path-like
        Folder of the run.
    path : path-like, optional
        The file; default: ``report.html`` in the run's folder.
    beside : path-like, optional
        Folder of a run on images to compare with one on events, from the same recordings.
    jobs : int
        Number of processes for recordings that are not in the cache.

    Returns
    -------
    Path

    Raises
    ------
    UserError
        See :func:`pipeline.results.report.gather.gather`.
    """
    run = Path(run)
    other = RunFolder(beside) if beside else None
    html = render(gather(RunFolder(run), jobs, other))
    path = Path(path) if path else run / "report.html"
    with replacing(path, "w") as file:
        file.write(html)
    return path
