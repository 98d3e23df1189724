"""The model of handwriting: drawn from, stored, and estimated from trajectories."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.files import hash_file
from experiments import handwriting as fit
from experiments.__main__ import main
from pipeline.simulation import shape_model
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.shape_model import POINTS, Allograph
from tests.command import call

BUILT_IN = shape_model.read_tablet_model()


def stroke(start, end, points=24):
    return np.linspace(start, end, points)


def people(digits=range(10), writers=6, each=10, seed=0, **how):
    """Trajectories of people who write each digit as a line, two of three downwards.

    A person's line always ends so far to the right, each digit's a little elsewhere.
    """
    rng = np.random.default_rng(seed)
    traces = []
    for writer in range(writers):
        habit = how.get("between", 0.3) * rng.standard_normal()
        for digit in digits:
            for _ in range(each):
                end = habit + how.get("within", 0.1) * rng.standard_normal()
                line = stroke([-0.5, 0.0], [0.5, end])
                strokes = shape_model.fit_in_box([line[::-1] if writer % 3 == 2 else line])
                traces.append(Trace(digit, writer, strokes))
    return traces


def test_it_is_what_people_do():
    """Ways, their shares, direction, and the variation within a person."""
    model = fit.estimate_shape_model(people(writers=60))
    for ways in model.allographs:
        downwards = sum(w.share for w in ways if w.mean[0] < w.mean[2 * POINTS - 2])
        assert downwards == pytest.approx(2 / 3, abs=0.02)
    rng = np.random.default_rng(1)
    way = max(model.allographs[4], key=lambda way: way.share)
    drawn = [way.make_strokes(way.within @ rng.standard_normal(way.rank)) for _ in range(500)]
    assert np.std([strokes[0][-1, 1] - strokes[0][0, 1] for strokes in drawn]) < 0.15


def test_people_who_are_not_known():
    """Half of the variation is a person's."""
    traces = people(writers=60)
    unknown = [replace(trace, writer=number) for number, trace in enumerate(traces)]
    model = fit.estimate_shape_model(unknown)
    assert set(model.loyalty) == {0.5}
    for ways in model.allographs:
        for way in ways:
            np.testing.assert_allclose(way.between, way.within)
            np.testing.assert_allclose(
                way.between @ way.between.T + way.within @ way.within.T, np.eye(way.rank), atol=1e-6
            )


def test_ways_of_other_people_join():
    one, other = fit.estimate_shape_model(people()), fit.estimate_shape_model(people(seed=1))
    joined = one.join(other, 0.25)
    for first, more, ways in zip(one.allographs, other.allographs, joined.allographs, strict=True):
        assert len(ways) == len(first) + len(more)
        assert sum(way.share for way in ways) == pytest.approx(1)
        assert sum(way.share for way in ways[len(first) :]) == pytest.approx(0.25)


def test_offsets_of_persons_and_what_differs_within_one():
    rng = np.random.default_rng(0)
    writers = np.repeat(np.arange(400), rng.integers(2, 12, 400))  # not all write as much
    between, within = np.array([[1.0, 0.3], [0.3, 0.2]]), np.diag([0.5, 0.9])
    offsets = rng.multivariate_normal([0, 0], between, 400)
    scores = offsets[writers] + rng.multivariate_normal([0, 0], within, len(writers))
    result = fit._estimate_covariances(scores, writers)
    for covariance, true in zip(result, (between, within), strict=True):
        np.testing.assert_allclose(covariance, true, atol=0.15)
        root = fit._compute_root(covariance)
        np.testing.assert_allclose(root @ root.T, covariance, atol=0.05)


def test_loyalty_by_hand():
    # Everybody has one way: loyal.  Everybody has both alike: not at all.
    assert fit._estimate_loyalty(np.array([[10, 0], [0, 10]])) == pytest.approx(1)
    assert fit._estimate_loyalty(np.array([[10, 10], [10, 10]])) == 0
    # One of ways alone.
    assert fit._estimate_loyalty(np.array([[10], [10]])) == 1
    # A share q of one's own of two, the rest of either: same way with (1 + q^2) / 2.
    q = 0.6
    habitual, other = (1 + q) / 2, (1 - q) / 2
    many = 100_000
    usage = np.rint(np.array([[habitual, other], [other, habitual]]) * many).astype(int)
    assert fit._estimate_loyalty(usage) == pytest.approx(q, abs=1e-3)


def test_strokes_of_a_mean_are_the_mean():
    down, across = stroke([-0.5, 0.1], [0.5, -0.2], 20), stroke([0, -0.3], [0, 0.3], 12)
    mean = np.concatenate([down.ravel(), across.ravel(), [np.log(12 / 20)]])
    nothing = np.zeros((1, 1))
    way = Allograph(1.0, (20, 12), mean, np.zeros((1, len(mean))), nothing, nothing)
    first, second = way.make_strokes(np.zeros(1))
    assert (len(first), len(second)) == (20, 12)
    np.testing.assert_allclose(first[[0, -1]], [[-0.5, 0.15], [0.5, -0.15]], atol=0.06)
    np.testing.assert_allclose(second[:, 0], 0, atol=1e-9)


def test_round_trip(tmp_path):
    path = tmp_path / "model.npz"
    model = fit.estimate_shape_model(people(), about={"source": "made up"})
    shape_model.write_shape_model(path, model)
    again = shape_model.read_shape_model(path)
    assert again.compute_hash() == model.compute_hash()
    assert again.about == {"source": "made up", "writers": 6, "digits": 600}
    assert replace(again, tempo=0.5).compute_hash() != model.compute_hash()


def test_the_built_in_model_says_where_it_is_from_and_is_small():
    about = BUILT_IN.about
    assert (about["licence"], about["writers"], about["digits"]) == ("CC BY 4.0", 30, 7494)
    assert "Alpaydin" in about["source"]
    assert shape_model.MODEL.stat().st_size <= 300_000


def test_no_way_of_writing_is_a_single_persons():
    """A mean of at least fifteen digits of at least three people is nobody's trajectory."""
    assert fit.MIN_DIGITS >= 15
    assert fit.MIN_WRITERS >= 3
    for ways in BUILT_IN.allographs:
        for way in ways:
            assert way.share * BUILT_IN.about["digits"] / 10 >= 0.85 * fit.MIN_DIGITS


def test_the_command_estimates_the_built_in_model(shared_data, tmp_path):
    file, out = shared_data / "pendigits-train.unipen", tmp_path / "model.npz"
    assert call("handwriting", file, "--out", out, main=main) == 0
    again = shape_model.read_shape_model(out)
    assert again.about == BUILT_IN.about
    assert again.about["sha256"] == hash_file(file)
    assert [len(ways) for ways in again.allographs] == [len(w) for w in BUILT_IN.allographs]
    for one, other in zip(again.allographs, BUILT_IN.allographs, strict=True):
        for way, stored in zip(one, other, strict=True):
            np.testing.assert_allclose(way.mean, stored.mean, atol=1e-2)
