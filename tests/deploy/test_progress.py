"""Progress as lines, where a bar cannot be drawn."""

import pytest

from deploy.progress import LINES, MIN_SECONDS, ProgressLines


@pytest.mark.parametrize(
    ("seconds_a_unit", "lines"), [(0.001, 0), (2 * MIN_SECONDS, LINES - 1), (0.3, 2)]
)
def test_a_long_step_has_a_line_each_tenth_and_a_short_one_none(capsys, seconds_a_unit, lines):
    now = 0.0
    progress = ProgressLines("train", 100, clock=lambda: now)
    for _ in range(100):
        now += seconds_a_unit
        progress.advance(1, "accuracy 0.5")
    told = capsys.readouterr().err.splitlines()
    assert len(told) == lines
    assert all(line.startswith("train accuracy 0.5: ") for line in told)


def test_the_estimate_leaves_out_the_first_unit_in_which_something_is_compiled(capsys):
    now = 0.0
    progress = ProgressLines("train events", 40, "epochs", lambda: now)
    for seconds in (300, *(7 * [10])):
        now += seconds
        progress.advance()
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "train events: 8 of 40 epochs after 370 s, about 320 s left"


def test_the_estimate_leaves_out_what_an_earlier_session_has_done(capsys):
    now = 0.0
    progress = ProgressLines("train events", 40, "epochs", lambda: now)
    progress.advance(30)
    for _ in range(2):
        now += 100.0
        progress.advance()
    assert "about 800 s left" in capsys.readouterr().err


def test_a_short_time_gives_no_estimate(capsys):
    now = 0.0
    progress = ProgressLines("check", 600, clock=lambda: now)
    for seconds in (78, *(59 * [0.05])):
        now += seconds
        progress.advance()
    assert capsys.readouterr().err == "check: 60 of 600 samples after 81 s\n"


def test_the_estimate_leaves_out_the_time_before_the_first_units(capsys):
    now = 0.0
    progress = ProgressLines("check", 10, clock=lambda: now)
    progress.advance(0, "cnn-matched")
    for seconds in (300, *(6 * [5])):
        now += seconds
        progress.advance(1, "emulator")
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "check emulator: 6 of 10 samples after 325 s, about 20 s left"
