"""Hot taxels, and which polarity comes first."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings.activity import (
    find_hot_taxels,
    format_polarity_order,
    measure_activity,
    measure_polarity_order,
)
from pipeline.sources import load_recordings
from tests.pipeline.handmade import recordings

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"


def touch(rng, hot=(), n=60):
    """A path over the grid: each taxel rises, then falls; hot ones fire all the time."""
    start = rng.integers(0, 40)
    rows = []
    for step in range(n):
        rows.append((step * 15_000_000, start + step % 60, 1, 1))
        rows.append((step * 15_000_000 + 40_000_000, start + step % 60, -1, 1))
    for taxel in hot:
        rows += [(t * 20_000_000, taxel, 1 if t % 2 == 0 else -1, 1) for t in range(47)]
    return sorted(rows)


def test_a_hot_taxel_is_found():
    rng = np.random.default_rng(0)
    samples = [touch(rng, hot=[77] * (i % 4 == 0) + [3] * (i % 10 == 0)) for i in range(40)]
    made = recordings(*samples)
    assert find_hot_taxels(measure_activity(made)) == [77, 3]
    activity = measure_activity(made)
    assert activity.throughout[77] == pytest.approx(0.25)
    assert activity.throughout[50] == 0
    assert activity.recordings.max() <= 1
    without = made.subset([i for i in range(40) if i % 4 and i % 10])
    assert find_hot_taxels(measure_activity(without)) == []


def test_where_every_taxel_fires_throughout_none_is_hot():
    grasp = [(t * 10_000_000, taxel, 1, 1) for t in range(60) for taxel in (4, 5, 6)]
    assert find_hot_taxels(measure_activity(recordings(sorted(grasp), sorted(grasp)))) == []
    assert find_hot_taxels(measure_activity(recordings([], []))) == []


def test_the_polarity_that_comes_first():
    rises = [(0, 5, 1, 1), (100, 5, -1, 1), (100, 6, 1, 1), (100, 6, -1, 1), (100, 7, 1, 1)]
    order = measure_polarity_order(recordings(rises))
    assert order == {"taxels": 2, "rise_first": 0.5, "fall_first": 0.0, "together": 0.5}
    exchanged = [(time, taxel, -polarity, n) for time, taxel, polarity, n in rises]
    order = measure_polarity_order(recordings(exchanged, rises[:1]))
    assert order["fall_first"] == 0.5
    assert "exchanged" in format_polarity_order(order)
    assert measure_polarity_order(recordings(rises[:1]))["rise_first"] is None
    order = measure_polarity_order(recordings(exchanged, rises))  # which say nothing
    assert order["fall_first"] == order["rise_first"] == 0.25
    assert "exchanged" not in format_polarity_order({**order, "fall_first": 0.26})


def test_the_real_recordings():
    if not (SHARED / "stmnist-train.zip").exists():
        pytest.skip("needs stmnist-train.zip, real recordings that are not part of the project")
    read = load_recordings(str(SHARED / "stmnist-train.zip"))
    hot = find_hot_taxels(measure_activity(read))
    assert hot[0] == 41
    assert {27, 87} <= set(hot)
    order = measure_polarity_order(read)
    assert order["rise_first"] > 10 * order["fall_first"]
