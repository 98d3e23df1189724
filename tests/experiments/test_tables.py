"""Tables of measured rows: the statistics, by hand."""

import numpy as np
import pytest
from scipy import stats

from experiments.tables import correct_by_holm, estimate_mean, make_table


def row(name, seed, right, split="random", n_train=80, n_test=None, **more):
    right = [int(r) for r in right]
    return {
        "name": name,
        "seed": seed,
        "split": split,
        "n_train": n_train,
        "n_test": n_test or len(right),
        "accuracy": float(np.mean(right)),
        "samples": list(range(len(right))),
        "right": right,
        "predictions": right,
        "simulated": True,
        "recordings": "0",
        **more,
    }


def test_the_interval_is_that_of_overlapping_splits():
    """Worked by hand: s = 0.01, 1/3 + 1/4 = 7/12, t of 2 degrees of freedom."""
    result = estimate_mean([0.89, 0.90, 0.91], n_train=80, n_test=20)
    reach = 4.302652729911275 * 0.01 * (7 / 12) ** 0.5
    assert result["mean"] == pytest.approx(0.9)
    assert result["sd"] == pytest.approx(0.01)
    np.testing.assert_allclose(result["ci95"], [0.9 - reach, 0.9 + reach])


def test_a_published_split_has_the_interval_of_its_trainings():
    values = [0.89, 0.90, 0.91]
    result = estimate_mean(values, 80, 20, "published")
    expected = stats.t.interval(0.95, 2, np.mean(values), stats.sem(values))
    np.testing.assert_allclose(result["ci95"], expected)


@pytest.mark.parametrize("values", [[0.9], [0.2, 0.8]])
def test_there_is_no_interval_of_fewer_than_three_splits(values):
    result = estimate_mean(values, 80, 20)
    assert (result["ci95"], result["p"], result["sd"]) == (None, None, None)


def test_holm_by_hand():
    assert correct_by_holm([0.01, 0.04, None, 0.03]) == pytest.approx([0.03, 0.06, None, 0.06])
    assert correct_by_holm([0.9, 0.8]) == [1.0, 1.0]
    assert correct_by_holm([]) == []


def test_the_shares_are_those_of_the_split_whatever_was_evaluated():
    """Ten of 100 test samples say as little about other splits as all of them (issue: 200)."""
    rows = [row("chip", seed, [1] * (7 + seed) + [0] * (3 - seed), n_test=100) for seed in range(3)]
    (entry,) = make_table(rows)["rows"]
    assert entry["n_test"] == 100
    expected = estimate_mean([0.7, 0.8, 0.9], 80, 100)["ci95"]
    np.testing.assert_allclose(entry["ci95"], expected)


def test_differences_are_paired_on_the_samples_that_both_have():
    ones = [row("a", seed, [1, 1, 0, 0]) for seed in range(3)]
    others = [row("b", seed, [1, 0]) for seed in range(3)]
    (result,) = make_table([*ones, *others], against=[("b", "a")])["comparisons"]
    assert (result["a"], result["b"], result["split"]) == ("b", "a", "random")
    assert result["mean"] == -0.5  # on samples 0 and 1; a loss is negative
    assert result["agreement"] == 0.5
    assert len(result["values"]) == 3


def test_a_single_split_has_wilson_and_mcnemar():
    rows = [row("a", 0, [1] * 9 + [0]), row("b", 0, [0] * 10)]
    result = make_table(rows, against=[("a", "b"), ("a", "missing")])
    np.testing.assert_allclose(result["rows"][0]["ci95"], [0.5958, 0.9821], atol=1e-4)
    (compared,) = result["comparisons"]
    assert compared["p"] == pytest.approx(2 / 2**9)
    assert compared["ci95"] is None
