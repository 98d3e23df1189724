"""``stmnist benchmark conversion``: what the choices that the paper leaves open cost."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import options
from pipeline.commands.benchmark import app
from pipeline.experiments import choices
from pipeline.experiments.study import Measurement, run


@app.command("conversion")
def conversion(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; splits that are there are not run again.")
    ] = Path("runs/conversion"),
    splits: Annotated[int, typer.Option(help="Random splits.", min=1)] = 10,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Run the paper's networks under presentations, readouts and rates that it leaves open.

    Tells what could have cost the paper 2 points from CNN to spiking network and 3 to Loihi.  Goes
    on where it was interrupted.
    """
    measurement = Measurement(
        "conversion",
        choices.measure,
        choices.summarise,
        choices.choices_text,
        depends_on=(choices.SCHEMA, [asdict(choice) for choice in choices.CHOICES]),
    )
    run(measurement, out, splits, options.resolver(data, settings, set_), jobs, as_json)
