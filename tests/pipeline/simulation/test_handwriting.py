"""Pens: strokes, contacts, people."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulation import handwriting, parameters
from pipeline.simulation.handwriting import move

P = parameters.load()
STEP = 1e-3


def line(start, end, points=20):
    return np.linspace(start, end, points)


def test_the_pen_follows_a_stroke_and_rests_at_its_end():
    pen = move([line([1, 2], [7, 2])], 1.0, STEP, 0.2, P.kinematics)
    assert np.allclose(pen.right, 2)
    assert (pen.down[0], pen.down[-1]) == pytest.approx((1, 7))
    assert pen.force[0] == pen.force[-1] == 0
    # 6 taxels at the usual speed, the landing before them, and the film's rest after them.
    time = P.kinematics.landing_s + 6 / P.kinematics.speed + P.kinematics.settle_s
    assert pen.time_s[-1] - pen.time_s[0] == pytest.approx(time, abs=2 * STEP)


def test_the_pen_is_slow_where_the_trace_is():
    down = np.concatenate([np.linspace(0, 1, 11), np.linspace(1, 7, 11)[1:]])  # slow, then fast
    pen = move([np.stack([down, np.zeros(21)], 1)], 1.0, STEP, 0.0, P.kinematics)
    middle = np.interp(np.mean([0, 7 / P.kinematics.speed]), pen.time_s, pen.down)
    assert middle == pytest.approx(1, abs=0.05)


def test_the_pen_is_in_the_air_between_strokes():
    strokes = [line([0, 0], [0, 5]), line([5, 0], [5, 5])]
    pen = move(strokes, 1.0, STEP, 0.2, P.kinematics)
    down = pen.force > 0.5
    assert np.flatnonzero(np.diff(down.astype(int)) == 1).size == 2
    lifted, landed = np.flatnonzero(np.diff((pen.force == 0).astype(int)))[1:3]
    assert pen.time_s[landed] - pen.time_s[lifted] > 0.05


@given(st.floats(0.5, 3.0))
def test_tempo_scales_time_only(tempo):
    strokes = [line([0, 0], [4, 1]), line([0, 5], [6, 5], 9)]
    length = handwriting.length_s(strokes, P.kinematics)
    pen = move(strokes, tempo, STEP, 0.0, P.kinematics)
    assert pen.time_s[-1] == pytest.approx(length / tempo + P.kinematics.settle_s, abs=2 * STEP)
    assert (pen.down[-1], pen.right[-1]) == pytest.approx((6, 5))


@given(st.integers(0, 2**31))
def test_every_group_of_writers_is_like_every_other_on_the_whole(seed):
    people = handwriting.writers(np.random.default_rng(seed), P.writers, P.shapes)
    assert len(people) == 23
    for trait, spread in (
        ("slant", P.shapes.slant),
        ("tempo", P.shapes.tempo),
        ("force", P.writers.force),
    ):
        values = np.array([getattr(who, trait) for who in people])
        assert abs(values.mean()) < 1e-12
        assert values.std() == pytest.approx(spread, rel=0.1)
    habits = np.array([who.allographs for who in people])
    for digit, ways in enumerate(P.shapes.allographs):
        for choice, way in enumerate(ways):
            assert abs((habits[:, digit] == choice).sum() - 23 * way.share) <= 1


def test_a_digit_is_one_high_and_leans_as_its_writer_does():
    who = handwriting.writers(np.random.default_rng(0), P.writers, P.shapes)[3]
    leaning = handwriting.Writer(**{**vars(who), "slant": who.slant + 0.5})
    wide = handwriting.Writer(**{**vars(who), "width": who.width + np.log(2)})
    for digit in range(10):
        strokes, leant, widened = (
            handwriting.write(digit, one, np.random.default_rng(digit), P.shapes)
            for one in (who, leaning, wide)
        )
        points = np.concatenate(strokes)
        assert np.ptp(points[:, 0]) == pytest.approx(1)
        assert points.max(axis=0) == pytest.approx(-points.min(axis=0))
        assert np.ptp(np.concatenate(widened)[:, 1]) > 1.3 * np.ptp(points[:, 1])
        top, bottom = (np.concatenate(leant)[points[:, 0].argsort()[end]] for end in (0, -1))
        before = points[points[:, 0].argsort()[0]] - points[points[:, 0].argsort()[-1]]
        assert (top - bottom)[1] == pytest.approx(before[1] + 0.5, abs=1e-6)


def test_a_writer_writes_in_the_way_of_a_habit_mostly():
    who = handwriting.writers(np.random.default_rng(1), P.writers, P.shapes)[0]
    rng = np.random.default_rng(2)
    counts = [len(handwriting.write(5, who, rng, P.shapes)) for _ in range(400)]
    mine = len(P.shapes.allographs[5][who.allographs[5]].points)
    shares = {}
    for way in P.shapes.allographs[5]:
        shares[len(way.points)] = shares.get(len(way.points), 0) + way.share
    loyal = P.shapes.loyalty[5]
    expected = loyal + (1 - loyal) * shares[mine] / sum(shares.values())
    assert np.mean(np.array(counts) == mine) == pytest.approx(expected, abs=0.07)


def test_placing_by_hand():
    still = SimpleNamespace(size=0, place=(0, 0))
    form = SimpleNamespace(height=8, down=5, right=6)
    place = handwriting.placing(handwriting.NOBODY, np.random.default_rng(0), still, form, 4)
    corners = place(np.array([[-0.5, -0.5], [0.5, 0.5]]))
    np.testing.assert_allclose(corners, [[1, 4], [9, 8]])


def test_people_in_general_write_all_digits_alike_and_some_a_plain_1():
    p = parameters.load(60)
    assert len(set(p.forms)) == 1
    ways = p.shapes.allographs[1]
    people = handwriting.writers(np.random.default_rng(0), p.writers, p.shapes)
    assert len(people) == 60
    assert 12 <= sum(who.allographs[1] == len(ways) - 1 for who in people) <= 28
    (line,) = ways[-1].strokes(np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(line[[0, -1]], [[-0.5, 0], [0.5, 0]], atol=1e-9)
    assert np.ptp(line[:, 1]) < 0.01
    assert (np.diff(line[:, 0]) > 0).all()


def test_people_in_general_write_in_one_stroke_as_often_as_in_two():
    ways = parameters.load(1000).shapes.allographs
    for digit in (5, 7):
        shares = [(way.share, len(way.points)) for way in ways[digit]]
        assert sum(share for share, strokes in shares if strokes == 1) == pytest.approx(0.5)
        assert sum(share for share, _ in shares) == pytest.approx(1)
    assert len(ways[1]) == len(parameters.load().shapes.allographs[1]) + 1
