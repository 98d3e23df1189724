"""``stmnist data``: recordings - import, inspect, simulate, count, draw."""

from __future__ import annotations

import typer

app = typer.Typer(help="Recordings: read, look at, make, count, draw.", no_args_is_help=True)
