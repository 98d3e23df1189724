"""Options that several commands share, and functions that apply them: settings, workers, output.

A command receives a group of options, such as those that choose the settings of a run, as one
value::

    def train(run: options.Run, requested: options.RunRequested, jobs: options.Jobs = 2): ...

where the annotation contains a :class:`Group`, or a function that makes one, if plugins can add
options to it.  Typer needs one parameter for each option, so :func:`convert_for_typer` replaces the
group by its options.
"""

import contextlib
import json
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, Signature, isfunction, signature
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from deploy.errors import CheckFailed, UserError
from deploy.terminal import format_command, remark, show
from pipeline.storage.run_folder import lock_run, require_run_or_new_folder

KEYWORD = Parameter.KEYWORD_ONLY


@dataclass(frozen=True)
class Group:
    """Options that a command receives as one value.

    Attributes
    ----------
    make : callable
        Function that makes the value from the options; its parameters have the options' defaults.
    options : dict
        Annotation of each option, by the parameter of ``make``, in the order of the help.
    """

    make: Callable
    options: dict


def group_options(make: Callable, **options) -> Group:
    """For the annotation of a parameter that receives several options as one value."""
    return Group(make, options)


def convert_for_typer(verb: Callable) -> Callable:
    """A verb whose signature has one parameter for each option.

    Parameters
    ----------
    verb : callable
        Function of a command; parameters may be annotated with :func:`group_options`, or with a
        function that is called here and returns one.

    Returns
    -------
    callable
        Takes every option as a keyword argument.
    """
    hints = get_type_hints(verb, include_extras=True)
    parameters = []
    groups = {}
    for name, parameter in signature(verb).parameters.items():
        annotated = _find_group(hints[name])
        if annotated is not None:
            groups[name] = annotated
            defaults = signature(annotated.make).parameters
            parameters += [
                Parameter(option, KEYWORD, default=defaults[option].default, annotation=hint)
                for option, hint in annotated.options.items()
            ]
        else:
            parameters.append(parameter.replace(kind=KEYWORD, annotation=hints[name]))

    @wraps(verb)
    def with_groups(**values):
        for name, each in groups.items():
            values[name] = each.make(**{option: values.pop(option) for option in each.options})
        return verb(**values)

    vars(with_groups)["__signature__"] = Signature(parameters)
    with_groups.__annotations__ = {each.name: each.annotation for each in parameters}
    return with_groups


def _find_group(hint) -> Group | None:
    """The group with which a parameter is annotated, if it is."""
    (first, *_) = getattr(hint, "__metadata__", (None,))
    if isfunction(first):
        first = first()
    return first if isinstance(first, Group) else None


