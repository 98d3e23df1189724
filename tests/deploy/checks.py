"""Checks that are interrupted, and results that are held against each other."""

from dataclasses import replace

import pytest

from deploy.check.run import run_check


def partial(out):
    """Where the streams of a check are saved until all are there."""
    return out.with_name(f".{out.name}.partial")


def interrupted(bundle, out, after, target="emulator"):
    """Run a check that is interrupted after some streams."""
    told = []

    def advance(n):
        told.append(n)
        if len(told) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_check(bundle, target, out, advance=advance)
    assert not out.exists()
    return partial(out)


def same_answers(a, b):
    """Two results say the same but for the time that they took."""
    assert replace(a, wall_seconds=1.0) == replace(b, wall_seconds=1.0)
