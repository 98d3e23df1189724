"""``stmnist status``: which artifacts of a run are current."""

from __future__ import annotations

from pipeline.commands import options
from pipeline.results.status import status_of, status_text
from pipeline.roads.given_networks import changed_note
from pipeline.run import RunFolder
from pipeline.settings import read_settings


def status(run: options.Run, as_json: options.Json = False):
    """Show each artifact of a run: current, outdated and why, or missing.

    Nothing is made or changed.
    """
    folder = RunFolder(run)
    found = status_of(folder)
    options.tell(
        {"run": str(run), "artifacts": [status.to_json() for status in found]},
        lambda _: status_text(folder, found),
        as_json,
    )
    if (note := changed_note(read_settings(folder.experiment))) is not None:
        options.say(note)
