"""``python -m pipeline``, and the command ``stmnist``: steps that must precede the imports."""

import gc
import os
import sys
import threading

from deploy import children, interrupts
from deploy.terminal import prepare, remark

QUIET = "ignore:resource_tracker:UserWarning"
"""Suppresses a message about an interruption that joblib's resource tracker prints after the last
line of the command."""


def report_thread_errors():
    """Report errors of threads, except a harmless one of joblib when its jobs are cancelled.

    A thread of joblib looks up jobs that it has just removed (a KeyError; loky 3.6), and ends, as
    intended.
    """
    hook = threading.excepthook

    def report(told):
        if told.exc_type is not KeyError or told.thread.name != "ExecutorManagerThread":
            hook(told)

    threading.excepthook = report


def main():
    """Import the command, which takes up to a second, and run it."""
    interrupts.end_at_once("stmnist")
    prepare()
    children.end_with_named_parent()
    try:
        os.getcwd()
    except OSError as error:  # libraries need it while they are imported
        where = "stmnist: the current folder"
        remark(f"{where}: {error.strerror}; change to a folder that exists (cd)")
        sys.exit(2)
    report_thread_errors()
    filters = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = f"{filters},{QUIET}" if filters else QUIET
    from pipeline.commands.main import main as command
    from pipeline.temporary import own_folder

    with own_folder():
        try:
            command()
        finally:
            # Skips the garbage collection when Python exits: with TensorFlow most of a second.
            gc.freeze()


if __name__ == "__main__":
    main()
