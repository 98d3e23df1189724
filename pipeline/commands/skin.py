"""``stmnist data``: the simulated skin - simulate, count, draw, fit."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from deploy.errors import CheckFailed, UserError
from deploy.files import replacing, write_json
from pipeline.commands import options
from pipeline.commands.data import app
from pipeline.experiments import difficulty as measured
from pipeline.inputs.library import SIMULATED, load_recordings
from pipeline.progress import progress
from pipeline.recordings import table1 as statistics
from pipeline.recordings.archive import write_zip
from pipeline.settings import Settings
from pipeline.skin import aces, parameters, unipen
from pipeline.skin import calibration as calibrate
from pipeline.skin.simulate import SAMPLES_PER_DIGIT, simulate, source_of

Source = Annotated[str, typer.Option("--data", help="ST-MNIST zip or folder, or 'simulated'.")]
SimulationSeed = Annotated[int, typer.Option("--seed", help="Seed of simulated recordings.", min=0)]
PerDigit = Annotated[
    int, typer.Option(help="Recordings of each digit; 0 for the published numbers.", min=0)
]


@app.command("simulate")
def simulate_(
    out: Annotated[Path, typer.Option(help="The zip to write, in the published layout.")],
    handwriting: Annotated[
        Optional[Path],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(help="UNIPEN file of digits to press on the skin instead of simulated hands."),
    ] = None,
    seed: SimulationSeed = 0,
    samples_per_digit: PerDigit = 0,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Write simulated recordings as a zip in the layout of ST-MNIST."""
    if out.suffix != ".zip":
        raise UserError(f"{out}: the name must end in .zip")
    if handwriting is None:
        recordings = load_recordings(SIMULATED, seed, samples_per_digit, jobs=jobs)
    else:
        counts = [samples_per_digit] * 10 if samples_per_digit else list(SAMPLES_PER_DIGIT)
        traces = unipen.read(handwriting)
        with progress("simulate", sum(counts)) as advance:
            recordings = simulate(seed, counts, jobs, advance, traces=traces)
    write_zip(out, recordings, progress)
    facts = {
        "file": str(out),
        "simulated": True,
        "source": recordings.source.name,
        "sha256": recordings.source.sha256,
        "samples": len(recordings),
        "events": len(recordings.events),
    }
    if as_json:
        print(json.dumps(facts, indent=2))
    else:
        print(f"{out}: {facts['samples']} simulated recordings, {facts['events']} events")


