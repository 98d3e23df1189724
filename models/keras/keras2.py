"""Import TensorFlow with Keras 2, which NengoDL 3.6 needs; no other module imports TensorFlow.

TensorFlow 2.16 and later use Keras 3 by default.  They use Keras 2 from the package tf-keras if
TF_USE_LEGACY_KERAS is set before the first access to ``tf.keras``.
"""

import functools
import gc
import os

from deploy.terminal import silence_native_errors

os.environ["TF_USE_LEGACY_KERAS"] = "1"
# No plug-ins for HDF5, which TensorFlow before 2.21 searches for (CVE-2026-2492).
os.environ["HDF5_PLUGIN_PRELOAD"] = "::"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # no messages about missing GPUs
# Each operation in one thread.  The operations of these networks take microseconds, and to share
# them takes longer.  It also changes the rounding of sums, so that trained weights would depend on
# the number of cores.
os.environ.setdefault("TF_NUM_INTRAOP_THREADS", "1")
# The scheduler of XLA 2.20 optimises for concurrency, which makes the small steps of these networks
# 10 % slower than with 2.12.  The trained weights are bit-identical.
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_cpu_enable_concurrency_optimized_scheduler=false"
)

# The import creates half a million objects and no garbage; garbage collection would take a third
# of its time.
_collects = gc.isenabled()
gc.disable()
try:
    import tensorflow as tf

    _keras = tf.keras.Model.__module__  # this access imports Keras
finally:
    if _collects:
        gc.enable()

if not _keras.startswith("tf_keras."):
    raise ImportError(
        "TensorFlow is already in use with Keras 3 in this process; "
        "set TF_USE_LEGACY_KERAS=1 before the first import of tensorflow"
    )

# Suppresses warnings about retracing: every network is traced anew.
tf.get_logger().setLevel("ERROR")

# Decorator for functions without branches or loops over tensors: it skips AutoGraph's conversion,
# which takes longer than tracing.
as_written = tf.autograph.experimental.do_not_convert


@functools.cache
def quiet_compiler():
    """Trigger the message that XLA prints once per process, at its first compilation, silently."""
    with silence_native_errors():
        tf.function(lambda x: x + 1, jit_compile=True)(tf.ones(()))


__all__ = ["as_written", "quiet_compiler", "tf"]
