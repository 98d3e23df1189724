import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.check.intervals import compute_mcnemar_p, compute_wilson_interval


@pytest.mark.parametrize(
    ("correct", "n", "low", "high"),
    [
        (1, 10, 0.0179, 0.4042),  # Newcombe 1998, table I, method 3, and hand calculation
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (20, 20, 0.8389, 1.0),
    ],
)
def test_wilson_against_published_values(correct, n, low, high):
    assert compute_wilson_interval(correct, n) == pytest.approx((low, high), abs=5e-5)


@given(n=st.integers(1, 1000), share=st.floats(0, 1))
def test_wilson_holds_the_share(n, share):
    correct = round(share * n)
    low, high = compute_wilson_interval(correct, n)
    assert 0 <= low <= correct / n + 1e-12
    assert correct / n - 1e-12 <= high <= 1


@given(n=st.integers(1, 1000), share=st.floats(0, 1))
def test_wilson_is_symmetric(n, share):
    correct = round(share * n)
    low, high = compute_wilson_interval(correct, n)
    mirrored = compute_wilson_interval(n - correct, n)
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=1e-9)


def test_mcnemar_by_hand():
    def of(only_a, only_b, both=5):
        a = np.array([1] * only_a + [0] * only_b + [1] * both, bool)
        b = np.array([0] * only_a + [1] * only_b + [1] * both, bool)
        return compute_mcnemar_p(a, b)

    assert of(0, 0) == 1
    assert of(1, 0) == 1
    assert of(3, 3) == 1
    assert of(5, 0) == pytest.approx(2 / 32)
    assert of(0, 5) == pytest.approx(2 / 32)
    assert of(8, 2) == pytest.approx(2 * (1 + 10 + 45) / 1024)
