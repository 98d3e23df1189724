"""The command ``stmnist``: joins the verbs and turns errors into one line and an exit status."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import OptionInfo

from deploy import __version__, interrupts
from deploy.errors import CheckFailed, UserError, drop_unwritable, line_of, one_line
from models.architecture import NotationError
from pipeline.commands import (
    benchmark,
    check,
    compare,
    data,
    deploy,
    live,
    report,
    settings,
    skin,
    stages,
    sweep,
)

# Typer brings its own copy of Click from some version on: these are the classes that it raises.
UsageError = typer.BadParameter.__base__
ClickException = UsageError.__base__

VERBS = {
    "data": (
        "Recordings: read, look at, make, count, draw.",
        {
            "import": data.import_,
            "inspect": data.inspect,
            "export": data.export,
            "simulate": data.simulate_,
            "stats": data.stats,
            "plot": data.plot,
            "calibrate": skin.calibrate,
            "difficulty": skin.difficulty,
            "aces": skin.aces_,
        },
    ),
    "train": stages.train,
    "convert": stages.convert,
    "check": (
        "The check that every target answers.",
        {"run": check.run, "compare": check.compare_checks},
    ),
    "ladder": stages.ladder,
    "compare": compare.compare_,
    "deploy": (
        "Before and beside a board: what fits, exports.",
        {"plan": deploy.plan, "export": deploy.export, "energy": deploy.energy},
    ),
    "benchmark": (
        "The paper's Table 2, what conversion costs and time is worth, and speed.",
        {
            "table2": benchmark.table2,
            "training": benchmark.training,
            "conversion": benchmark.conversion,
            "emulator": benchmark.emulator,
            "losses": benchmark.losses,
            "events": benchmark.events,
            "live": benchmark.live,
        },
    ),
    "sweep": sweep.sweep,
    "report": report.report,
    "live": live.live,
    "settings": settings.settings,
}
"""Every verb: a function, or a help text and verbs of its own."""


METAVARS = {bool: "", int: "N", float: "X", Path: "PATH", str: "TEXT"}
"""What ``--help`` says that an option takes; a choice lists itself.  Typer's own words, such as
``<int range>``, would take a third of 60 columns from the help."""


def _with_short_metavars(verb):
    """The verb, its options with words of :data:`METAVARS` where they have none of their own."""
    hints = get_type_hints(verb, include_extras=True)
    for hint in hints.values():
        kinds = (
            {hint.__origin__, *get_args(hint.__origin__)} if get_origin(hint) is Annotated else ()
        )
        inner = {kind for outer in kinds for kind in (outer, *get_args(outer))}
        word = next((METAVARS[kind] for kind in METAVARS if kind in inner), None)
        for info in getattr(hint, "__metadata__", ()):
            if isinstance(info, OptionInfo) and info.metavar is None:
                info.metavar = word
    verb.__annotations__ = hints  # as they were read: in the source they are text
    return verb


class _Flags:
    """Without a word for what is taken, beside options of Typer's own that take nothing."""

    def get_params(self, ctx):
        parameters = super().get_params(ctx)
        for parameter in parameters:
            if getattr(parameter, "is_flag", False) and parameter.metavar is None:
                parameter.metavar = ""
        return parameters


class _Command(_Flags, TyperCommand):
    pass


class _Group(_Flags, TyperGroup):
    pass


def _typer(help_text, verbs, **options) -> typer.Typer:
    made = typer.Typer(help=help_text, no_args_is_help=True, cls=_Group, **options)
    for name, verb in verbs.items():
        if callable(verb):
            made.command(name, cls=_Command)(_with_short_metavars(verb))
        else:
            made.add_typer(_typer(*verb), name=name)
    return made


app = _typer(
    "From event-based touch to a spiking network on Loihi.",
    VERBS,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # which fills paragraphs
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


@app.callback(invoke_without_command=True)
def root(
    version: bool = typer.Option(False, "--version", help="Print the version and stop."),
):
    """From event-based touch to a spiking network on Loihi."""
    if version:
        print(__version__)
        raise typer.Exit


def main(arguments=None):
    """Run the command.

    Exit status 0: done; 1: a check failed; 2: wrong usage or bad input; 130: interrupted.
    """
    try:
        status = app(args=arguments, prog_name="stmnist", standalone_mode=False)
        if status == interrupts.STATUS:  # Typer turns an interruption into this status
            raise KeyboardInterrupt
        sys.stdout.flush()  # at Python's end it is too late for a line
    except (KeyboardInterrupt, typer.Abort):
        status = _say(interrupts.LINE, interrupts.STATUS)
    except UsageError as error:
        context = error.ctx.command_path if error.ctx else "stmnist"
        problem = error.format_message().rstrip(".") or "a command is missing"
        status = _say(f"{problem} (see '{context} --help')", 2)
    except ClickException as error:
        status = _say(error.format_message(), 2)
    except CheckFailed as error:
        status = _say(str(error), 1)
    except (UserError, NotationError) as error:
        status = _say(str(error), 2)
    except (BrokenPipeError, SystemExit) as end:
        # The reader, such as head, has seen enough.  Typer ends with status 1 then.
        if isinstance(end, SystemExit) and not isinstance(end.__context__, BrokenPipeError):
            raise
        status = 0
    except (MemoryError, OSError) as error:  # what no module foresaw
        status = _say(line_of(error), 2)
    drop_unwritable()
    sys.exit(status or 0)


def _say(message, status):
    print("stmnist: " + one_line(message), file=sys.stderr)
    return status
