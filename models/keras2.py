"""TensorFlow with Keras 2, which NengoDL 3.6 needs: the one module that chooses it.

From 2.16 on TensorFlow brings Keras 3, and takes Keras 2 from the package tf-keras if it is told so
before anybody asks it for Keras.
"""

from __future__ import annotations

import os

os.environ["TF_USE_LEGACY_KERAS"] = "1"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # a GPU that nobody asked for is no news

import tensorflow as tf

if not tf.keras.Model.__module__.startswith("tf_keras."):
    raise ImportError(
        "TensorFlow is already in use with Keras 3 in this process; "
        "set TF_USE_LEGACY_KERAS=1 before the first import of tensorflow"
    )

# That a function is traced anew for each network is no news to the user.
tf.get_logger().setLevel("ERROR")

__all__ = ["tf"]
