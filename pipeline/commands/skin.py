"""``stmnist data handwriting`` and ``aces``: model of handwriting, errors of ACES."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import sha256_of
from deploy.terminal import show
from pipeline.commands import options
from pipeline.progress import progress
from pipeline.skin import aces, parameters, shape_fit, shape_model, unipen

KNOWN_HANDWRITING = {
    "a66225d68d7d68591e62944df1ad33b3f5aa608e2df2505844b41f5568a80da4": {
        "source": "Pen-Based Recognition of Handwritten Digits, training writers; E. Alpaydin and "
        "F. Alimoglu, 1998",
        "licence": "CC BY 4.0",
    }
}
"""Source and licence of files from which a model may be estimated, by their hash."""


def handwriting(
    file: Annotated[Path, typer.Argument(help="UNIPEN file of digits, with their writers.")],
    seed: Annotated[
        int, typer.Option(help="Seed of the search.", parser=options.between(0, 2**31 - 1))
    ] = 0,
    out: Annotated[
        Path, typer.Option(help="File for the model.", show_default="the one that is read")
    ] = shape_model.MODEL,
):
    """Estimate the model of handwriting from recorded pen trajectories.

    pipeline/skin/shape_model.py describes the model.  The file has its parameters and no
    trajectory; the simulation reads the file that is written by default.
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


def aces_(
    trials: Annotated[int, typer.Option(help="Number of trials of each condition.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the trials.", min=0)] = 0,
    as_json: options.Json = False,
):
    """Measure the errors of ACES, the code by which all taxels share a wire, with noise on it."""
    with progress("aces", len(aces.NOISES) * len(aces.AT_ONCE)) as advance:
        rows = aces.wire_losses(trials, seed, parameters.load().aces, advance)
    options.tell(rows, aces.wire_losses_text, as_json)
