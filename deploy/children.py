"""Processes that end with the one that started them, however that one ends.

What is killed cannot end its children.  So a child watches its parent: the kernel tells when that
process is gone (pidfd_open(2), Linux 5.3).  PR_SET_PDEATHSIG is no substitute: it tells of the
thread that started the child, and workers are started by threads that come and go.
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time

PARENT = "STMNIST_PARENT"
"""Variable of the environment in which a process that starts one of ours can name itself."""

LOOK_S = 1.0
"""Between two looks at the parent, where the kernel does not tell (or Python is 3.8)."""


def end_with(parent: int):
    """End this process when its parent ends; at once if it has ended already.

    Parameters
    ----------
    parent : int
        Its process id, as it knows it itself: the child might ask too late.
    """
    try:
        told = os.pidfd_open(parent)
    except (AttributeError, OSError):
        told = None
    if os.getppid() != parent:
        _end()
    threading.Thread(target=_watch, args=(parent, told), name="parent", daemon=True).start()


def end_with_named_parent():
    """:func:`end_with` the process that named itself in the environment, if one has."""
    named = os.environ.pop(PARENT, "")
    if named.isascii() and named.isdigit():
        end_with(int(named))


def _watch(parent, told):
    if told is not None:
        watch = select.poll()
        watch.register(told, select.POLLIN)
        watch.poll()  # until the process has ended
    else:
        while os.getppid() == parent:
            time.sleep(LOOK_S)
    _end()


def _end():
    os.kill(os.getpid(), signal.SIGKILL)
