"""Interruptions by Ctrl-C or the signal TERM, also where Python or native code drops them."""

import contextlib
import signal
import sys
import threading
from functools import partial

# Numbers of the signals that have interrupted this process.
_seen: list[int] = []


def handle_signals():
    """Interrupt this process by TERM as by Ctrl-C, which ends its workers too."""
    _seen.clear()
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = partial(_interrupt_again, sys.unraisablehook)


@contextlib.contextmanager
def raise_at_interrupts():
    """Raise `KeyboardInterrupt` if native code, such as TensorFlow's, has raised another error.

    Only an error after an interruption of this process counts.
    """
    try:
        yield
    except Exception as error:
        if _seen:
            raise KeyboardInterrupt from error
        raise


def _interrupt(number, frame):
    _seen.append(number)
    signal.default_int_handler(number, frame)


def _interrupt_again(otherwise, dropped):
    """Python drops a Ctrl-C that comes in a destructor, such as those of TensorFlow: repeat it."""
    if dropped.exc_type is KeyboardInterrupt:
        # It comes in the main thread only, which is therefore this one.  SIGINT may be ignored.
        threading.Timer(0.01, signal.pthread_kill, (threading.get_ident(), signal.SIGTERM)).start()
    else:
        otherwise(dropped)
