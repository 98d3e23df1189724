"""Printing that is safe for the terminal and never makes a command fail.

Names that come from files may hold what a terminal obeys, or what its encoding cannot represent;
standard output and error may be closed or full.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys

COLUMNS = (20, 1000)
"""Widths of a terminal that are believed.  At a width of 0 a help text is empty, and at a thousand
million it takes 20 s."""


def printable(text) -> str:
    """Text in one line, in which whatever a terminal would obey, line ends too, is escaped."""
    text = str(text)
    if text.isprintable():  # as nearly all is, however long
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


ERRORS = ("stmnist: ", "deploy: ", "does not fit: ")
"""Beginnings of lines that are shown in red at a terminal."""

WARNING = "warning: "
"""Beginning of a line that is shown in yellow; a name and a colon may stand before it."""

SIGNIFICANT = " *"
"""End of a line with a statistically significant difference, which is shown in bold."""


def show(text="", flush=False):
    """Print an answer on standard output, each of its lines :func:`printable`."""
    print(_lines(text, sys.stdout), flush=flush)


def remark(text):
    """Print what happens on standard error, each line :func:`printable`."""
    print(_lines(text, sys.stderr), file=sys.stderr)


def has_colours(stream) -> bool:
    """True if a stream is a terminal that shows colours, and the user wants them.

    ``NO_COLOR`` (https://no-color.org) and ``TERM=dumb`` switch them off.
    """
    with contextlib.suppress(AttributeError, ValueError, OSError):
        wanted = not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
        return wanted and stream.isatty()
    return False


def _lines(text, stream):
    lines = map(printable, str(text).split("\n"))
    return "\n".join(map(_coloured, lines) if has_colours(stream) else lines)


def _coloured(line):
    """A line with the escape sequences of its colour, by its beginning and end."""
    if line.startswith(ERRORS):
        return f"\x1b[31m{line}\x1b[0m"
    if line.startswith(WARNING) or f": {WARNING}" in line:
        return f"\x1b[33m{line}\x1b[0m"
    return f"\x1b[1m{line}\x1b[0m" if line.endswith(SIGNIFICANT) else line


def prepare():
    """Make the standard streams fit for whatever is printed; called before anything else.

    A stream that is closed is opened to nowhere: otherwise the next file that is opened would take
    its place, and be printed into.
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
    """Drop what was printed and cannot be written, its reader gone or the disk full.

    Python would try it again at its end, and complain.
    """
    try:
        sys.stdout.flush()
    except OSError:
        _to_nowhere(sys.stdout.fileno())


class _StandardError(io.TextIOWrapper):
    """Standard error that nobody has to read: what cannot be written is dropped."""

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
    """Let an open file's number lead nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
