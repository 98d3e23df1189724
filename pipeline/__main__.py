"""``python -m pipeline``, and the command ``stmnist``."""

import gc
import os

from deploy.terminal import INTERRUPTED, INTERRUPTION, remark


def main():
    """Import the command, which takes up to a second, and run it."""
    try:
        from pipeline.commands.main import main as command

        command()
    except KeyboardInterrupt:
        remark("stmnist: " + INTERRUPTION)
        # Not sys.exit: if a C extension was being imported, Python would end by the signal instead.
        os._exit(INTERRUPTED)
    finally:
        # Skips the garbage collection when Python exits: with TensorFlow most of a second.
        gc.freeze()


if __name__ == "__main__":
    main()
