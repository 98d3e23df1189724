"""Errors that end a command, each with a message of one line."""

from .terminal import escape_control

# Maximum number of characters of an error message, which may quote the content of a file.
MAX_LINE_LENGTH = 2400

# The message if a worker process ended without an answer.
KILLED_MESSAGE = "a process was killed, perhaps for lack of memory; use fewer --jobs"


def format_as_line(message) -> str:
    """Format a message as one line that is safe to print.

    The name or content of a file may contain line ends and control sequences of terminals.  The
    middle of a message that is too long is left out, because the remedy is at the end.
    """
    line = escape_control(" ".join(str(message).split()))
    if len(line) > MAX_LINE_LENGTH:
        line = line[: MAX_LINE_LENGTH * 3 // 4] + " ... " + line[-MAX_LINE_LENGTH // 4 :]
    return line


def shorten_error(error, limit: int) -> str:
    """The message of another package's exception in one line, without what exceeds the limit.

    Parameters
    ----------
    error : Exception or str
    limit : int
        Maximum number of characters.
    """
    return " ".join(str(error).split())[:limit]


class UserError(Exception):
    """A user's mistake or bad input: one clear line, exit status 2.

    The message says what is wrong, where (the file or setting) and what to do about it.
    """


class SeveralErrors(UserError):
    """Mistakes that are reported together: a clear line for each kind.

    Parameters
    ----------
    lines : sequence of str
        At least one.
    """

    def __init__(self, lines):
        self.lines = tuple(lines)
        super().__init__("; ".join(self.lines))


class CheckFailed(Exception):
    """A check was carried out and did not pass: exit status 1."""


def describe_error(error) -> str:
    """The line for an exception: its message, with a remedy for errors that no module handles.

    Parameters
    ----------
    error : UserError, CheckFailed, MemoryError or OSError
    """
    if isinstance(error, MemoryError):
        return "not enough memory for this; ask for less, or close other programs"
    if isinstance(error, OSError):  # a full disk, a folder that may not be read
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; check the path and its permissions"
    return str(error)
