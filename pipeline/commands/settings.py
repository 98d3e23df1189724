"""``stmnist settings``: names, values and meanings of all settings."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import options
from pipeline.settings import Settings, describe_settings, format_settings, read_settings
from pipeline.storage.run_folder import RunFolder


def settings(
    run: Annotated[
        Path | None, typer.Argument(help="Folder of the run; without it, the defaults.")
    ] = None,
    as_json: options.Json = False,
):
    """List every setting: its name, as --set takes it, its value, its default and its meaning."""
    chosen = read_settings(RunFolder(run).experiment) if run else Settings()
    options.print_result(describe_settings(chosen), format_settings, as_json)