@app.command()
def stats(
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    against_paper: Annotated[
        bool, typer.Option("--against-paper", help="The paper's Table 1 and the errors beside it.")
    ] = False,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Print the paper's Table 1 for any recordings.

    Events are counted as the paper does, one for each column of a file; physical events count each
    burst of columns once.
    """
    recordings = load_recordings(data, seed, jobs=jobs)
    table = statistics.table(recordings)
    if as_json:
        print(json.dumps(_as_json(recordings, table, against_paper), indent=2))
        return
    console = Console(width=None if Console().is_terminal else 180)
    name = recordings.source.name
    if recordings.source.simulated and "simulated" not in name:
        name += " (simulated)"
    shown = Table(title=f"{name}, {len(recordings)} samples: mean (SD)")
    shown.add_column("")
    for digit in table:
        shown.add_column(str(digit), justify="right")
    for name, label in LABELS.items():
        decimals = 2 if name[0] in "xy" else 0
        shown.add_row(label, *(_cell(row[name], decimals) for row in table.values()))
        if against_paper and name in statistics.MEASURES:
            paper = [statistics.PAPER[digit][name] for digit in table]
            shown.add_row("  paper", *(_cell(pair, decimals) for pair in paper), style="dim")
            errors = [_error(table[d][name], statistics.PAPER[d][name]) for d in table]
            shown.add_row("  error %", *errors, style="dim", end_section=True)
    shown.add_row("samples", *(str(row["samples"]) for row in table.values()))
    if against_paper:
        samples = [str(statistics.PAPER[digit]["samples"]) for digit in table]
        shown.add_row("  paper", *samples, style="dim")
    console.print(shown)


LABELS = {
    "on": "ON events",
    "off": "OFF events",
    "on_physical": "physical ON",
    "off_physical": "physical OFF",
    "x_mean": "X mean",
    "y_mean": "Y mean",
    "x_range": "X range",
    "y_range": "Y range",
}


def _as_json(recordings, table, against_paper):
    digits = {str(digit): _plain(row) for digit, row in table.items()}
    if against_paper:
        for digit, row in table.items():
            paper = statistics.PAPER[digit]
            digits[str(digit)]["paper"] = _plain(paper)
            digits[str(digit)]["error"] = _plain(
                {name: _relative(row[name], paper[name]) for name in statistics.MEASURES}
            )
    return {
        "simulated": recordings.source.simulated,
        "samples": len(recordings),
        "digits": digits,
    }


def _plain(row):
    return {
        name: [None if math.isnan(v) else v for v in value] if isinstance(value, tuple) else value
        for name, value in row.items()
    }


def _relative(pair, paper):
    return tuple(value / target - 1 for value, target in zip(pair, paper, strict=True))


def _cell(pair, decimals):
    return f"{pair[0]:.{decimals}f} ({pair[1]:.{decimals}f})"


def _error(pair, paper):
    mean, spread = (100 * error for error in _relative(pair, paper))
    return f"{mean:+.0f} ({spread:+.0f})"


FIGURES = ("recording", "events", "layout", "sheet")


@app.command()
def plot(
    what: Annotated[str, typer.Argument(help=f"One of {', '.join(FIGURES)}.")],
    out: Annotated[Path, typer.Option(help="The picture to write: .png, .pdf or .svg.")],
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    sample: Annotated[str, typer.Option(help="Id of a recording, such as 8/0000.")] = "8/0000",
    per_digit: Annotated[int, typer.Option(help="Samples of each digit on a sheet.", min=1)] = 16,
    jobs: options.Jobs = 2,
):
    """Draw recordings as the paper does.

    recording: the tactile image as it grows, above a raster of 100 taxels over 2 s.

    events: each taxel's events, at its place on the array.

    layout: taxel addresses and their (X, Y).

    sheet: tactile images of random samples of each digit.
    """
    from pipeline.report import recordings as data_figures  # Matplotlib takes a second to import

    if what not in FIGURES:
        raise UserError(f"{what!r} is no figure; choose one of {', '.join(FIGURES)}")
    if out.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise UserError(f"{out}: cannot draw that format; end the name in .png, .pdf or .svg")
    recordings = load_recordings(data, seed, jobs=jobs)
    if what == "layout":
        figure = data_figures.layout(recordings.taxels)
    elif what == "sheet":
        figure = data_figures.sheet(recordings, per_digit, seed)
    else:
        draw = data_figures.recording if what == "recording" else data_figures.events_by_taxel
        figure = draw(recordings, _index_of(recordings, sample))
    with replacing(out) as file:
        figure.savefig(file, format=out.suffix[1:].lower(), dpi=120)
    print(out)


def _index_of(recordings, name):
    if name in recordings.ids:
        return recordings.ids.index(name)
    raise UserError(f"no recording {name!r}; ids are like {recordings.ids[0]!r}")


@app.command("calibrate")
def calibrate_(
    rounds: Annotated[int, typer.Option(help="Rounds of the fit.", min=1)] = 8,
    seed: SimulationSeed = 0,
    check: Annotated[
        bool, typer.Option("--check", help="Fit nothing; exit 1 if a cell is past its limit.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Where to write the fit.")] = parameters.CALIBRATION,
    jobs: options.Jobs = 2,
):
    """Fit the simulated recordings to the paper's Table 1, or check the fit.

    How is described in pipeline/skin/calibration.py.  The simulation reads the file that is written
    by default.
    """
    fitted = parameters.load()
    if not check:
        with progress("calibrate", rounds * sum(SAMPLES_PER_DIGIT)) as advance:
            fitted, _ = calibrate.calibrate(fitted, rounds, seed, jobs, advance=advance)
        content = source_of(seed, parameters=fitted).sha256
        about = {"seed": seed, "rounds": rounds, "recordings_sha256": content}
        parameters.write_calibration(out, fitted, about)
    with progress("simulate", sum(SAMPLES_PER_DIGIT)) as advance:
        recordings = simulate(seed, jobs=jobs, advance=advance, parameters=fitted)
    cells = calibrate.cells(statistics.table(recordings))
    past = [cell for cell in cells if cell.strain > 1]
    for cell in cells[:8]:
        print(
            f"digit {cell.digit} {cell.measure:8s}{cell.part:5s}{cell.simulated:9.2f}"
            f"  paper {cell.paper:8.2f}  {cell.strain:4.2f} of the limit"
        )
    print(f"seed {seed}: {len(cells) - len(past)} of {len(cells)} cells within their limits")
    if past:
        raise CheckFailed(f"{len(past)} cells of Table 1 are past their limits")


@app.command()
def difficulty(
    data: Source = SIMULATED,
    seed: SimulationSeed = 0,
    splits: Annotated[int, typer.Option(help="Random 80-20 splits.", min=1)] = 10,
    store: Annotated[
        bool, typer.Option("--store", help="Keep the result beside the simulation's settings.")
    ] = False,
    jobs: options.Jobs = 2,
):
    """Measure how hard the recordings are: the paper's CNN under the paper's protocol."""
    recordings = load_recordings(data, seed, jobs=jobs)
    settings = Settings()
    with progress("train", settings.cnn.epochs) as advance:
        accuracies = measured.measure(recordings, splits, settings, advance)
    mean, spread = np.mean(accuracies), np.std(accuracies, ddof=1) if splits > 1 else math.nan
    kind = "simulated" if recordings.source.simulated else "recorded"
    print(f"{kind}: accuracy {mean:.4f} (SD {spread:.4f}) over {splits} splits; paper 0.89 (0.01)")
    if store:
        write_json(
            measured.RECORD,
            {
                "source": recordings.source.name,
                "sha256": recordings.source.sha256,
                "simulated": recordings.source.simulated,
                "accuracies": accuracies,
            },
        )


NOISES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
AT_ONCE = (1, 10, 30, 100)


@app.command("aces")
def aces_(
    trials: Annotated[int, typer.Option(help="Trials of each condition.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the trials.", min=0)] = 0,
    as_json: options.Json = False,
):
    """Measure what the shared wire loses: encode, add noise, decode, compare."""
    p = parameters.load().aces
    conditions = [(noise, n) for noise in NOISES for n in AT_ONCE]
    rows = []
    with progress("aces", len(conditions)) as advance:
        for index, (noise, at_once) in enumerate(conditions):
            rng = np.random.default_rng([seed, index])
            result = aces.round_trip(at_once, noise, trials, rng, p)
            rows.append({"noise": noise, "at_once": at_once, **result})
            advance(1)
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    print("noise  at once  found    polarity  false/event  timing (ns)  sent")
    for row in rows:
        print(
            f"{row['noise']:5.2f}  {row['at_once']:7d}  {row['found']:7.4f}  {row['polarity']:8.4f}"
            f"  {row['false']:11.4f}  {row['timing_ns']:11.1f}  {row['sent']:4d}"
        )
