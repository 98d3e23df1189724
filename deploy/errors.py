"""The two ways in which a command ends without success."""

LONGEST = 2400
"""Characters of an error's line; one file's content must not fill the screen."""


def one_line(message) -> str:
    """A message as one line that a terminal shows as it is.

    A file's name or content may hold line ends, and what a terminal would obey; of a message that
    is too long the middle is left out, for the remedy is at the end.
    """
    line = " ".join(str(message).split())
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(line) > LONGEST:
        line = line[: LONGEST * 3 // 4] + " ... " + line[-LONGEST // 4 :]
    return line


class UserError(Exception):
    """A mistake of the user's, or bad input: one clear line, exit status 2.

    The message says what is wrong, where (the file or setting) and what to do about it.
    """


class CheckFailed(Exception):
    """A check was carried out and did not pass: exit status 1."""
