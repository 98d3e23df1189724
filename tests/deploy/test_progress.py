"""Progress as lines, where a bar cannot be drawn."""

import pytest

from deploy.progress import LINES, MIN_SECONDS, ProgressLines


@pytest.mark.parametrize(
    ("seconds_a_unit", "lines"), [(0.001, 0), (2 * MIN_SECONDS, LINES - 1), (0.3, 2)]
)
def test_a_long_step_has_a_line_each_tenth_and_a_short_one_none(capsys, seconds_a_unit, lines):
    now = 0.0
    progress = ProgressLines("train", 100, lambda: now)
    for _ in range(100):
        now += seconds_a_unit
        progress.advance(1, "accuracy 0.5")
    told = capsys.readouterr().err.splitlines()
    assert len(told) == lines
    assert all(line.startswith("train accuracy 0.5: ") for line in told)