Run = Annotated[Path, typer.Argument(help="Folder of the run, such as runs/default.")]
Bundle = Annotated[Path, typer.Argument(help="Folder of the bundle or of its run.")]
Data = Annotated[
    str | None,
    typer.Option(
        help="Zip or folder of recordings, or 'simulated' (default: that of the run, or simulated)."
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(help="Seed of split, training and samples (default: that of the run, or 0)."),
]
Input = Annotated[
    str | None,
    typer.Option(
        "--input",
        help="Input of the chip: image, slices or events (default: that of the run, or image).",
    ),
]
Samples = Annotated[
    int | None,
    typer.Option(
        help="Number of samples of the check; 0 for the whole test set (default: that of the run, "
        "or 200)."
    ),
]
Steps = Annotated[
    int | None,
    typer.Option(
        help="Number of steps of a sample (default: that of the run; or 100 on images, and as many "
        "as the longest recording needs on events)."
    ),
]
SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", help="TOML file of settings that replaces the folder's."),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a setting, such as --set cnn.epochs=5; repeatable."),
]
Jobs = Annotated[int, typer.Option(help="Number of parallel processes.", min=1, max=10_000)]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Address of a Dask scheduler, such as tcp://host:8786, whose workers do the jobs "
        "instead of processes of this machine."
    ),
]
SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Leave out files that cannot be read.")]
TimeUnit = Annotated[
    str,
    typer.Option(
        help="Unit of times in files of events: s, ms, us or ns (default: the files' own, or that "
        "of the training)."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def _make_workers(jobs=2, scheduler=None):
    from pipeline.results.study import Workers  # imports all that a run is made with

    return Workers(jobs, scheduler)


# The :class:`pipeline.results.study.Workers` of an experiment.
Workers = Annotated[Any, group_options(_make_workers, jobs=Jobs, scheduler=Scheduler)]


@dataclass(frozen=True)
class RequestedSettings:
    """Options that determine the settings of a run; options that were not given are None.

    Attributes
    ----------
    data, input, seed, samples, steps
        Values of the options of the same names.
    settings : Path or None
        TOML file of settings.
    assignments : list of str or None
        Values of ``--set``.
    """

    data: str | None = None
    input: str | None = None
    seed: int | None = None
    samples: int | None = None
    steps: int | None = None
    settings: Path | None = None
    assignments: list[str] | None = None

    def list_changes(self) -> dict:
        """The settings that the options change, nested as in
        :class:`pipeline.settings.schema.Settings`.

        Raises
        ------
        UserError
            An assignment is malformed, or contradicts an option.
        """
        from pipeline.settings import find_value, parse_assignments, set_nested  # import NumPy

        changes = parse_assignments(self.assignments or [])
        for option, name, value in (
            ("--data", "data.source", self.data),
            ("--input", "input.kind", self.input),
            ("--seed", "seed", self.seed),
            ("--samples", "check.samples", self.samples),
            ("--steps", "presentation.steps", self.steps),
        ):
            if value is not None:
                assigned = find_value(changes, name)
                if assigned not in (None, value):
                    problem = f"contradicts --set {name}={assigned}"
                    raise UserError(f"{option}: {problem}; give only one of them")
                set_nested(changes, name, value, option)
        return changes


CHANGES = {"settings": SettingsFile, "assignments": Assignments}
RunRequested = Annotated[
    RequestedSettings,
    group_options(
        RequestedSettings,
        data=Data,
        input=Input,
        seed=Seed,
        samples=Samples,
        steps=Steps,
        **CHANGES,
    ),
]
TrainingRequested = Annotated[
    RequestedSettings,
    group_options(RequestedSettings, data=Data, input=Input, seed=Seed, **CHANGES),
]


@contextlib.contextmanager
def lock_and_resolve_settings(
    path: Path, requested: RequestedSettings, changes: dict | None = None, of_results: bool = False
):
    """Lock a folder and resolve its settings with the options that were given.

    Parameters
    ----------
    path : Path
    requested : RequestedSettings
    changes : dict, optional
        Changed settings; the options have precedence.
    of_results : bool
        True for the folder of a sweep or experiment, False for a run.

    Yields
    ------
    RunFolder, Settings
        What the user has set.

    Raises
    ------
    UserError
        A file or value is wrong, or another process is working in the folder.
    """
    from pipeline.settings import merge_values  # imports NumPy

    with lock_run(path, of_results) as folder:
        changes = merge_values(changes or {}, requested.list_changes())
        yield folder, folder.resolve_settings(requested.settings, changes)


@contextlib.contextmanager
def open_requested_run(
    path: Path,
    requested: RequestedSettings,
    jobs: int,
    changes: dict | None = None,
    needs_check: bool = True,
    validate=None,
):
    """Lock a run, load its recordings, and choose what the settings leave open.

    Parameters
    ----------
    path, requested, changes
        As in :func:`lock_and_resolve_settings`.
    jobs : int
        Number of processes for recordings that are not in the cache.
    needs_check : bool
        True if the samples of a check will be drawn.
    validate : callable, optional
        Called with the settings before the recordings are loaded.

    Yields
    ------
    pipeline.workflow.opening.OpenedRun

    Raises
    ------
    UserError
        As :func:`lock_and_resolve_settings` and :func:`pipeline.workflow.opening.open_run`.
    """
    from pipeline.workflow import open_run  # imports all that a run is made with

    with lock_and_resolve_settings(path, requested, changes) as (folder, settings):
        if validate is not None:
            validate(settings)
        yield open_run(folder, settings, jobs, say, needs_check)


def find_bundle(path: Path) -> Path:
    """The folder of a bundle, which is named directly or by its run.

    Raises
    ------
    UserError
        The run has no bundle, or the folder has the results of an experiment.
    """
    if (path / "MANIFEST.json").exists():
        return path
    if (path / "bundle").is_dir():
        return path / "bundle"
    if (path / "experiment.toml").exists():
        require_run_or_new_folder(path)
        raise UserError(
            f"{path}: has no bundle yet; make it with {format_command('convert', path)}"
        )
    return path


# Prints a line on standard error; results go to standard output.
say = remark


def suggest(verb: str, *arguments):
    """Print at a terminal which command usually comes next, in one line on standard error."""
    if sys.stderr.isatty() and sys.stdout.isatty():
        say(f"next: {shlex.join(['stmnist', verb, *map(str, arguments)])}")


def warn_if_outdated(*paths: Path):
    """Warn if bundles or check results of a run are outdated, with the reason."""
    from pipeline.results.status import describe_outdated  # imports all that a run is made with

    for path in paths:
        if (note := describe_outdated(path)) is not None:
            say(note)


def print_result(value, as_text, as_json: bool, marked: str = ""):
    """Print a result as JSON, or as text made by ``as_text`` with a word marked by colour."""
    if as_json:
        show(json.dumps(value, indent=2))
    else:
        show(as_text(value), marked=marked)


def print_summary(summary: dict, failed: str, as_text, as_json: bool):
    """Print the result of many measurements.

    Parameters
    ----------
    summary : dict
    failed : str
        The failed parts, in one line; empty if nothing failed.
    as_text, as_json
        As in :func:`print_result`.

    Raises
    ------
    CheckFailed
        A part failed.
    """
    print_result(summary, as_text, as_json)
    if failed:
        raise CheckFailed(f"{failed}; the same command tries again")
