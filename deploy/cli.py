"""The command line of ``deploy.pyz``: the check, where only NengoLoihi is installed."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from . import __version__
from .check.bundle import find_result_path, read_bundle
from .check.run import run_check
from .check.text import format_result
from .errors import CheckFailed, UserError, describe_error, format_as_line
from .plugins import load_plugins
from .preflight.plan import format_plan, make_plan
from .progress import ProgressLines
from .targets.board import find_nxsdk_version
from .targets.options import format_flag
from .targets.registry import TARGETS, list_options, select_options
from .terminal import INTERRUPTED, INTERRUPTION, drop_output, prepare_terminal, remark, show


def main(arguments=None) -> int:
    """Run the command.

    Returns
    -------
    int
        0 done, 1 a check failed, 2 wrong usage or bad input, 130 interrupted.
    """
    prepare_terminal()
    try:
        load_plugins()
        options = _make_parser().parse_args(arguments)
        options.run(options)
        sys.stdout.flush()  # errors could not be reported when Python exits
        return 0
    except CheckFailed as error:
        return _say(describe_error(error), 1)
    except BrokenPipeError:  # the reader, such as head, has closed the pipe
        drop_output()
        return 0
    except (UserError, MemoryError, OSError) as error:
        return _say(describe_error(error), 2)
    except KeyboardInterrupt:
        return _say(INTERRUPTION, INTERRUPTED)


def _say(message, status):
    remark("deploy: " + format_as_line(message))
    return status


def _make_parser():
    parser = argparse.ArgumentParser(
        prog="deploy.pyz", description="Run a bundle's check where only NengoLoihi is installed."
    )
    parser.add_argument("--version", action="version", version=__version__)
    verbs = parser.add_subparsers(metavar="COMMAND")
    parser.set_defaults(run=lambda _: parser.error("name a command: check, plan or board"))
    check = verbs.add_parser("check", help="run a target on the bundle's samples")
    check.add_argument("bundle", type=Path, help="the bundle's folder")
    check.add_argument("--target", required=True, metavar="T", help=", ".join(TARGETS))
    check.add_argument("--out", type=Path, help="the result (default: BUNDLE/checks/TARGET.json)")
    check.add_argument("--seed", type=int, metavar="N", help="the simulator's (default: the run's)")
    _add_target_options(check)
    check.set_defaults(run=_check)
    plan = verbs.add_parser(
        "plan", help="resources that the network needs on each core, and whether it fits"
    )
    plan.add_argument("bundle", type=Path, help="the bundle's folder")
    plan.add_argument("--chips", type=int, default=1, metavar="N", help="number of chips")
    plan.set_defaults(run=_plan)
    board = verbs.add_parser("board", help="report whether this host can use a board")
    board.set_defaults(
        run=lambda _: show(f"NxSDK {find_nxsdk_version()}: target loihi can be used")
    )
    return parser


def _add_target_options(parser):
    groups = {}
    for name, (target, option) in list_options().items():
        if target not in groups:
            groups[target] = parser.add_argument_group(f"target {target}")
        keywords = {"default": option.default, "help": option.metadata["help"]}
        if option.default is False:
            keywords["action"] = "store_true"
        elif option.default is not None:
            keywords["type"] = type(option.default)
            keywords["help"] += " (default: %(default)s)"
        groups[target].add_argument(format_flag(name), **keywords)


def _check(options):
    values = {name: getattr(options, name) for name in list_options()}
    chosen = select_options(options.target, **values)
    bundle = read_bundle(options.bundle)
    out = options.out or find_result_path(options.bundle, options.target)
    total = len(bundle.checks)
    lines = ProgressLines(f"check {options.target}", total)
    done = 0

    def advance(n):
        nonlocal done
        done += n
        if sys.stderr.isatty():
            print(f"\r{options.target}: {done} of {total} samples", end="", file=sys.stderr)
        else:
            lines.advance(n)

    result = run_check(bundle, options.target, out, options.seed, advance, chosen)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    show(format_result(result))
    show(f"written to {out}")


def _plan(options):
    plan = make_plan(read_bundle(options.bundle).spec, options.chips)
    show(format_plan(plan))
    if plan.problems:
        raise UserError("the network does not fit: " + plan.problems[0])
