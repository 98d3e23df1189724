"""TensorFlow as it is written, for what is computed only a few times."""

import contextlib

from models.keras.keras2 import tf


@contextlib.contextmanager
def untraced():
    """Nothing is compiled within: to trace a network takes longer than a dozen of its steps."""
    tf.config.run_functions_eagerly(True)
    try:
        yield
    finally:
        tf.config.run_functions_eagerly(False)
