"""Options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipeline.inputs.library import SIMULATED
from pipeline.run.folder import RunFolder
from pipeline.settings import Settings, parse_assignments

Run = Annotated[Path, typer.Argument(help="The run's folder, such as runs/default.")]
Data = Annotated[
    Optional[str],  # noqa: UP045 - Typer reads the annotation at run time
    typer.Option(help="ST-MNIST zip or folder, or 'simulated' (default: the run's own)."),
]
Seed = Annotated[Optional[int], typer.Option(help="Seed of split, training and samples.")]  # noqa: UP045
Samples = Annotated[Optional[int], typer.Option(help="Samples of the check.")]  # noqa: UP045
Steps = Annotated[Optional[int], typer.Option(help="Steps of 1 ms that a sample is shown.")]  # noqa: UP045
SettingsFile = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--settings", help="A TOML file to start from instead of the run's own."),
]
Assignments = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--set", help="Change a setting, such as --set cnn.epochs=5; repeatable."),
]
Jobs = Annotated[int, typer.Option(help="Processes.", min=1)]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def resolver(data=None, settings_file=None, assignments=None):
    """:func:`resolve` of whatever folder it is called with."""
    return lambda run: resolve(run, data, settings_file=settings_file, assignments=assignments)


def resolve(
    run: RunFolder,
    data=None,
    seed=None,
    samples=None,
    steps=None,
    settings_file=None,
    assignments=None,
) -> Settings:
    """Settings of a run from its folder and the options that were given."""
    changes = parse_assignments(assignments or [])

    def put(section, name, value):
        if value is not None:
            (changes.setdefault(section, {}) if section else changes)[name] = value

    if data is not None and data != SIMULATED:
        data = str(Path(data).absolute())  # the run can be repeated from any folder
    put("data", "source", data)
    put(None, "seed", seed)
    put("check", "samples", samples)
    put("presentation", "steps", steps)
    return run.resolve_settings(settings_file, changes)
