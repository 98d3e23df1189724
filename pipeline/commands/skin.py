"""``stmnist data aces``: errors of ACES."""

from __future__ import annotations

from typing import Annotated

import typer

from pipeline.commands import options
from pipeline.progress import progress
from pipeline.skin import aces, parameters


def aces_(
    trials: Annotated[int, typer.Option(help="Number of trials of each condition.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the trials.", min=0)] = 0,
    as_json: options.Json = False,
):
    """Measure the errors of ACES, the code by which all taxels share a wire, with noise on it."""
    with progress("aces", len(aces.NOISES) * len(aces.AT_ONCE)) as advance:
        rows = aces.wire_losses(trials, seed, parameters.load().aces, advance)
    options.tell(rows, aces.wire_losses_text, as_json)
