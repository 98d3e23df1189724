"""``stmnist data``: recordings - import, inspect, simulate, count, draw."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.errors import UserError
from pipeline.commands import options
from pipeline.inputs.library import load_recordings
from pipeline.progress import progress
from pipeline.recordings import archive
from pipeline.recordings.events import Events, expand_bursts
from pipeline.recordings.matfile import BadRecording, read_recording

app = typer.Typer(help="Recordings: read, look at, make, count, draw.", no_args_is_help=True)


@app.command("import")
def import_(
    source: Annotated[str, typer.Argument(help="ST-MNIST zip or folder.")],
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Leave out files that cannot be read.")
    ] = False,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Read recordings once and keep them in the cache, so that the next start is quick."""
    recordings = load_recordings(source, skip_bad=skip_bad, jobs=jobs, warn=_warn)
    counts = np.bincount(recordings.labels, minlength=10).tolist()
    facts = {
        "source": recordings.source.name,
        "sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "written": recordings.source.written,
        "samples": len(recordings),
        "samples_per_digit": counts,
        "events": len(recordings.events),
        "columns": int(recordings.events.columns.sum(dtype=np.int64)),
    }
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    kind = "simulated recordings" if recordings.source.simulated else "recordings"
    if recordings.source.written:
        kind = "recordings, written by hand on the simulated skin,"
    print(f"{len(recordings)} {kind} in {facts['source']}; of each digit: {counts}")
    print(f"{facts['events']} physical events in {facts['columns']} columns")


@app.command("export")
def export_(
    folder: Annotated[Path, typer.Argument(help="Recordings, such as those kept by stmnist live.")],
    out: Annotated[Path, typer.Argument(help="The zip to write, laid out as published.")],
):
    """Pack a folder of recordings as a zip that works as DATA, each file as it is."""
    n = archive.export_zip(out, folder, progress)
    print(f"{n} recordings written to {out}")


@app.command()
def inspect(
    file: Annotated[Path, typer.Argument(help="One recording, a MAT file.")],
    as_json: options.Json = False,
):
    """Print one recording's facts."""
    try:
        recording = read_recording(file.read_bytes())
    except OSError as error:
        raise UserError(f"{file}: cannot read ({error.strerror}); check the path") from error
    except BadRecording as error:
        raise UserError(f"{file}: {error}; expected a recording as ST-MNIST has them") from error
    facts = {"simulated": recording.simulated, **recording_facts(recording.events)}
    kind = " (simulated)" if recording.simulated else ""
    if recording.written is not None:
        facts |= {
            "source": "written",
            "time": recording.written.time,
            "writer": recording.writer,
            "handedness": recording.written.handedness or None,
        }
        kind = f" (written by hand on the simulated skin, {recording.written.time})"
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    print(
        f"{file.name}{kind}: "
        f"{facts['columns']} columns, {facts['events']} physical events "
        f"({facts['on']} ON, {facts['off']} OFF) of {facts['taxels']} taxels, "
        f"{facts['t_first_s']:.4f} s to {facts['t_last_s']:.4f} s"
    )


def recording_facts(events: Events) -> dict:
    """Counts and times of one recording: columns as in the file, the others physical events."""
    times, _, _ = expand_bursts(events)
    return {
        "columns": len(times),
        "events": len(events),
        "on": int((events.polarity == 1).sum()),
        "off": int((events.polarity == -1).sum()),
        "t_first_s": float(times[0] * 1e-9),
        "t_last_s": float(times[-1] * 1e-9),
        "taxels": len(np.unique(events.taxel)),
    }


def _warn(line):
    print(line, file=sys.stderr)
