"""``stmnist data``: what the simulated skin was fitted to, and how good it is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import CheckFailed, UserError
from deploy.files import sha256_of
from deploy.terminal import show
from pipeline.commands import options
from pipeline.commands.data import SimulationSeed
from pipeline.experiments import difficulty as difficulty_
from pipeline.experiments.study import Workers
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.progress import progress
from pipeline.recordings import table1
from pipeline.skin import aces, calibration, parameters, shape_fit, shape_model, unipen
from pipeline.skin.simulate import simulate, source_of

KNOWN_HANDWRITING = {
    "a66225d68d7d68591e62944df1ad33b3f5aa608e2df2505844b41f5568a80da4": {
        "source": "Pen-Based Recognition of Handwritten Digits, training writers; E. Alpaydin and "
        "F. Alimoglu, 1998",
        "licence": "CC BY 4.0",
    }
}
"""What a model says of the files that it is estimated from, by their hash."""


def calibrate(
    rounds: Annotated[int, typer.Option(help="Rounds of the fit.", min=1)] = 8,
    seed: SimulationSeed = 0,
    check: Annotated[
        bool, typer.Option("--check", help="Do not fit; exit 1 if a cell exceeds its limit.")
    ] = False,
    out: Annotated[
        Path, typer.Option(help="File for the fit.", show_default="the one that is read")
    ] = parameters.CALIBRATION,
    jobs: options.Jobs = 2,
):
    """Fit the simulated recordings to the paper's Table 1, or check the fit.

    How is described in pipeline/skin/calibration.py.  The simulation reads the file that is written
    by default.
    """
    fitted = parameters.load()
    if not check:
        with progress("calibrate", rounds * sum(SAMPLES_PER_DIGIT)) as advance:
            fitted, _ = calibration.calibrate(fitted, rounds, seed, jobs, advance=advance)
        content = source_of(seed, parameters=fitted).sha256
        about = {"seed": seed, "rounds": rounds, "recordings_sha256": content}
        parameters.write_calibration(out, fitted, about)
    with progress("simulate", sum(SAMPLES_PER_DIGIT)) as advance:
        recordings = simulate(seed, jobs=jobs, advance=advance, parameters=fitted)
    cells = calibration.cells(table1.table(recordings))
    past = [cell for cell in cells if cell.strain > 1]
    show(calibration.cells_text(cells[:8]))
    show(f"seed {seed}: {len(cells) - len(past)} of {len(cells)} cells within their limits")
    if past:
        raise CheckFailed(f"{len(past)} cells of Table 1 are past their limits")


def handwriting(
    file: Annotated[Path, typer.Argument(help="UNIPEN file of digits, with their writers.")],
    seed: Annotated[
        int, typer.Option(help="Seed of the search.", parser=options.between(0, 2**31 - 1))
    ] = 0,
    out: Annotated[
        Path, typer.Option(help="File for the model.", show_default="the one that is read")
    ] = shape_model.MODEL,
):
    """Estimate how people write from recorded pen trajectories.

    How is described in pipeline/skin/shape_model.py.  The simulation reads the file that is written
    by default; it has the model's parameters and no trajectory.
    """
    traces = unipen.read(file)
    content = sha256_of(file)
    about = {"sha256": content, **KNOWN_HANDWRITING.get(content, {"source": file.name})}
    try:
        model = shape_fit.estimate(traces, seed, about)
    except ValueError as error:
        raise UserError(f"{file}: {error}; give digits of more people") from error
    shape_model.write(out, model)
    ways = ", ".join(f"{digit}: {len(ways)}" for digit, ways in enumerate(model.allographs))
    about = model.about
    show(f"{about['digits']} digits of {about['writers']} writers; ways of writing {ways}")
    show(f"{out}: {out.stat().st_size} bytes")


def difficulty(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; splits with a result are not run again.")
    ] = Path("runs/difficulty"),
    splits: Annotated[int, typer.Option(help="Random 80-20 splits.", min=1)] = 10,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    store: Annotated[
        bool, typer.Option("--store", help="Save the result with the simulation's settings.")
    ] = False,
    jobs: options.Jobs = 2,
    scheduler: options.Scheduler = None,
    as_json: options.Json = False,
):
    """Measure the accuracy of the paper's CNN on the recordings, with the paper's protocol.

    Goes on where it was interrupted.
    """
    workers = Workers(jobs, scheduler)
    with options.opened(out, data, None, None, None, settings, set_) as (folder, resolved):
        found = difficulty_.measure_difficulty(folder, resolved, splits, workers, options.say)
    if store and not found.failed:
        difficulty_.store(found.summary)
    options.conclude(found, difficulty_.difficulty_text, as_json)


def aces_(
    trials: Annotated[int, typer.Option(help="Trials of each condition.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the trials.", min=0)] = 0,
    as_json: options.Json = False,
):
    """Measure the errors of the shared wire: encode, add noise, decode, compare."""
    with progress("aces", len(aces.NOISES) * len(aces.AT_ONCE)) as advance:
        rows = aces.wire_losses(trials, seed, parameters.load().aces, advance)
    options.tell(rows, aces.wire_losses_text, as_json)
