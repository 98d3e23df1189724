"""``stmnist data``: recordings - import, inspect, simulate, count, draw."""

import os
from pathlib import Path
from typing import Annotated

import typer

from deploy import limits
from deploy.errors import UserError
from deploy.files import require_ending
from deploy.terminal import format_command, show
from pipeline.commands import options
from pipeline.settings import SIMULATED, Settings, merge_values

Source = Annotated[str, typer.Option("--data", help="Zip or folder of recordings, or 'simulated'.")]
SimulationSeed = Annotated[
    int, typer.Option("--seed", help="Seed of simulated recordings.", min=0, max=2**31 - 1)
]
PerDigit = Annotated[
    int, typer.Option(help="Recordings of each digit; 0: as published.", min=0, max=limits.SAMPLES)
]
Reading = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="A setting of reading recordings: data.time_unit=us, data.downsample=4, data.bin=20, "
        "data.rise=1, data.skip_bad=true, skin.rows=16, skin.columns=16, data.writers=100; "
        "repeatable.",
    ),
]


def _load_recordings(source, reading, jobs, **data):
    from pipeline.sources import load_named_recordings

    return load_named_recordings(_make_settings(source, reading, **data), jobs, options.say)


def _make_settings(source, reading, **data):
    """The settings of recordings; ``--set`` has precedence over the values of other options."""
    requested = options.RequestedSettings(data=source, assignments=reading).list_changes()
    return Settings().with_values(merge_values({"data": data}, requested), "command line")


def import_(
    source: Annotated[str, typer.Argument(help="Zip or folder of recordings, such as ST-MNIST's.")],
    reading: Reading = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Read recordings once and store them in the cache, so that the next start is fast."""
    from pipeline.recordings.facts import format_facts, list_facts_with_events

    recordings = _load_recordings(source, reading, jobs)
    facts = list_facts_with_events(recordings)
    options.print_result(facts, lambda facts: format_facts(facts, recordings), as_json)


def inspect(
    file: Annotated[Path, typer.Argument(help="One recording: .mat, or a file of events.")],
    reading: Reading = None,
    as_json: options.Json = False,
):
    """Print facts about one recording."""
    from pipeline.recordings.cached_recordings import make_reading_options
    from pipeline.recordings.facts_of_file import format_facts_of_file, list_facts_of_file

    is_zip = file.suffix.lower() == ".zip" and file.is_file()
    if file.is_dir() or is_zip:
        what = "zip" if is_zip else "folder"
        raise UserError(
            f"{file}: is a {what}; name one recording in it, or describe all of them with "
            f"{format_command('data', 'stats', '--data', str(file))}"
        )
    facts = list_facts_of_file(file, make_reading_options(_make_settings(str(file), reading)))
    options.print_result(facts, lambda facts: format_facts_of_file(file.name, facts), as_json)


def simulate_(
    out: Annotated[
        Path, typer.Option(help="The zip to write, in the published layout.", metavar="ZIP")
    ],
    seed: SimulationSeed = 0,
    samples_per_digit: PerDigit = 0,
    reading: Reading = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Write simulated recordings as a new zip in the layout of ST-MNIST."""
    require_ending(out, ".zip")
    if os.path.lexists(out):
        raise UserError(f"{out}: exists; choose another name, or move it away")
    from pipeline.progress import progress
    from pipeline.recordings.facts import list_facts_with_events
    from pipeline.recordings.files.writing import write_mat_zip

    recordings = _load_recordings(
        SIMULATED, reading, jobs, simulation_seed=seed, samples_per_digit=samples_per_digit
    )
    write_mat_zip(out, recordings, progress)
    facts = {"file": str(out), **list_facts_with_events(recordings)}
    text = f"{out}: {facts['samples']} simulated recordings, {facts['events']} events"
    options.print_result(facts, lambda _: text, as_json)


def stats(
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    reading: Reading = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Print the paper's Table 1 for any recordings, the order of polarities and hot taxels.

    Columns of ST-MNIST's files are counted as in the paper; an event is a burst of columns.
    """
    from pipeline.recordings.statistics import format_statistics, make_statistics_json

    recordings = _load_recordings(data, reading, jobs, simulation_seed=seed)
    options.print_result(
        make_statistics_json(recordings), lambda _: format_statistics(recordings), as_json
    )


FIGURES = ("recording", "sheet")


def plot(  # noqa: PLR0913 - each is an option of the command
    what: Annotated[str, typer.Argument(help=f"One of {', '.join(FIGURES)}.")],
    out: Annotated[Path, typer.Option(help="The picture to write: .png, .pdf or .svg.")],
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    sample: Annotated[
        str, typer.Option(help="Id of a recording, such as 8/0000 (default: a usual one).")
    ] = "",
    reading: Reading = None,
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
    if sample and what == "sheet":
        raise UserError("--sample: a sheet draws its own; use 'stmnist data plot recording'")
    figures.find_format(out)  # reports a wrong format before the recordings are read
    recordings = _load_recordings(data, reading, jobs, simulation_seed=seed)
    if what == "sheet":
        figure = drawn.draw_sheet(recordings, seed)
    else:
        figure = drawn.draw_recording(recordings, _find_index(recordings, sample))
    figures.save_figure(figure, out)
    show(out)


def _find_index(recordings, name):
    """The index of a recording by its id; of one of typical length without an id."""
    if not name:
        numbers = recordings.offsets[1:] - recordings.offsets[:-1]  # of events
        return int(numbers.argsort()[len(recordings) // 2])
    if name in recordings.ids:
        return recordings.ids.index(name)
    raise UserError(f"no recording {name!r}; ids are like {recordings.ids[0]!r}")
