"""The command ``stmnist``: joins the verbs and turns errors into one line and an exit status."""

from __future__ import annotations

import os
import sys

import typer

from deploy import __version__
from deploy.errors import CheckFailed, UserError
from models.architecture import NotationError
from pipeline.commands import benchmark, check, data, live, report, run
from pipeline.commands import benchmark_conversion as _conversion  # noqa: F401 - adds to benchmark.app
from pipeline.commands import benchmark_emulator as _emulator  # noqa: F401 - adds to benchmark.app
from pipeline.commands import benchmark_live as _live  # noqa: F401 - adds to benchmark.app
from pipeline.commands import benchmark_losses as _losses  # noqa: F401 - adds to benchmark.app
from pipeline.commands import deploy as deployment
from pipeline.commands import skin as _skin  # noqa: F401 - adds its verbs to data.app
from pipeline.commands import sweep as sweeping

# Typer brings its own copy of Click from some version on: these are the classes that it raises.
UsageError = typer.BadParameter.__base__
ClickException = UsageError.__base__

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""

app = typer.Typer(
    help="From event-based touch to a spiking network on Loihi.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # which fills paragraphs
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
app.add_typer(data.app, name="data")
app.command()(run.train)
app.command()(run.convert)
app.add_typer(check.app, name="check")
app.command()(run.ladder)
app.add_typer(deployment.app, name="deploy")
app.add_typer(benchmark.app, name="benchmark")
app.command("sweep")(sweeping.sweep_)
app.command("report")(report.report_)
app.command("live")(live.live)


@app.callback(invoke_without_command=True)
def root(
    version: bool = typer.Option(False, "--version", help="Print the version and stop."),
):
    """From event-based touch to a spiking network on Loihi."""
    if version:
        print(__version__)
        raise typer.Exit


def main(arguments=None):
    """Run the command; the entry point of the script ``stmnist``.

    Exit status 0: done; 1: a check failed; 2: wrong usage or bad input; 130: interrupted.
    """
    try:
        status = app(args=arguments, prog_name="stmnist", standalone_mode=False)
        if status == INTERRUPTED:  # Typer turns an interruption into this status
            raise KeyboardInterrupt
    except (KeyboardInterrupt, typer.Abort):
        status = _say("interrupted; the same command goes on where it stopped", INTERRUPTED)
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
    except BrokenPipeError:  # the reader, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 0
    except OSError as error:  # what no module foresaw: a full disk, a folder that may not be read
        where = f"{error.filename}: " if error.filename else ""
        status = _say(f"{where}{error.strerror or error}; check the path and its permissions", 2)
    sys.exit(status or 0)


def _say(message, status):
    print("stmnist: " + " ".join(message.split()), file=sys.stderr)
    return status


if __name__ == "__main__":
    main()
