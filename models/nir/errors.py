"""The error of what cannot be used in a NIR graph."""

from deploy.errors import UserError


class NirError(UserError):
    """A file or graph is not NIR, or has parts that cannot be used; the message is one line."""


def quote(text) -> str:
    """Text from a file for a message: quoted, on one line, and shortened."""
    text = repr(str(text)[:60])
    return text if len(text) <= 80 else text[:77] + "...'"
