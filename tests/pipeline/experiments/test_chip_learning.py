"""A readout that learns on the chip, against the delta rule by hand and on both emulators."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.network.rehearsal import Rehearsal
from pipeline.experiments.chip_learning import Lesson, Rule, learn_on_chip, present
from pipeline.training.readout import Person

RULE = Rule(steps=16, gap=24, tau=16)
WEIGHTS = np.array([[0.5, 0.0, -0.25], [0.0, 0.25, 0.125]])


def lesson(spikes, labels, errors):
    return Lesson(np.array(spikes), np.array(labels), np.array(errors, float))


def test_scores_are_those_of_the_readout():
    judged = lesson([[8, 0, 0], [0, 8, 2], [0, 0, 0], [3, 1, 7]], [0] * 4, [0] * 4)
    bias = np.array([0.5, -1.0])
    scores, learned = present(WEIGHTS, bias, judged, RULE)
    np.testing.assert_allclose(scores, judged.spikes @ WEIGHTS.T + bias, atol=0.1)
    np.testing.assert_allclose(learned, WEIGHTS, atol=0.5 / 64)


def test_weights_follow_the_delta_rule():
    """After one sample the changes are as error times spikes, with the sign of target - softmax."""
    one = lesson([[8, 4, 0]], [1], [1])
    learned = np.mean([present(WEIGHTS, np.zeros(2), one, RULE, seed)[1] for seed in range(8)], 0)
    change = learned - WEIGHTS
    scores = one.spikes @ WEIGHTS.T
    wrong = np.exp(scores[0]) / np.exp(scores).sum() - [0, 1]
    # The trace, which decays until the error arrives, times the error: 1,024 are a level.
    trace = RULE.trace * RULE.decayed(4) / RULE.decayed(8) * np.exp(-9 / RULE.tau)
    expected = -np.rint(RULE.error * wrong) * trace / 1024 * 0.5 / 64
    np.testing.assert_allclose(change[:, 1], expected, rtol=0.1, atol=0.2 / 128)
    assert change[0, 0] < change[0, 1] < 0 < change[1, 1] < change[1, 0]
    np.testing.assert_allclose(change[:, 2], 0, atol=0.5 / 64)


def test_the_emulators_agree():
    rng = np.random.default_rng(0)
    some = Lesson(rng.integers(0, 9, (8, 3)), rng.integers(0, 2, 8), np.r_[np.ones(5), 0, 0, 0])
    ours, theirs = (present(WEIGHTS, np.zeros(2), some, RULE, 1, on) for on in ("fast", "emulator"))
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.abs(ours[1] - WEIGHTS).max() > 0.02


def test_64_levels_where_the_default_has_8():
    weights = np.linspace(-1, 1, 201)[None] * [[1.0], [-1.0]]
    none = lesson(np.zeros((1, 201)), [0], [0])
    distinct = [
        len(np.unique(present(weights, np.zeros(2), none, replace(RULE, wgt_exp=exponent))[1]))
        for exponent in (1, 4)
    ]
    assert distinct == [129, 17]


@pytest.mark.parametrize("rehearsal", [0.0, 1.0])
def test_a_person_is_learned(rehearsal):
    """A person who writes the classes the other way round is told after, and not before."""
    centres = 0.1 * np.array([[4.0, 1, 0, 2], [0, 1, 4, 2]])
    rng = np.random.default_rng(0)
    weights, bias = np.array([[1.0, 0, -1, 0], [-1.0, 0, 1, 0]]), np.zeros(2)
    labels = np.arange(8) % 2
    own = np.abs(centres[1 - labels] + 0.02 * rng.standard_normal((8, 4)))
    kept = Rehearsal(centres[labels].astype(np.float32), labels)
    told = Person(own, labels, own[:, None].repeat(3, axis=1))
    rule = replace(RULE, rehearsal=0.25 * rehearsal, passes=8, error=127)
    scores, learned = learn_on_chip(weights, bias, told, kept, own, 10.0, rule)
    assert ((own @ weights.T).argmax(1) == labels).mean() == 0
    assert (scores.argmax(1) == labels).all()
    assert ((own @ learned.T).argmax(1) == labels).all()
