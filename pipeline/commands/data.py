"""``stmnist data``: recordings - import, inspect, simulate, count, draw."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from deploy import limits
from deploy.errors import UserError
from deploy.terminal import show
from pipeline.commands import options
from pipeline.data.events import GRID
from pipeline.data.library import load_recordings
from pipeline.data.sensor import Reading
from pipeline.data.source import refuse_to_replace, write_zip
from pipeline.data.statistics import (
    facts_of_file,
    facts_with_events,
    file_text,
    recordings_text,
    table1_json,
    table1_text,
)
from pipeline.progress import progress
from pipeline.settings import MOST_DOWNSAMPLED, SIMULATED, Settings

Source = Annotated[
    str,
    typer.Option("--data", help="Zip or folder of recordings, or 'simulated'."),
]
SimulationSeed = Annotated[
    int,
    typer.Option("--seed", help="Seed of simulated recordings.", min=0, max=2**63 - 1),
]
PerDigit = Annotated[
    int,
    typer.Option(
        help="Number of recordings of each digit; 0 for the published numbers.",
        min=0,
        max=limits.SAMPLES,
    ),
]


class Unit(StrEnum):
    """Units of times in files of events."""

    found = "as-found"
    s = "s"
    ms = "ms"
    us = "us"
    ns = "ns"

    @property
    def setting(self) -> str:
        """The value of the setting ``data.time_unit``."""
        return "" if self is Unit.found else self.value


def _side(what):
    help_ = f"Number of {what} of taxels, 2 to 256."
    return Annotated[int, typer.Option(help=help_, min=2, max=256)]


Rows, Columns = _side("rows"), _side("columns")


def _side_or_found(what):
    help_ = f"Number of {what} of taxels; 0: as found, or ten for the simulated skin."
    return Annotated[int, typer.Option(help=help_, min=0, max=256)]


TimeUnit = Annotated[
    Unit,
    typer.Option(
        help="Unit of times in files of events: s, ms, us or ns; as-found: inferred from duration.",
        metavar="UNIT",
    ),
]
Downsample = Annotated[
    int,
    typer.Option(
        help="Files of events: side of the square of pixels that becomes one taxel.",
        min=1,
        max=MOST_DOWNSAMPLED,
    ),
]


def _reading(rows=0, columns=0, time_unit=Unit.found, downsample=1):
    return Reading(rows, columns, time_unit.setting, downsample)


SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Leave out files that cannot be read.")]
ReadingGiven = options.group(
    _reading,
    rows=_side_or_found("rows"),
    columns=_side_or_found("columns"),
    time_unit=TimeUnit,
    downsample=Downsample,
)


def import_(
    source: Annotated[str, typer.Argument(help="Zip or folder of recordings, such as ST-MNIST's.")],
    skip_bad: SkipBad = False,
    *,
    reading: ReadingGiven,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Read recordings once and store them in the cache, so that the next start is fast."""
    recordings = load_recordings(
        source, skip_bad=skip_bad, jobs=jobs, warn=options.say, reading=reading
    )
    facts = facts_with_events(recordings)
    options.tell(facts, lambda facts: recordings_text(facts, recordings), as_json)
    run = Path("runs") / Path(source).stem
    options.suggest("ladder", run, "--data", source, *_as_assignments(reading, skip_bad))


def _as_assignments(reading, skip_bad):
    """Options with which a run reads recordings in the same way."""
    values = {
        "data.skip_bad": skip_bad,
        "data.time_unit": reading.time_unit,
        "data.downsample": reading.downsample,
        "skin.rows": reading.rows,
        "skin.columns": reading.columns,
    }
    usual = Settings().flat()
    for name, value in values.items():
        if value != usual[name]:
            yield from ("--set", f"{name}={str(value).lower()}")


def inspect(
    file: Annotated[Path, typer.Argument(help="One recording: .mat, or a file of events.")],
    time_unit: TimeUnit = Unit.found,
    as_json: options.Json = False,
):
    """Print facts about one recording."""
    facts = facts_of_file(file, time_unit.setting)
    options.tell(facts, lambda facts: file_text(file.name, facts), as_json)


def simulate_(
    out: Annotated[
        Path, typer.Option(help="The zip to write, in the published layout.", metavar="ZIP")
    ],
    seed: SimulationSeed = 0,
    samples_per_digit: PerDigit = 0,
    rows: Rows = GRID,
    columns: Columns = GRID,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Write simulated recordings as a zip in the layout of ST-MNIST.

    An existing file is replaced only if this command has written it.
    """
    if out.suffix != ".zip":
        raise UserError(f"{out}: the name must end in .zip")
    refuse_to_replace(out)
    size = Reading(rows, columns)
    recordings = load_recordings(SIMULATED, seed, samples_per_digit, jobs=jobs, reading=size)
    write_zip(out, recordings, progress)
    facts = {
        "file": str(out),
        "simulated": True,
        "source": recordings.source.name,
        "sha256": recordings.source.sha256,
        "samples": len(recordings),
        "events": len(recordings.events),
    }
    text = f"{out}: {facts['samples']} simulated recordings, {facts['events']} events"
    options.tell(facts, lambda _: text, as_json)


def stats(
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    skip_bad: SkipBad = False,
    *,
    reading: ReadingGiven,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Print the paper's Table 1 for any recordings.

    Events are counted as the paper does, one for each column of a file; physical events count each
    burst of columns once.
    """
    recordings = load_recordings(
        data, seed, skip_bad=skip_bad, jobs=jobs, warn=options.say, reading=reading
    )
    value = table1_json(recordings)
    options.tell(value, lambda _: table1_text(recordings), as_json)


FIGURES = ("recording", "sheet")


def plot(
    what: Annotated[
        str,
        typer.Argument(help=f"One of {', '.join(FIGURES)}."),
    ],
    out: Annotated[Path, typer.Option(help="The picture to write: .png, .pdf or .svg.")],
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    sample: Annotated[
        str, typer.Option(help="Id of a recording, such as 8/0000 (default: the first one).")
    ] = "",
    per_digit: Annotated[
        int, typer.Option(help="Number of samples of each class on a sheet.", min=1)
    ] = 16,
    skip_bad: SkipBad = False,
    *,
    reading: ReadingGiven,
    jobs: options.Jobs = 2,
):
    """Draw recordings as the paper does.

    recording: the tactile image as it grows, above a raster of its events.

    sheet: tactile images of random samples of each class.
    """
    from pipeline.results.report import figures  # Matplotlib takes a second to import
    from pipeline.results.report.figures import recordings as drawn

    if what not in FIGURES:
        raise UserError(f"{what!r} is not a figure; choose one of {', '.join(FIGURES)}")
    figures.format_of(out)  # reports a wrong format before the recordings are read
    recordings = load_recordings(
        data, seed, skip_bad=skip_bad, jobs=jobs, warn=options.say, reading=reading
    )
    if what == "sheet":
        figure = drawn.sheet(recordings, per_digit, seed)
    else:
        figure = drawn.recording(recordings, _index_of(recordings, sample))
    figures.save(figure, out)
    show(out)


def _index_of(recordings, name):
    if not name:
        return 0
    if name in recordings.ids:
        return recordings.ids.index(name)
    raise UserError(f"no recording {name!r}; ids are like {recordings.ids[0]!r}")
