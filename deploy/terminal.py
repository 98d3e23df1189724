"""Printing that is safe for terminals, and the exit status of a command.

Names from files may contain control sequences of terminals, or characters that the terminal's
encoding cannot represent.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""

INTERRUPTION = "interrupted; the same command continues where it stopped"
"""The line that is printed after Ctrl-C."""


def printable(text) -> str:
    """Text as one line, in which control sequences of terminals and line ends are escaped."""
    text = str(text)
    if text.isprintable():  # fast for the usual text
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


ERRORS = ("stmnist: ", "deploy: ", "does not fit: ")
"""Beginnings of lines that are printed in red at a terminal."""

WARNING = "warning: "
"""Beginning of a line that is printed in yellow; a name and a colon may precede it."""

SIGNIFICANT = " *"
"""End of a line with a statistically significant difference, which is printed in bold."""


def show(text="", flush=False):
    """Print a result on standard output, with :func:`printable` for each line."""
    print(_lines(text, sys.stdout), flush=flush)


def remark(text):
    """Print a message on standard error, with :func:`printable` for each line."""
    print(_lines(text, sys.stderr), file=sys.stderr)


def has_colours(stream) -> bool:
    """True if a stream is a terminal with colours that the user has not disabled.

    ``NO_COLOR`` (https://no-color.org) and ``TERM=dumb`` disable them.
    """
    wanted = not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    return wanted and stream.isatty()


def _lines(text, stream):
    lines = map(printable, str(text).split("\n"))
    return "\n".join(map(_coloured, lines) if has_colours(stream) else lines)


def _coloured(line):
    """A line with escape sequences for its colour, which depends on its beginning and end."""
    if line.startswith(ERRORS):
        return f"\x1b[31m{line}\x1b[0m"
    if line.startswith(WARNING) or f": {WARNING}" in line:
        return f"\x1b[33m{line}\x1b[0m"
    return f"\x1b[1m{line}\x1b[0m" if line.endswith(SIGNIFICANT) else line


def prepare():
    """Print characters that the terminal's encoding cannot represent as escapes."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, io.UnsupportedOperation):
            stream.reconfigure(errors="backslashreplace")


def drop_output():
    """Discard what is printed from now on, after the reader, such as ``head``, has ended.

    Otherwise Python would try to write it when it ends, and print an error.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
