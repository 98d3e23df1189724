import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.network.decision import (
    Estimator,
    choose_threshold,
    compute_confidence,
    decide,
    make_estimator_inputs,
)


def outputs_of(*samples):
    """Outputs of two classes from what the first one is ahead by at each step."""
    ahead = np.array(samples, float)
    return np.stack([1 + ahead, np.ones_like(ahead)], -1)


def test_confidence_by_hand():
    assert compute_confidence([[1, 1], [np.log(3), 0]]).tolist() == pytest.approx([0.5, 0.75])
    assert compute_confidence(np.ones(10)) == pytest.approx(0.1)
    assert compute_confidence(np.zeros((3, 10))).tolist() == [0, 0, 0]  # no spike has arrived
    assert 1 - 1e-15 < compute_confidence([1000.0, 0.0, -1000.0]) < 1


def test_a_threshold_of_1_waits_for_the_end_however_sure_the_outputs_are():
    # As sure as can be from the first step on, and wrong until the last: any earlier is a loss.
    outputs = outputs_of([-1000, -1000, 1000], [-1000, -1000, 1000])
    certain = Estimator(
        *(tuple(0 * a for a in arrays) for arrays in vars(estimator_of(2)).values())
    )
    certain.biases[2][0] = 1000.0
    assert certain(outputs).tolist() == [[1, 1, 1]] * 2
    for estimator in (None, certain):
        chosen = choose_threshold(outputs, np.zeros(2, int), np.full(2, 2), estimator=estimator)
        assert chosen == (1, 1, 1)
        steps, classes = decide(outputs, chosen.value, estimator)
        assert (steps.tolist(), classes.tolist()) == ([2, 2], [0, 0])
    assert decide(outputs, 0.9999)[0].tolist() == [0, 0]


def test_a_decision_falls_in_the_first_sure_step_or_at_the_end():
    steps, classes = decide(outputs_of([0, 2, -9, -9], [0.1, -0.1, 0.1, -0.1]), 0.88)
    assert steps.tolist() == [1, 3]
    assert classes.tolist() == [0, 1]


def test_the_chosen_threshold_is_the_earliest_that_loses_no_more_than_allowed():
    # A threshold below 0.75 decides the third sample wrongly in its first step.
    outputs = outputs_of([4, 4, 4, 4], [4, 4, 4, 4], [-np.log(3), 4, 4, 4], [0, 4, 4, 4])
    labels, last = np.zeros(4, int), np.full(4, 3)
    strict = choose_threshold(outputs, labels, last, loss=0)
    assert strict.accuracy == 1
    assert 0.75 < strict.value < 0.983
    assert strict.share == pytest.approx((1 + 1 + 2 + 2) / 16)
    loose = choose_threshold(outputs, labels, last, loss=0.25)
    assert choose_threshold(outputs, labels, last, 0.25, weights=[1, 1, 2, 2]).accuracy == 1
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


def estimator_of(classes, seed=0):
    rng = np.random.default_rng(seed)
    arrays = {
        name: rng.normal(size=shape) for name, shape in Estimator.list_shapes(classes).items()
    }
    return Estimator.from_arrays(arrays, classes)


def test_what_an_estimator_goes_by_by_hand():
    # Two classes with shares of 1/4 and 3/4, in the sixth step; before it there was nothing.
    told = make_estimator_inputs(np.log([[1.0, 3.0]]), first=5)
    low, high = np.log(0.25), np.log(0.75)
    np.testing.assert_allclose(told, [[high, low, 0, 1, low, high, 5, *[0, np.log(3)] * 2]])


def test_what_an_estimator_is_told_of_the_steps_before():
    outputs = np.stack([np.arange(8.0), np.arange(8.0) ** 2], -1)
    changes = make_estimator_inputs(np.stack([outputs, 2 * outputs]))[..., -4:]
    for t in range(8):
        expected = [outputs[t] - (outputs[t - lag] if t >= lag else 0) for lag in (2, 5)]
        np.testing.assert_allclose(changes[0, t], np.concatenate(expected))
        np.testing.assert_allclose(changes[1, t], 2 * np.concatenate(expected))


def test_an_estimator_of_one_unit_by_hand():
    estimator = estimator_of(2)
    kernels, biases = [0 * k for k in estimator.kernels], [0 * b for b in estimator.biases]
    kernels[0][6, 3] = 1.0  # the step
    biases[0][3] = -2.0
    kernels[1][3, 0], kernels[2][0, 0], biases[2][0] = 2.0, 0.5, -1.0
    simple = Estimator(tuple(kernels), tuple(biases))
    expected = 1 / (1 + np.exp(-(np.maximum(np.arange(6) - 2, 0) - 1)))
    growing = np.tile(np.arange(1.0, 7)[:, None], (3, 1, 2))
    np.testing.assert_allclose(compute_confidence(growing, simple), [expected] * 3)
    np.testing.assert_allclose(compute_confidence(growing[0, :2], simple, first=4), expected[4:])
    steps, classes = decide(growing[:1], 0.6, simple)
    assert (steps.tolist(), classes.tolist()) == ([4], [0])
    assert decide(growing[:1, :3], 0.6, simple, first=3)[0].tolist() == [1]
    # In silence the confidence stays; before the first output there is none.
    heard = np.stack([growing[0, n] for n in (0, 1, 1, 2, 2, 2)])
    np.testing.assert_allclose(compute_confidence(heard, simple), expected[[0, 1, 1, 3, 3, 3]])
    heard[:2] = 0
    np.testing.assert_allclose(compute_confidence(heard, simple), [0, 0, *expected[[2, 3, 3, 3]]])


def test_an_estimators_arrays_there_and_back():
    estimator = estimator_of(10)
    again = Estimator.from_arrays({**estimator.to_arrays(), "output.weights": np.zeros(3)}, 10)
    outputs = np.random.default_rng(1).normal(size=(4, 7, 10))
    np.testing.assert_array_equal(estimator(outputs), again(outputs))
    assert Estimator.from_arrays({"output.weights": np.zeros(3)}, 10) is None


def test_a_threshold_is_chosen_for_the_estimator():
    # Wrong where the first class leads: the softmax cannot know, the estimator does.
    outputs = np.repeat(np.array([[[5.0, 0.0]], [[0.0, 5.0]]]), 4, axis=1)
    outputs[0, 2:] = [0.0, 5.0]
    labels, last = np.ones(2, int), np.full(2, 3)
    kernels, biases = (
        [0 * k for k in estimator_of(2).kernels],
        [0 * b for b in estimator_of(2).biases],
    )
    kernels[0][3, 0], kernels[1][0, 0], kernels[2][0, 0], biases[2][0] = 1.0, 1.0, 9.0, -4.0
    estimator = Estimator(tuple(kernels), tuple(biases))
    assert choose_threshold(outputs, labels, last, 0).share == pytest.approx(1)
    assert choose_threshold(outputs, labels, last, 0, estimator).share == pytest.approx((3 + 1) / 8)
