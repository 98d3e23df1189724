import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.network.decision import choose_threshold, confidence, decide, share_of_time


def outputs_of(*samples):
    """Outputs of two classes from what the first one is ahead by at each step."""
    ahead = np.array(samples, float)
    return np.stack([ahead, np.zeros_like(ahead)], -1)


def test_confidence_by_hand():
    assert confidence([[0, 0], [np.log(3), 0]]).tolist() == pytest.approx([0.5, 0.75])
    assert confidence(np.zeros(10)) == pytest.approx(0.1)
    assert confidence([1000.0, 0.0, -1000.0]) == 1


def test_a_decision_falls_in_the_first_sure_step_or_at_the_end():
    steps, classes = decide(outputs_of([0, 2, -9, -9], [0.1, -0.1, 0.1, -0.1]), 0.88)
    assert steps.tolist() == [1, 3]
    assert classes.tolist() == [0, 1]


def test_share_of_time_is_never_more_than_all():
    assert share_of_time([0, 4, 9], [9, 9, 4]).tolist() == [0.1, 0.5, 1]


def test_the_chosen_threshold_is_the_earliest_that_loses_no_more_than_allowed():
    # A threshold below 0.75 decides the third sample wrongly in its first step.
    outputs = outputs_of([4, 4, 4, 4], [4, 4, 4, 4], [-np.log(3), 4, 4, 4], [0, 4, 4, 4])
    labels, last = np.zeros(4, int), np.full(4, 3)
    strict = choose_threshold(outputs, labels, last, loss=0)
    assert strict.accuracy == 1
    assert 0.75 < strict.confidence < 0.983
    assert strict.share == pytest.approx((1 + 1 + 2 + 2) / 16)
    loose = choose_threshold(outputs, labels, last, loss=0.25)
    assert loose.accuracy == 0.75
    assert loose.share == pytest.approx(4 / 16)  # all in their first step


@given(st.integers(0, 2**20))
def test_a_higher_threshold_never_decides_earlier(seed):
    rng = np.random.default_rng(seed)
    outputs = np.cumsum(rng.normal(size=(5, 12, 4)), 1)
    early, late = (decide(outputs, level)[0] for level in (0.6, 0.9))
    assert (early <= late).all()
    assert decide(outputs, 1.1)[1].tolist() == outputs[:, -1].argmax(-1).tolist()
    chosen = choose_threshold(outputs, rng.integers(0, 4, 5), np.full(5, 11))
    assert 0 < chosen.share <= 1
