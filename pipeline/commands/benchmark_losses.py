"""``stmnist benchmark losses``: what conversion and chip cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import options
from pipeline.commands.benchmark import app
from pipeline.experiments import losses
from pipeline.experiments.study import Measurement, run


@app.command("losses")
def losses_(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; seeds that are there are not run again.")
    ] = Path("runs/losses"),
    seeds: Annotated[
        int, typer.Option(help="Seeds, from the settings' own on; one a split.", min=1)
    ] = 10,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Measure what is lost from the CNN to the chip: whole test split, several seeds.

    The chip is the target fast, at 100 and at 50 steps.  Goes on where it was interrupted.
    """
    measurement = Measurement(
        "losses",
        losses.measure,
        losses.summarise,
        losses.losses_text,
        depends_on=(losses.SCHEMA,),
        check=losses.check,
    )
    run(measurement, out, seeds, options.resolver(data, settings, set_), jobs, as_json)
