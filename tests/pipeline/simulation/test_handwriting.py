"""Pens: strokes, contacts, people."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulation import handwriting, parameters, shape_model
from pipeline.simulation.handwriting import move_pen

P = parameters.read_parameters()
STEP = 1e-3


def line(start, end, points=20):
    return np.linspace(start, end, points)


def test_the_pen_follows_a_stroke_and_rests_at_its_end():
    pen = move_pen([line([1, 2], [7, 2])], 1.0, STEP, 0.2, P.kinematics)
    assert np.allclose(pen.right, 2)
    assert (pen.down[0], pen.down[-1]) == pytest.approx((1, 7))
    assert pen.force[0] == pen.force[-1] == 0
    # 6 taxels at the usual speed, the landing before them, and the film's rest after them.
    time = P.kinematics.landing_s + 6 / P.kinematics.speed + P.kinematics.settle_s
    assert pen.time_s[-1] - pen.time_s[0] == pytest.approx(time, abs=2 * STEP)


def test_the_pen_is_slow_where_the_trace_is():
    down = np.concatenate([np.linspace(0, 1, 11), np.linspace(1, 7, 11)[1:]])  # slow, then fast
    pen = move_pen([np.stack([down, np.zeros(21)], 1)], 1.0, STEP, 0.0, P.kinematics)
    middle = np.interp(np.mean([0, 7 / P.kinematics.speed]), pen.time_s, pen.down)
    assert middle == pytest.approx(1, abs=0.05)


def test_the_pen_is_in_the_air_between_strokes():
    strokes = [line([0, 0], [0, 5]), line([5, 0], [5, 5])]
    pen = move_pen(strokes, 1.0, STEP, 0.2, P.kinematics)
    down = pen.force > 0.5
    assert np.flatnonzero(np.diff(down.astype(int)) == 1).size == 2
    lifted, landed = np.flatnonzero(np.diff((pen.force == 0).astype(int)))[1:3]
    assert pen.time_s[landed] - pen.time_s[lifted] > 0.05


@given(st.floats(0.5, 3.0))
def test_tempo_scales_time_only(tempo):
    strokes = [line([0, 0], [4, 1]), line([0, 5], [6, 5], 9)]
    length = handwriting.measure_duration_s(strokes, P.kinematics)
    pen = move_pen(strokes, tempo, STEP, 0.0, P.kinematics)
    assert pen.time_s[-1] == pytest.approx(length / tempo + P.kinematics.settle_s, abs=2 * STEP)
    assert (pen.down[-1], pen.right[-1]) == pytest.approx((6, 5))


def people(count, p=P):
    return [handwriting.draw_writer(np.random.default_rng([7, who]), p) for who in range(count)]


def written(digit, who, seed, p=P):
    rng = np.random.default_rng(seed)
    shape = handwriting.draw_shape(digit, who, rng, p.shapes)
    return handwriting.write_digit(digit, shape, who, p)


def test_people_differ_as_the_parameters_say():
    everybody = people(2000)
    for trait, spread in (
        ("tempo", P.shapes.tempo),
        ("force", np.sqrt(P.writers.habit) * P.trials.force),
    ):
        values = np.array([getattr(who, trait) for who in everybody])
        assert abs(values.mean()) < 0.1 * spread
        assert values.std() == pytest.approx(spread, rel=0.1)
    habits = np.array([who.allographs for who in everybody])
    for digit, ways in enumerate(P.shapes.allographs):
        total = sum(way.share for way in ways)
        for choice, way in enumerate(ways):
            assert np.mean(habits[:, digit] == choice) == pytest.approx(way.share / total, abs=0.04)


def test_a_person_does_not_depend_on_the_number_of_people():
    one, other = (
        handwriting.draw_writer(
            np.random.default_rng([7, 3]), parameters.read_parameters(parameters.Population(count))
        )
        for count in (10, 99)
    )
    assert one.tempo == other.tempo
    assert one.allographs == other.allographs


def test_a_digit_is_one_high_and_in_the_middle():
    for digit in range(10):
        points = np.concatenate(written(digit, people(1)[0], digit))
        assert np.ptp(points[:, 0]) == pytest.approx(1, abs=0.02)
        assert points.max(axis=0) == pytest.approx(-points.min(axis=0), abs=0.02)


def test_a_writer_writes_in_the_way_of_a_habit_mostly():
    who, rng = people(2)[1], np.random.default_rng(2)
    chosen = [handwriting.draw_shape(5, who, rng, P.shapes).way for _ in range(400)]
    ways, habit = P.shapes.allographs[5], who.allographs[5]
    share = ways[habit].share / sum(way.share for way in ways)
    expected = P.shapes.loyalty[5] + (1 - P.shapes.loyalty[5]) * share
    assert np.mean(np.array(chosen) == habit) == pytest.approx(expected, abs=0.07)


def test_some_people_draw_a_0_from_its_end_to_its_beginning():
    who = people(1)[0]
    forth = written(0, replace(who, backwards=np.ones(10)), 3)
    back = written(0, replace(who, backwards=np.zeros(10)), 3)
    np.testing.assert_allclose(np.concatenate(forth)[::-1], np.concatenate(back))
    share = np.mean([one.backwards[0] < P.writers.backwards[0] for one in people(2000)])
    assert share == pytest.approx(P.writers.backwards[0], abs=0.03)
    assert share > 0


def test_placing_by_hand():
    form = SimpleNamespace(height=8, down=5, right=6, variation=np.zeros((3, 3)))
    place = handwriting.draw_placing(handwriting.NOBODY, np.random.default_rng(0), form, 0.5)
    corners = place(np.array([[-0.5, -0.5], [0.5, 0.5]]))
    np.testing.assert_allclose(corners, [[1, 2], [9, 10]])


def test_places_vary_as_the_form_says():
    root = np.array([[0.6, 0.0, 0.0], [0.3, 0.7, 0.0], [0.02, -0.05, 0.1]])
    form = SimpleNamespace(height=8, down=5, right=6, variation=root)
    drawn = []
    for number in range(3000):
        rng = np.random.default_rng(number)
        who = handwriting.Writer(placing=rng.standard_normal(3))
        top, bottom = handwriting.draw_placing(who, rng, form, 0.4)(np.array([[-0.5, 0], [0.5, 0]]))
        drawn.append([*(top + bottom) / 2, np.log(bottom[0] - top[0])])
    np.testing.assert_allclose(np.mean(drawn, axis=0), [5, 6, np.log(8)], atol=0.05)
    np.testing.assert_allclose(np.cov(np.transpose(drawn)), root @ root.T, atol=0.06)


def test_some_people_write_a_1_as_one_straight_line():
    straight = shape_model.read_tablet_model().allographs[1][-1]
    (line,) = straight.make_strokes(np.zeros(3))
    np.testing.assert_allclose(line[[0, -1], 0], [-0.5, 0.5], atol=1e-9)
    assert np.ptp(line[:, 1]) < 0.2
    assert (np.diff(line[:, 0]) > 0).all()
