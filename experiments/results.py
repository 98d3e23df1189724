"""Stored results, from which the documents take their figures, and where they were measured."""

import datetime
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

# Stored results, from which the documents take their figures.
RESULTS = Path(__file__).resolve().parent.parent / "results"

Store = Annotated[str, typer.Option(help="Name of a file in results/ for the result.")]


def describe_machine() -> dict:
    """Describe a measurement: its processor, its versions and the time of its end."""
    return {
        "processor": name_processor(),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("tensorflow", "numpy", "nengo-loihi")},
        "ended": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def name_processor() -> str:
    """Name of this machine's processor, and its number of cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor()
    return f"{name}, {os.cpu_count()} cores"
