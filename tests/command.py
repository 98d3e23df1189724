"""Ways to run the command ``stmnist``."""

import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def call(*arguments) -> int:
    """Run it in this process and return its exit status; ``capsys`` has what it printed."""
    from pipeline.commands.main import main

    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        return int(end.code or 0)
    raise AssertionError("the command ended without an exit status")


def environment(**more) -> dict:
    """For a process of its own that imports this repository's packages."""
    return {**os.environ, "PYTHONPATH": str(ROOT), **more}


def start(*arguments, **options) -> subprocess.Popen:
    """Start it as a process of its own, in a group of its own.

    Ctrl-C reaches it even if these tests run in a shell's background, where it is ignored.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "pipeline", *map(str, arguments)],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )
