"""Set the number of TensorFlow's threads before it computes anything."""

from __future__ import annotations

import os


def one_thread_each():
    """Run each TensorFlow operation of this process in one thread.

    A training step on images is a few hundred operations of some microseconds; distributing them
    over threads takes longer than computing them.  It also changes the rounding of sums, so that
    the trained weights would depend on the number of cores.  ``TF_NUM_INTRAOP_THREADS`` in the
    environment overrides this.
    """
    os.environ.setdefault("TF_NUM_INTRAOP_THREADS", "1")
