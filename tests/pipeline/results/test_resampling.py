import numpy as np
import pytest
from scipy import stats

from pipeline.results.resampling import estimate


def test_by_hand():
    """Mean 0.88, SD 0.02; sqrt(1/3 + 1/4) of it is 0.0153; t(0.975, 2) = 4.303."""
    got = estimate([0.86, 0.88, 0.90], n_train=80, n_test=20)
    assert got.mean == pytest.approx(0.88)
    assert got.sd == pytest.approx(0.02)
    assert got.interval == pytest.approx((0.88 - 0.06572, 0.88 + 0.06572), abs=1e-4)


def test_a_single_split_has_no_spread():
    got = estimate([0.9], 80, 20)
    assert (got.mean, got.sd, got.interval, got.p_value) == (0.9, None, None, None)


def test_no_splits():
    with pytest.raises(ValueError, match="values"):
        estimate([], 80, 20)


def test_without_overlap_it_is_the_usual_t_test():
    values = np.random.default_rng(0).normal(0.3, 1, 12)
    got = estimate(values, n_train=10**9, n_test=1)
    assert got.p_value == pytest.approx(stats.ttest_1samp(values, 0).pvalue, rel=1e-6)
    usual = stats.t.interval(0.95, 11, values.mean(), stats.sem(values))
    assert got.interval == pytest.approx(usual, rel=1e-6)


def test_equal_values():
    assert estimate([0.0, 0.0], 80, 20).p_value == 1
    assert estimate([0.1, 0.1], 80, 20).p_value == 0


def test_intervals_hold_what_they_promise():
    """Accuracies of overlapping splits correlate by about n_test/(n_test + n_train)."""
    rng, inside = np.random.default_rng(1), 0
    for _ in range(600):
        shared = rng.normal(0, np.sqrt(0.2))
        values = shared + rng.normal(0, np.sqrt(0.8), 10)
        low, high = estimate(values, 80, 20).interval
        inside += low <= 0 <= high
    assert 0.92 < inside / 600 < 0.98
