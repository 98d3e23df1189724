"""Pens: strokes, contacts, people."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.skin import handwriting, parameters
from pipeline.skin.handwriting import ActionPlan, allographs, move

P = parameters.load()
STEP = 1e-3


def written(points, turns=None, in_air=None):
    n = len(points) - 1
    plan = ActionPlan(
        np.array(points, float),
        np.zeros(n) if turns is None else np.radians(turns),
        np.zeros(n, bool) if in_air is None else np.array(in_air),
    )
    return move(plan, 1.0, STEP, 0.2, P.kinematics)


def test_a_straight_stroke_ends_where_it_is_aimed_with_a_lognormal_speed():
    pen = written([[0, 0], [0, 6]])
    assert np.allclose(pen.down, 0)
    assert pen.right[0] == pytest.approx(0, abs=0.1)
    assert pen.right[-1] == pytest.approx(6, abs=0.1)
    speed = np.diff(pen.right)
    peak = speed.argmax()
    assert (np.diff(speed[:peak]) >= -1e-9).all()
    assert (np.diff(speed[peak:]) <= 1e-9).all()
    rise, fall = peak, len(speed) - peak
    assert rise < fall  # lognormal: it speeds up faster than it slows down


@pytest.mark.parametrize("turn", [-180, -90, 30, 90, 180])
def test_a_turning_stroke_runs_on_a_circle(turn):
    pen = written([[0, 0], [0, 4]], [turn])
    radius = 2 / np.sin(abs(np.radians(turn)) / 2)
    # On a screen's axes (down, right), clockwise from left to right bulges upwards.
    middle = np.sign(turn) * np.sqrt(max(radius**2 - 4, 0))
    distance = np.hypot(pen.right - 2, pen.down - middle)
    assert np.allclose(distance, radius, atol=0.02)
    farthest = pen.down[np.abs(pen.down).argmax()]
    assert np.sign(farthest) == -np.sign(turn)
    assert abs(farthest) == pytest.approx(radius - abs(middle), abs=0.02)


def test_a_corner_is_cut_by_the_overlap_of_strokes():
    pen = written([[0, 0], [0, 5], [5, 5]])
    nearest = np.hypot(pen.down, pen.right - 5).min()
    assert 0.01 < nearest < 1.0
    assert (pen.down[-1], pen.right[-1]) == pytest.approx((5, 5), abs=0.15)


def test_the_pen_is_in_the_air_between_contacts():
    pen = written([[0, 0], [0, 5], [5, 0], [5, 5]], in_air=[False, True, False])
    down = pen.force > 0.5
    assert np.flatnonzero(np.diff(down.astype(int)) == 1).size == 2
    assert pen.force[0] == pen.force[-1] == 0
    lifted, landed = np.flatnonzero(np.diff((pen.force == 0).astype(int)))[1:3]
    assert pen.time_s[landed] - pen.time_s[lifted] > 0.05


@given(st.floats(0.5, 3.0))
def test_tempo_scales_time_only(tempo):
    plan = ActionPlan(
        np.array([[0, 0], [4, 1], [0, 5]], float), np.radians([40, -60]), np.zeros(2, bool)
    )
    length = handwriting.length_s(plan, P.kinematics)
    pen = move(plan, tempo, STEP, 0.0, P.kinematics)
    assert pen.time_s[-1] == pytest.approx(length / tempo + P.kinematics.settle_s, abs=2 * STEP)
    assert (pen.down[-1], pen.right[-1]) == pytest.approx((0, 5), abs=0.2)


@pytest.mark.parametrize("digit", range(10))
def test_allographs_fill_their_box(digit):
    assert sum(share for share, _ in allographs()[digit]) == pytest.approx(1)
    for _, plan in allographs()[digit]:
        assert plan.points.min() >= 0
        assert plan.points.max() <= 1
        assert np.ptp(plan.points[:, 0]) > 0.9
        assert not plan.in_air[0]
        assert not plan.in_air[-1]


@pytest.mark.parametrize("digit", [1, 4, 7])
def test_digits_that_people_write_in_several_ways(digit):
    assert len(allographs()[digit]) >= 3


@given(st.integers(0, 2**31))
def test_every_group_of_writers_is_like_every_other_on_the_whole(seed):
    people = handwriting.writers(np.random.default_rng(seed), P.writers)
    assert len(people) == 23
    for trait in ("slant", "tempo", "force"):
        values = np.array([getattr(who, trait) for who in people])
        assert abs(values.mean()) < 1e-12
        assert values.std() == pytest.approx(getattr(P.writers, trait), rel=0.1)
    habits = np.array([who.allographs for who in people])
    for digit, ways in enumerate(allographs()):
        for choice, (share, _) in enumerate(ways):
            assert abs((habits[:, digit] == choice).sum() - 23 * share) <= 1


def test_placing_by_hand():
    still = SimpleNamespace(slant=0, tilt=0, size=0, place=(0, 0))
    place = handwriting.placing(
        handwriting.NOBODY, np.random.default_rng(0), still, height=8, width=4, down=5, right=6
    )
    corners = place(np.array([[-0.5, -0.5], [0.5, 0.5]]))
    np.testing.assert_allclose(corners, [[1, 4], [9, 8]])


def test_slant_leans_to_the_right():
    leaning = handwriting.Writer(**{**vars(handwriting.NOBODY), "slant": 0.3})
    still = SimpleNamespace(slant=0, tilt=0, size=0, place=(0, 0))
    place = handwriting.placing(leaning, np.random.default_rng(0), still, 8, 4, 5, 5)
    top, bottom = place(np.array([[-0.5, 0.0], [0.5, 0.0]]))
    assert top[1] > bottom[1]
