"""Checks that are interrupted, and results that are held against each other."""

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
    differ = {"wall_seconds"}
    assert {k: v for k, v in a.items() if k not in differ} == {
        k: v for k, v in b.items() if k not in differ
    }
