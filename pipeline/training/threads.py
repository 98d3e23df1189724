"""How many threads TensorFlow computes with: chosen before it computes anything."""

from __future__ import annotations

import os


def one_thread_each():
    """Let each operation compute in one thread, from where TensorFlow begins in this process on.

    A step of training on images is a few hundred operations of some microseconds, which take longer
    to share than to do; and how a sum is shared changes its last digit, so that a network ends with
    the same weights on any number of cores only if it is not.  ``TF_NUM_INTRAOP_THREADS`` in the
    environment says otherwise.
    """
    os.environ.setdefault("TF_NUM_INTRAOP_THREADS", "1")
