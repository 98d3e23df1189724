"""Train networks on simulated recordings and test them on real ones, in the published form.

The published arrays of ST-MNIST keep the order of events and not their time, so the simulated
recordings are divided into chunks in the same way; see :mod:`pipeline.recordings.chunks`.
"""

from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import write_json
from deploy.tables import align_rows
from deploy.terminal import show
from experiments.fidelity import hold_out_recordings
from pipeline.api.run import Run
from pipeline.commands import options
from pipeline.recordings.sensor import are_digits
from pipeline.sources import load_recordings

# The inputs of the chip that are compared, with their names in the table.
INPUTS = {"image": "one image", "slices": "slices of time", "events": "events"}


def measure_input(kind: str, folder: Path, real, seed: int, jobs: int) -> dict:
    """Train a network on simulated recordings; test it on simulated and on real ones.

    Parameters
    ----------
    kind : str
        A key of `INPUTS`.
    folder : Path
        Of the run, which is continued if it exists.
    real : Recordings
        The recordings of the test.
    seed : int
    jobs : int

    Returns
    -------
    dict
        ``input``, and the accuracies on the emulated chip on ``simulated`` recordings (the check of
        the bundle) and on ``real`` ones.
    """
    run = Run(folder, input=kind, jobs=jobs, **{"data.chunked": 1.0, "seed": seed})
    run.convert()
    return {
        "input": kind,
        "simulated": run.check("fast").accuracy,
        "real": run.check("fast", data=real, samples=0).accuracy,
    }


def make_cells(result: dict) -> list:
    """The table of a result."""
    heads = ["network, emulated Loihi", "on simulated recordings", "on real recordings"]
    rows = [
        [INPUTS[row["input"]], f"{row['simulated']:.3f}", f"{row['real']:.3f}"]
        for row in result["rows"]
    ]
    return [heads, *rows]


def main(
    data: Annotated[Path, typer.Option(help="Zip or folder of real recordings of digits.")],
    out: Annotated[Path, typer.Option(help="The JSON file to write.")],
    runs: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("runs/transfer"),
    seed: Annotated[int, typer.Option(help="Seed of the trainings.", min=0)] = 0,
    jobs: options.Jobs = 2,
):
    """Test networks that are trained on simulated recordings only on real ones.

    The real ones are the fifth to which the simulation was not fitted (``calibrate``).
    """
    real = load_recordings(str(data), jobs=jobs)
    if not are_digits(real.sensor.classes):
        raise UserError(f"{data}: its classes are not the ten digits; give recordings of digits")
    _, held_out = hold_out_recordings(real)
    rows = [measure_input(kind, runs / kind, held_out, seed, jobs) for kind in INPUTS]
    result = {
        "experiment": "transfer",
        "recordings": [real.source.sha256],
        "held_out": len(held_out),
        "rows": rows,
    }
    write_json(out, result)
    show("\n".join(align_rows(make_cells(result), left=1)))
