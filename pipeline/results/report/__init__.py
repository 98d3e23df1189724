"""The report of a run: one self-contained HTML file."""

from pathlib import Path

from deploy.files import replacing, require_ending
from pipeline.storage.run_folder import RunFolder


def write_report(run, path=None) -> Path:
    """Write a run's results so far as one self-contained HTML file.

    Parameters
    ----------
    run : path-like
        Folder of the run.
    path : path-like, optional
        The file, ``.html``; default: ``report.html`` in the run's folder.

    Returns
    -------
    Path

    Raises
    ------
    UserError
        The name has another ending; see also
        :func:`pipeline.results.report.gather.gather_report_data`.
    """
    from pipeline.results.report.gather import gather_report_data
    from pipeline.results.report.page import render_report

    path = Path(path) if path else Path(run) / "report.html"
    require_ending(path, ".html")
    html = render_report(gather_report_data(RunFolder(run)))
    with replacing(path, "w") as file:
        file.write(html)
    return path
