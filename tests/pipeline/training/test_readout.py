"""Refitting a readout to one person."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from deploy.network.rehearsal import Rehearsal
from pipeline.training.adaptation import refit as refit_module
from pipeline.training.adaptation.refit import Person, fit_readout, round_to_8_bits

CLASSES, INPUTS = 4, 12


def clouds(rng, centres, each, spread=0.5):
    labels = np.repeat(np.arange(len(centres)), each)
    return centres[labels] + spread * rng.standard_normal((len(labels), centres.shape[1])), labels


def person_of(rng, centres, each):
    responses, labels = clouds(rng, centres, each)
    copies = responses[:, None] + 0.2 * rng.standard_normal((len(labels), 3, INPUTS))
    return Person(responses, labels, copies)


@pytest.fixture
def world():
    """Everybody's classes, a readout for them, and kept samples."""
    rng = np.random.default_rng(0)
    centres = 1.5 * rng.standard_normal((CLASSES, INPUTS))
    kept = Rehearsal(*clouds(rng, centres, 60))
    weights = centres
    bias = -0.5 * (centres**2).sum(axis=1)
    return rng, centres, weights, bias, kept


def right(weights, bias, responses, labels):
    return ((responses @ weights.T + bias).argmax(1) == labels).mean()


def fit_to_person_who_differs(world):
    """The fit, and the centres of the person's clouds."""
    rng, centres, weights, bias, kept = world
    own = centres.copy()
    own[1] = 0.75 * centres[2] + 0.25 * centres[1] + 0.7 * rng.standard_normal(INPUTS)
    return fit_readout(weights, bias, person_of(rng, own, 6), kept), own


def test_a_person_who_differs_is_told_better(world):
    rng, _, weights, bias, _ = world
    fit, own = fit_to_person_who_differs(world)
    assert fit.helps
    np.testing.assert_allclose(round_to_8_bits(fit.weights), fit.weights)
    assert fit.after.mean() > fit.before.mean()
    unseen = clouds(rng, own, 100)
    gain = right(fit.weights, bias, *unseen) - right(weights, bias, *unseen)
    assert gain > 0.1
    # What cross-validation promises is about what comes.
    assert fit.after.mean() == pytest.approx(right(fit.weights, bias, *unseen), abs=0.15)


def test_others_than_a_person_who_differs_are_told_nearly_as_well(world):
    rng, centres, weights, bias, _ = world
    fit, _ = fit_to_person_who_differs(world)
    others = clouds(rng, centres, 100)
    assert right(fit.weights, bias, *others) > right(weights, bias, *others) - 0.03


def test_a_person_like_everybody_gets_nothing_new(world):
    rng, centres, weights, bias, kept = world
    fit = fit_readout(weights, bias, person_of(rng, 2 * centres, 5), kept)
    assert fit.before.all()
    assert not fit.helps


def test_labels_drawn_at_random_do_not_help(world):
    rng, centres, weights, bias, kept = world
    person = person_of(rng, centres, 5)
    mixed = Person(person.responses, rng.permutation(person.labels), person.copies)
    assert not fit_readout(weights, bias, mixed, kept).helps


def test_the_same_seed_gives_the_same_weights_and_labels_may_be_few(world):
    rng, centres, weights, bias, kept = world
    person = person_of(rng, centres[::-1], 1)
    one, other = (fit_readout(weights, bias, person, kept, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.weights, other.weights)
    assert len(one.after) == CLASSES


def test_the_gradient_is_of_the_loss(world, monkeypatch):
    rng, _, weights, bias, kept = world
    seen = {}

    def check(loss, start, **how):
        point = 0.1 * rng.standard_normal(start.shape)
        _, slope = loss(point)
        for index in (0, 7, len(point) - 1):
            step = np.zeros_like(point)
            step[index] = 1e-5
            seen[index] = ((loss(point + step)[0] - loss(point - step)[0]) / 2e-5, slope[index])
        return type("Found", (), {"x": start})

    monkeypatch.setattr(refit_module, "minimize", check)
    nobody = Person(kept.responses[:3], kept.labels[:3], np.empty((3, 0, INPUTS)))
    problem = refit_module._Regression(weights, bias, nobody, kept, 2.0)
    everything = np.ones(len(kept), bool)
    problem.solve(kept.responses[:9], kept.labels[:9], everything, 0.01, 0.5)
    assert len(seen) == 3
    for numeric, analytic in seen.values():
        assert numeric == pytest.approx(analytic, rel=1e-4, abs=1e-8)


def test_many_neurons_change_in_the_directions_that_vary():
    """A layer of 300 of which 280 are silent is fitted as one of 20."""
    rng = np.random.default_rng(0)
    centres = 1.5 * rng.standard_normal((CLASSES, INPUTS))
    kept = Rehearsal(*clouds(rng, centres, 60))
    person = person_of(rng, centres[::-1], 6)
    bias = -0.5 * (centres**2).sum(axis=1)

    def padded(array):
        silent = np.zeros((*array.shape[:-1], 280))
        return np.concatenate([array, silent], axis=-1)

    few = fit_readout(centres, bias, person, kept)
    wide = Person(padded(person.responses), person.labels, padded(person.copies))
    many = fit_readout(padded(centres), bias, wide, Rehearsal(padded(kept.responses), kept.labels))
    np.testing.assert_allclose(many.weights[:, :INPUTS], few.weights, atol=0.05)
    assert not many.weights[:, INPUTS:].any()


def test_eight_bits():
    weights = np.array([[1.27, -0.0149], [0.52, -1.0]])
    rounded = round_to_8_bits(weights)
    np.testing.assert_allclose(rounded, [[1.27, -0.01], [0.52, -1.0]])
    assert len(np.unique(round_to_8_bits(np.random.default_rng(0).standard_normal(5000)))) <= 255
    np.testing.assert_array_equal(round_to_8_bits(np.zeros((2, 2))), np.zeros((2, 2)))


@pytest.mark.parametrize("each", [1, 2, 7])
def test_folds_share_out_every_class(each):
    labels = np.repeat(np.arange(10), each)
    folds = refit_module._draw_folds(labels, 0)
    assert folds.max() + 1 == 5
    assert set(np.bincount(folds)) <= {2 * each, 2 * each + 1, 2 * each - 1}
    for label in range(10):
        assert np.bincount(folds[labels == label]).max() <= -(-each // 5)


def test_it_computes_in_one_thread(world, monkeypatch):
    """Several took twelve times as long: the page's fit has to be there within two seconds."""
    rng, centres, weights, bias, kept = world
    threads = []
    minimize = refit_module.minimize

    def watched(*given, **options):
        threads.append(
            {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}
        )
        return minimize(*given, **options)

    monkeypatch.setattr(refit_module, "minimize", watched)
    with threadpool_limits(2, user_api="blas"):
        fit_readout(weights, bias, person_of(rng, centres, 2), kept)
    assert threads
    assert set.union(*threads) == {1}
