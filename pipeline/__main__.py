"""``python -m pipeline``, and the command ``stmnist``."""

import gc
import sys

from deploy.terminal import INTERRUPTED, INTERRUPTION, remark


def main():
    """Import the command, which takes up to a second, and run it."""
    try:
        from pipeline.commands.main import main as command

        command()
    except KeyboardInterrupt:
        remark("stmnist: " + INTERRUPTION)
        sys.exit(INTERRUPTED)
    finally:
        # Skips the garbage collection when Python exits: with TensorFlow most of a second.
        gc.freeze()


if __name__ == "__main__":
    main()
