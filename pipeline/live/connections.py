"""Limits on connections that have not sent the token: their number and duration.

Any program on the machine can connect to the port and leave the connection open without sending
anything.  Such a connection is closed after a time limit, or when there are too many newer ones, so
that the page can always connect and the server does not run out of file descriptors.
"""

from __future__ import annotations

import asyncio
import errno

from uvicorn.protocols.http.h11_impl import H11Protocol

from deploy.terminal import remark

MOST_UNAUTHENTICATED = 32
"""Maximum number of simultaneous connections without the token: many times the number that a
browser opens for a page, and a small part of the files that a process may have open."""

UNAUTHENTICATED_S = 5.0
"""Seconds until a connection must have sent the token; a page sends it in milliseconds."""

QUIET_S = 60.0
"""Seconds between two messages that no file descriptor is left."""


class Unauthenticated:
    """The connections that have not sent the token yet, the oldest first.

    Parameters
    ----------
    most : int
        Maximum number; a further connection closes the oldest one.
    seconds : float
        Time limit for sending the token.
    """

    def __init__(self, most: int = MOST_UNAUTHENTICATED, seconds: float = UNAUTHENTICATED_S):
        self._most, self._seconds = most, seconds
        self._there = {}  # transport and timer of each address

    def __len__(self):
        return len(self._there)

    def arrived(self, transport):
        """A connection has been made; the oldest is closed if there are too many."""
        address = _address(transport.get_extra_info("peername"))
        self.left(address)
        if len(self._there) >= self._most:
            self._close(next(iter(self._there)))
        timer = asyncio.get_running_loop().call_later(self._seconds, self._close, address)
        self._there[address] = transport, timer

    def left(self, address):
        """A connection is closed, or has sent the token."""
        _, timer = self._there.pop(_address(address), (None, None))
        if timer is not None:
            timer.cancel()

    def _close(self, address):
        transport, _ = self._there[address]
        self.left(address)
        transport.abort()


def _address(pair):
    return tuple(pair)[:2] if pair else None


def protocol_of(unauthenticated: Unauthenticated):
    """Uvicorn's protocol, which reports each connection that is made or lost."""

    class Protocol(H11Protocol):
        def connection_made(self, transport):
            super().connection_made(transport)
            unauthenticated.arrived(transport)

        def connection_lost(self, exc):
            super().connection_lost(exc)
            unauthenticated.left(self.client)

    return Protocol


def say_when_files_run_out(loop, say=None):
    """Replace asyncio's traceback for each connection without a free file by one line per minute.

    Parameters
    ----------
    loop : asyncio.AbstractEventLoop
    say : callable, optional
        Called with the line; default: print it on standard error.
    """
    say = say or remark
    said_s = -QUIET_S

    def handle(loop, context):
        nonlocal said_s
        error = context.get("exception")
        if not isinstance(error, OSError) or error.errno not in (errno.EMFILE, errno.ENFILE):
            loop.default_exception_handler(context)
        elif loop.time() >= said_s + QUIET_S:
            said_s = loop.time()
            say(
                f"live: a connection has to wait ({error.strerror}); "
                "close other programs, or raise the limit with 'ulimit -n'"
            )

    loop.set_exception_handler(handle)


def is_own_error(record) -> bool:
    """A log filter that suppresses messages which do not report an error of the server.

    These are messages about text that is not UTF-8, and about pages that did not close in time
    when the server ended.
    """
    if record.exc_info and isinstance(record.exc_info[1], UnicodeDecodeError):
        return False
    return not str(record.msg).startswith("Cancel %s running task(s)")
