"""``stmnist status``: which artifacts of a run are current."""

from __future__ import annotations

from pipeline.commands import options
from pipeline.results.status import status_of, status_text
from pipeline.roads import road_of
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
    imported = road_of(read_settings(folder.experiment)).imported
    if imported is not None and (note := imported.changed_note()) is not None:
        options.say(note)
