"""Printing that is safe for terminals, and the exit status of a command.

Names from files may contain control sequences of terminals, or characters that the terminal's
encoding cannot represent.
"""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import sys

# Exit status after Ctrl-C, as shells have it.
INTERRUPTED = 130

# The line that is printed after Ctrl-C.
INTERRUPTION = "interrupted: finished results are kept; repeat the command to continue"


def escape_control(text) -> str:
    """Text as one line, in which control sequences of terminals and line ends are escaped."""
    text = str(text)
    if text.isprintable():  # fast for the usual text
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def format_command(*words) -> str:
    """A command of ``stmnist`` for a message; in quotation marks, unless it has its own."""
    command = shlex.join(["stmnist", *map(str, words)])
    return command if "'" in command else f"'{command}'"


# Beginning of a warning.
WARNING = "warning: "

# End of a line with a statistically significant difference.
SIGNIFICANT = " *"


def show(text="", flush=False, marked=""):
    """Print a result on standard output, with :func:`escape_control` for each line.

    Parameters
    ----------
    text : str
    flush : bool
    marked : str
        A word that a terminal shows in colour, unless ``NO_COLOR`` is set.
    """
    text = _escape_lines(text)
    if marked and sys.stdout.isatty() and not os.environ.get("NO_COLOR"):
        text = text.replace(marked, f"\x1b[33m{marked}\x1b[0m")
    print(text, flush=flush)


def remark(text):
    """Print a message on standard error, with :func:`escape_control` for each line."""
    print(_escape_lines(text), file=sys.stderr)


def _escape_lines(text):
    return "\n".join(map(escape_control, str(text).split("\n")))


def prepare_terminal():
    """Print characters that the terminal's encoding cannot represent as escapes."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, io.UnsupportedOperation):
            stream.reconfigure(errors="backslashreplace")


def drop_output():
    """Discard what is printed from now on, after the reader, such as ``head``, has ended.

    Otherwise Python would try to write it when it ends, and print an error.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def silence_native_errors():
    """Suppress standard error of native code, which neither levels of logs nor Python control."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
