"""TensorFlow with Keras 2, which NengoDL 3.6 needs: the one module that chooses it.

From 2.16 on TensorFlow brings Keras 3, and takes Keras 2 from the package tf-keras if it is told so
before anybody asks it for Keras.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import sys

os.environ["TF_USE_LEGACY_KERAS"] = "1"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # a GPU that nobody asked for is no news
# XLA of 2.20 arranges a step so that parts of it could run side by side, which makes the small
# steps of these networks a tenth slower than with 2.12.  The trained weights are the same bits.
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_cpu_enable_concurrency_optimized_scheduler=false"
)

import models.hdf5  # noqa: F401  before TensorFlow imports h5py

# The import makes half a million objects and no garbage; to look for some takes a third of it.
_collects = gc.isenabled()
gc.disable()
try:
    import tensorflow as tf

    _keras = tf.keras.Model.__module__  # which imports it
finally:
    if _collects:
        gc.enable()

if not _keras.startswith("tf_keras."):
    raise ImportError(
        "TensorFlow is already in use with Keras 3 in this process; "
        "set TF_USE_LEGACY_KERAS=1 before the first import of tensorflow"
    )

# That a function is traced anew for each network is no news to the user.
tf.get_logger().setLevel("ERROR")

as_written = tf.autograph.experimental.do_not_convert
"""Decorates what has no branch or loop over tensors: to translate it for some takes longer than to
trace it."""


@contextlib.contextmanager
def silenced():
    """Nothing on standard error from below Python, where no log level reaches."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@functools.cache
def quiet_compiler():
    """Have XLA say now, unheard, what it says once a process when it first compiles something."""
    with silenced():
        tf.function(lambda x: x + 1, jit_compile=True)(tf.ones(()))


__all__ = ["as_written", "quiet_compiler", "tf"]
