"""Ctrl-C: one line and status 130 from the first moment on, and never lost.

Python raises KeyboardInterrupt in whatever runs.  In an import that is a traceback of many lines,
or an ImportError if the import is tried; in a callback of the garbage collector or of a weak
reference it is printed and dropped, and the command goes on for good.  So, in this order:

- while a command's modules are imported there is nothing to tidy up: Ctrl-C ends the process;
- then it raises KeyboardInterrupt, and if that is dropped, it is raised again;
- a second Ctrl-C ends the process at once;
- in the last moment, when Python has taken its handlers away and all is done, none is heard.
"""

import _thread
import atexit
import contextlib
import os
import signal
import sys
import threading

STATUS = 130
"""Exit status after Ctrl-C, as shells have it."""

LINE = "interrupted; the same command goes on where it stopped"

AGAIN_S = 0.05
"""Until a dropped KeyboardInterrupt is raised again: raised in the callback itself it is dropped
like the first."""


def is_ours():
    """Whether Ctrl-C reaches this process: a shell's background ignores it, a debugger takes it."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


def end_at_once(name):
    """From now on Ctrl-C ends the process; for the time of the imports.

    Parameters
    ----------
    name : str
        Of the command, the start of its line.
    """
    if is_ours():
        signal.signal(signal.SIGINT, lambda *_: _end(name))
        # Registered before all others, so it comes after them; of all handlers Python leaves this
        # one in place when it ends.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def raised(name):
    """In this block the first Ctrl-C raises KeyboardInterrupt, again if need be; a second ends.

    Parameters
    ----------
    name : str
        Of the command.
    """
    handler, hook = signal.getsignal(signal.SIGINT), sys.unraisablehook
    if handler in (signal.SIG_IGN, None):
        yield
        return
    asked = []

    def interrupt(signum, frame):
        if asked:
            _end(name)
        asked.append(signum)
        raise KeyboardInterrupt

    def again():
        asked.clear()
        _thread.interrupt_main()

    def dropped(unraisable):
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            hook(unraisable)
            return
        timer = threading.Timer(AGAIN_S, again)
        timer.daemon = True
        timer.start()

    signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = dropped
    try:
        yield
    finally:
        # What comes after the command, such as threads that are waited for, has nothing to tidy up.
        sys.unraisablehook = hook
        # Where KeyboardInterrupt passed through exec() of a text, as libraries have it, CPython
        # remembers it as one that nobody caught, and "python -m" ends by a signal whatever the
        # status is; the next text makes it forget.
        exec("")
        signal.signal(signal.SIGINT, lambda *_: _end(name))


def _end(name):
    """End this process and those that it started, with the line that an interruption has."""
    with contextlib.suppress(Exception):
        if "multiprocessing.process" in sys.modules:
            for child in list(sys.modules["multiprocessing.process"]._children):
                os.kill(child.pid, signal.SIGKILL)
    with contextlib.suppress(OSError):
        os.write(2, (name + ": " + LINE + "\n").encode())
    os._exit(STATUS)
