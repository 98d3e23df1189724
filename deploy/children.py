"""Child processes that end when their parent process ends, for any reason.

A process that is killed cannot end its children.  Therefore each child watches its parent: the
kernel reports the end of the parent (pidfd_open(2), Linux 5.3).  PR_SET_PDEATHSIG is no substitute,
because it reports the end of the thread that started the child, which may end earlier.
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time

PARENT = "STMNIST_PARENT"
"""Environment variable with the id of a process that starts one of ours."""

LOOK_S = 1.0
"""Seconds between two checks of the parent, if the kernel does not report its end."""


def end_with(parent: int):
    """End this process when its parent ends; at once if it has ended already.

    Parameters
    ----------
    parent : int
        Process id of the parent.  The parent passes it on, because it may end before a child asks.
    """
    try:
        told = os.pidfd_open(parent)
    except (AttributeError, OSError):
        told = None
    if os.getppid() != parent:
        _end()
    threading.Thread(target=_watch, args=(parent, told), name="parent", daemon=True).start()


def end_with_named_parent():
    """Call :func:`end_with` for the process whose id is in the environment, if there is one."""
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
