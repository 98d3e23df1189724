"""Ctrl-C ends the process at once: one line, status 130, no remaining child or temporary file.

Results are written under a temporary name and renamed, so a process that is killed at any moment
loses nothing, and needs no cleaning up.  (A KeyboardInterrupt would have to pass through the
libraries, which may print and drop it in a callback or mistake it for a failed import.)  Only code
that uses a board or serves the page needs an orderly end; see :func:`orderly`.
"""

import atexit
import contextlib
import os
import signal
import sys

STATUS = 130
"""Exit status after Ctrl-C, as shells have it."""

LINE = "interrupted; the same command continues where it stopped"

_AT_THE_END = []


class _End:
    """The handler that ends the process."""

    def __init__(self, name):
        self._line = (name + ": " + LINE + "\n").encode()
        try:
            self._stderr = os.dup(2)  # libraries are silenced by redirecting 2
        except OSError:
            self._stderr = 2

    def __call__(self, *_):
        # Joblib's processes belong to multiprocessing too.
        for child in list(getattr(sys.modules.get("multiprocessing.process"), "_children", ())):
            with contextlib.suppress(Exception):
                os.kill(child.pid, signal.SIGKILL)
                os.waitpid(child.pid, 0)
        for function, arguments in _AT_THE_END[:]:
            with contextlib.suppress(Exception):
                function(*arguments)
        with contextlib.suppress(OSError):
            os.write(self._stderr, self._line)
        os._exit(STATUS)


def end_at_once(name):
    """Make Ctrl-C end the process, unless the shell started it in the background.

    Parameters
    ----------
    name : str
        Name of the command, at the start of the printed line.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _End(name))
        # Registered first, so that it runs last: Ctrl-C is then ignored while Python removes its
        # signal handlers.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def at_the_end(function, *arguments):
    """Call a function if Ctrl-C ends the process in this block, to remove files for example."""
    call = (function, arguments)
    _AT_THE_END.append(call)
    try:
        yield
    finally:
        _AT_THE_END.remove(call)


@contextlib.contextmanager
def orderly():
    """In this block the first Ctrl-C raises KeyboardInterrupt; a second one ends the process."""
    end = signal.getsignal(signal.SIGINT)
    if not isinstance(end, _End):
        yield
        return

    def interrupt(*_):
        signal.signal(signal.SIGINT, end)
        raise KeyboardInterrupt

    try:
        signal.signal(signal.SIGINT, interrupt)
    except ValueError:  # not the main thread, which alone has handlers
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, end)
