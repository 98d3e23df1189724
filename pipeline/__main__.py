"""``python -m pipeline``, and the command ``stmnist``: what must stand before the imports."""

from deploy import interrupts


def main():
    """Import the command, which takes a second, and run it."""
    interrupts.end_at_once("stmnist")
    from pipeline.commands.main import main as command
    from pipeline.temporary import own_folder

    with interrupts.raised("stmnist"), own_folder():
        command()


if __name__ == "__main__":
    main()
