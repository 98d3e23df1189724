"""``python -m pipeline``, and the command ``stmnist``: what must stand before the imports."""

import os

from deploy import interrupts

QUIET = "ignore:resource_tracker:UserWarning"
"""joblib's process that tidies up after workers tells of what an interruption left to it, after the
command's last line."""


def main():
    """Import the command, which takes a second, and run it."""
    interrupts.end_at_once("stmnist")
    filters = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = f"{filters},{QUIET}" if filters else QUIET
    from pipeline.commands.main import main as command
    from pipeline.temporary import own_folder

    with interrupts.raised("stmnist"), own_folder():
        command()


if __name__ == "__main__":
    main()
