"""Printing that is safe for terminals and does not make a command fail.

Names from files may contain control sequences of terminals, or characters that the terminal's
encoding cannot represent; standard output and standard error may be closed or full.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys

COLUMNS = (20, 1000)
"""Accepted widths of a terminal.  At a width of 0 a help text is empty, and at 10^9 it
takes 20 s."""


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
    with contextlib.suppress(AttributeError, ValueError, OSError):
        wanted = not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
        return wanted and stream.isatty()
    return False


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
    """Prepare the standard streams for printing; called before anything else.

    A closed stream is redirected to the null device.  Otherwise the next file that is opened would
    get its number, and messages would be written into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)  # noqa: SIM115
    if sys.stderr is None or (
        type(sys.stderr) is io.TextIOWrapper and sys.stderr is sys.__stderr__
    ):
        encoding = getattr(sys.stderr, "encoding", None)
        buffer = open(2, "wb", closefd=False)  # noqa: SIM115
        sys.stderr = sys.__stderr__ = _StandardError(buffer, encoding)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, io.UnsupportedOperation):
            stream.reconfigure(errors="backslashreplace")
    width = os.environ.get("COLUMNS", "")
    if width and not (
        width.isascii() and width.isdigit() and COLUMNS[0] <= int(width[:9]) <= COLUMNS[1]
    ):
        del os.environ["COLUMNS"]


def drop_unwritable():
    """Discard printed text that cannot be written: its reader has ended or the disk is full.

    Otherwise Python would try to write it when it ends, and print an error.
    """
    try:
        sys.stdout.flush()
    except OSError:
        _to_nowhere(sys.stdout.fileno())


class _StandardError(io.TextIOWrapper):
    """Standard error that discards text that cannot be written."""

    def __init__(self, buffer, encoding):
        super().__init__(buffer, encoding, errors="backslashreplace", line_buffering=True)

    def write(self, text):
        try:
            return super().write(text)
        except OSError:
            _to_nowhere(self.fileno())
            return len(text)

    def flush(self):
        try:
            super().flush()
        except OSError:
            _to_nowhere(self.fileno())
            super().flush()


def _to_nowhere(number):
    """Redirect the number of an open file to the null device."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
