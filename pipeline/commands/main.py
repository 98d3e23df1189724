"""The command ``stmnist``: its sub-commands, and errors as one line and an exit status."""

import sys
from concurrent.futures import BrokenExecutor
from functools import cached_property
from importlib import import_module

import typer
import typer.main
from typer.core import TyperCommand, TyperGroup

from deploy import __version__
from deploy.errors import (
    KILLED_MESSAGE,
    CheckFailed,
    SeveralErrors,
    UserError,
    describe_error,
    format_as_line,
)
from deploy.plugins import load_plugins
from deploy.terminal import INTERRUPTED, INTERRUPTION, drop_output, prepare_terminal, remark, show
from pipeline.commands.options import convert_for_typer
from pipeline.interrupts import handle_signals, raise_at_interrupts

# Typer brings its own copy of Click from some version on: these are the classes that it raises.
UsageError, ClickException = typer.BadParameter.__mro__[1:3]

# Each sub-command: its line in the list, and its function, as ``module.function`` of this package,
# or its own sub-commands. A module is imported only when one of its commands is chosen, so that
# ``--help`` and TAB do not wait for the second that importing all of them takes.
COMMANDS = {
    "data": (
        "Recordings: import, inspect, simulate, count, draw.",
        {
            "import": "data.import_",
            "inspect": "data.inspect",
            "simulate": "data.simulate_",
            "stats": "data.stats",
            "plot": "data.plot",
        },
    ),
    "train": (
        "Train the paper's CNN on tactile images, or with --input events the network on events.",
        "workflow.train",
    ),
    "convert": (
        "Train the spiking network, on images or with --input events, and write the bundle.",
        "workflow.convert",
    ),
    "adapt": (
        "Fit the readout to one person from a few labelled recordings, in a new bundle.",
        "adapt.adapt",
    ),
    "check": (
        "Run the check on a target, or compare two results.",
        {"run": "check.run", "compare": "check.compare_checks"},
    ),
    "ladder": (
        "Run the missing stages up to the emulator, and print the loss of each stage.",
        "workflow.ladder",
    ),
    "predict": (
        "Classify recordings, with or without labels: a file, a zip or a folder.",
        "predict.predict",
    ),
    "status": (
        "Show each artifact of a run: current, outdated and why, or missing.",
        "results.status",
    ),
    "compare": (
        "Compare runs: settings, accuracy of each stage, operations, cores, time to decide.",
        "results.compare_",
    ),
    "deploy": (
        "Plan the placement on the chip, export, estimate the energy.",
        {"plan": "deploy.plan", "export": "deploy.export", "energy": "deploy.energy"},
    ),
    "sweep": (
        "Compare settings by accuracy, synaptic operations, cores and steps, on held-out samples.",
        "sweep.sweep",
    ),
    "report": ("Write a run's ladder as one self-contained HTML file.", "results.report"),
    "animate": (
        "Write an animation of a sample: touch, spikes and probabilities over time.",
        "results.animate",
    ),
    "live": (
        "Draw on a sensor in the browser, watch the network decide, save the recordings.",
        "live.live",
    ),
    "settings": (
        "List every setting: its name, as --set takes it, its value, its default and its meaning.",
        "settings.settings",
    ),
}

# The groups of the list of sub-commands.
PANELS = {
    "Start here": ("data", "train", "convert", "ladder"),
    "Look": ("report", "live", "animate", "status", "settings"),
    "Measure": ("check", "predict", "compare", "sweep"),
    "Deploy": ("deploy", "adapt"),
}


def _import_verbs(name):
    """The functions of one of :data:`COMMANDS`, or of the verbs below it, each with its name."""
    load_plugins()  # the verbs have the options of their targets
    _, verb = COMMANDS[name]
    paths = {name: verb} if isinstance(verb, str) else verb
    functions = {}
    for word, path in paths.items():
        module, _, function = path.partition(".")
        functions[word] = getattr(import_module(f"pipeline.commands.{module}"), function)
    return functions


class _Deferred(TyperCommand):
    """Placeholder in the list for a verb whose modules are imported when it is chosen."""

    @cached_property
    def command(self):
        typer_app = _make_typer(self.help, add_completion=False)
        for name, verb in _import_verbs(self.name).items():
            typer_app.command(name)(convert_for_typer(verb))
        return typer.main.get_command(typer_app)  # a single command, or a group of them

    def make_context(self, *arguments, **options):
        return self.command.make_context(*arguments, **options)


def _make_typer(help_text, **options) -> typer.Typer:
    return typer.Typer(
        help=help_text,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",  # which fills paragraphs
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
        **options,
    )


def root(version: bool = typer.Option(False, "--version", help="Print the version and stop.")):
    """From event-based touch to a spiking network on Loihi."""
    if version:
        show(__version__)
        raise typer.Exit


def make_command_line() -> TyperGroup:
    """The command with its :data:`COMMANDS`, none of whose modules is imported yet."""
    command = _make_typer(root.__doc__)
    command.callback(invoke_without_command=True)(root)
    group = typer.main.get_command(command)
    assert isinstance(group, TyperGroup)  # because the root has a callback
    for panel, names in PANELS.items():
        for name in names:
            group.add_command(_Deferred(name, help=COMMANDS[name][0], rich_help_panel=panel))
    return group


def with_every_verb() -> TyperGroup:
    """:func:`make_command_line` with all verbs imported, for the documentation."""
    group = make_command_line()
    group.commands = {
        name: verb.command for name, verb in group.commands.items() if isinstance(verb, _Deferred)
    }
    return group


def run_alone(verb, name: str, arguments):
    """Run a function as a command of its own, as :func:`main` runs those of ``stmnist``."""
    typer_app = _make_typer(None, add_completion=False)
    typer_app.command()(convert_for_typer(verb))
    main(arguments, typer.main.get_command(typer_app), name)


def main(arguments=None, command=None, name: str = "stmnist"):
    """Run the command.

    Exit status 0: done; 1: a check failed; 2: wrong usage or bad input; 130: interrupted, by Ctrl-C
    or by the signal TERM.
    """
    prepare_terminal()
    handle_signals()
    try:
        with raise_at_interrupts():
            run = command or make_command_line()
            status = run(args=arguments, prog_name=name, standalone_mode=False)
        if status == INTERRUPTED:  # Typer turns an interruption into this status
            raise KeyboardInterrupt
        sys.stdout.flush()  # errors could not be reported when Python exits
    except (KeyboardInterrupt, typer.Abort):
        status = _say(INTERRUPTION, INTERRUPTED)
    except UsageError as error:
        context = error.ctx.command_path if error.ctx else "stmnist"
        problem = error.format_message().rstrip(".") or "a command is missing"
        status = _say(f"{problem} (see '{context} --help')", 2)
    except ClickException as error:
        status = _say(error.format_message(), 2)
    except CheckFailed as error:
        status = _say(str(error), 1)
    except UserError as error:
        for line in error.lines if isinstance(error, SeveralErrors) else [str(error)]:
            status = _say(line, 2)
    except (BrokenPipeError, SystemExit) as end:
        # The reader, such as head, has closed the pipe.  Typer then ends with status 1.
        if isinstance(end, SystemExit) and not isinstance(end.__context__, BrokenPipeError):
            raise
        drop_output()
        status = 0
    except (MemoryError, OSError) as error:  # not handled by any module
        status = _say(describe_error(error), 2)
    except BrokenExecutor:  # joblib's
        status = _say(KILLED_MESSAGE, 2)
    sys.exit(status or 0)


def _say(message, status):
    remark("stmnist: " + format_as_line(message))
    return status
