"""The two ways in which a command ends without success."""


class UserError(Exception):
    """A mistake of the user's, or bad input: one clear line, exit status 2.

    The message says what is wrong, where (the file or setting) and what to do about it.
    """


class CheckFailed(Exception):
    """A check was carried out and did not pass: exit status 1."""
