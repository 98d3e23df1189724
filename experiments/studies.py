"""Run an experiment that is a list of cases: its settings, its cases and its command.

:mod:`experiments.catalogue` has the experiments, :mod:`experiments.measuring` measures a case, and
:mod:`experiments.study_tables` makes the tables.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import write_json
from experiments import tables
from experiments.catalogue import Experiment
from experiments.measuring import measure
from experiments.results import RESULTS, Store, describe_machine
from experiments.study_tables import format_result
from experiments.styles import STYLES
from pipeline.commands import options
from pipeline.kinds.preparation import choose_settings
from pipeline.results import study
from pipeline.results.study import Case
from pipeline.settings import Provenance, Settings
from pipeline.sources import load_named_recordings


def list_settings(experiment: Experiment, lines, settings: Settings) -> dict:
    """The settings of each line by its name, without what is chosen for the recordings."""
    always = {"split": {"validation_fraction": experiment.validation}}
    of_lines = {}
    for line in lines:
        of_kind = settings.with_values({"input": {"kind": line.input}, **always}, line.name)
        of_lines[line.name] = of_kind.with_values(line.changes, line.name)
    return of_lines


def fit_settings(of_lines: dict, recordings, say) -> dict:
    """The settings of each line with what is chosen for the recordings.

    Parameters
    ----------
    of_lines : dict of str to Settings
    recordings : Recordings
    say : callable
        Called once with each message about a choice.
    """
    complete = {}
    by_line = {}
    messages = set()

    def say_once(text):
        if text not in messages:
            messages.add(text)
            say(text)

    for name, settings in of_lines.items():
        key = settings, settings.list_names(Provenance.USER)
        if key not in complete:
            complete[key] = choose_settings(settings, recordings, say=say_once)
        by_line[name] = complete[key]
    return by_line


def list_cases(experiment: Experiment, lines, settings: dict, seeds, splits) -> list:
    """The cases of an experiment.

    Parameters
    ----------
    experiment : Experiment
    lines : sequence of Line
    settings : dict of str to Settings
        The settings of each line, see :func:`fit_settings`.
    seeds, splits : iterable
        Seeds, and kinds of splits.
    """
    part = "validation" if experiment.validation else "test"
    return [
        Case(line.name, settings[line.name], line.stage, seed, split, part, line.alter)
        for split in splits
        for seed in seeds
        for line in lines
        if split != STYLES or line.styles
    ]


def run(experiment: Experiment, folder, settings, seeds: int, only: str, workers) -> tuple:
    """Measure an experiment's missing rows, and make its table.

    Returns
    -------
    dict, str
        The table, and the failed cases in one line.

    Raises
    ------
    UserError
        There is no such row, or the recordings cannot be read or do not fit.
    """
    lines = select_lines(experiment, only)
    recordings = load_named_recordings(settings, workers.processes, options.say)
    of_lines = fit_settings(list_settings(experiment, lines, settings), recordings, options.say)
    splits = list_splits(experiment, settings, recordings)
    folder.save_settings(settings)
    seeds = range(settings.seed, settings.seed + seeds)
    cases = list_cases(experiment, lines, of_lines, seeds, splits)
    sha256 = recordings.source.sha256
    rows, failed = study.run_study(cases, folder.path, sha256, workers, options.say, measure)
    result = {"experiment": experiment.name, **tables.make_table(rows, against=experiment.pairs)}
    result["measured"] = describe_machine()
    write_json(folder.path / f"{experiment.name}.json", result)
    return result, "; ".join(f"{c.name}, {c.split} {c.seed}: {e}" for c, e in failed.items())


def list_splits(experiment: Experiment, settings, recordings) -> tuple:
    """The kinds of splits: those of the settings, or random and, where it is asked, by writer."""
    kind = settings.split.kind
    if kind == "auto":
        kind = "published" if recordings.is_split else "random"
    if kind != "random" or not experiment.writers:
        return (kind,)
    are_known = recordings.writers.min(initial=0) >= 0
    return (kind, "writers" if are_known else STYLES)


def select_lines(experiment: Experiment, only: str) -> list:
    """The lines that ``--only`` names, or all that are not on request.

    Raises
    ------
    UserError
    """
    names = [name.strip() for name in only.split(",") if name.strip()]
    all_names = [line.name for line in experiment.lines]
    if unknown := [name for name in names if name not in all_names]:
        raise UserError(f"--only: no row {unknown[0]!r}; the rows are {', '.join(all_names)}")
    return [
        line for line in experiment.lines if (line.name in names if names else not line.on_request)
    ]


Out = Annotated[Path, typer.Option(help="Folder of the rows, which are not measured again.")]

Requested = Annotated[
    options.RequestedSettings,
    options.group_options(
        options.RequestedSettings, data=options.Data, seed=options.Seed, **options.CHANGES
    ),
]


def make_command(experiment: Experiment) -> Callable:
    """The command of an experiment."""

    def command(
        out: Out = Path("runs") / experiment.name,
        seeds: Annotated[
            int,
            typer.Option(
                "--seeds",
                "--splits",
                help="Number of splits, each with a seed, from that of the settings on.",
                min=1,
            ),
        ] = experiment.seeds,
        only: Annotated[str, typer.Option(help="Rows, separated by commas.")] = "",
        *,
        requested: Requested,
        store: Store = "",
        workers: options.Workers,
        as_json: options.Json = False,
    ):
        with options.lock_and_resolve_settings(out, requested, of_results=True) as (
            folder,
            settings,
        ):
            result, failed = run(experiment, folder, settings, seeds, only, workers)
        if store and not failed:
            write_json(RESULTS / f"{store}.json", result)
        options.print_summary(
            result, failed, lambda value: format_result(experiment, value), as_json
        )

    command.__doc__ = f"{experiment.title}: {experiment.time}."
    return command
