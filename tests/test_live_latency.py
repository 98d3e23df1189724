"""How soon a decision is on the screen: the hands, and the measurement from end to end."""

import re
import shutil

import numpy as np
import pytest

from tests import robot
from tools.live_latency import hands, latency_text, measure_latency


def test_hands_are_drawn_from_the_seed():
    first, again, other = (list(hands(3, seed)) for seed in (0, 0, 1))
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a.right, b.right)
        assert not np.array_equal(a.right, c.right)


def test_what_was_measured_in_a_line():
    measured = {"median_ms": 12.4, "ninetieth_percentile_ms": 29.6, "decisions": 7, "digits": 2}
    assert re.findall(r"\d+", latency_text(measured)) == ["12", "30", "90", "7", "2"]


@pytest.mark.skipif(not any(map(shutil.which, robot.BROWSERS)), reason="no Chromium here")
def test_one_digit_from_end_to_end(tiny_run):
    for module in ("uvicorn", "playwright"):
        pytest.importorskip(module, reason=f"{module} is not installed")
    measured = measure_latency(tiny_run, 1)
    assert 0 < measured["median_ms"] <= measured["ninetieth_percentile_ms"]
    assert measured["decisions"] > 0
    assert measured["digits"] == 1
