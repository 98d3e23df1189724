"""Pen trajectories that are written on the sensor of the live page."""

import numpy as np
import pytest

from experiments import pens
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.pen import START_S

# A vertical line, and an angle of two strokes.
LINE = Trace(1, 0, (np.array([[-0.5, 0.0], [0.0, 0.0], [0.5, 0.0]]),))
ANGLE = Trace(7, 0, (np.array([[-0.5, -0.3], [-0.5, 0.3]]), np.array([[-0.5, 0.3], [0.5, 0.0]])))


class _Middle:
    """Draws that are the middle of each interval, and no deviation from a mean."""

    def uniform(self, low, high):
        return (low + high) / 2

    def standard_normal(self, size):
        return np.zeros(size)


def test_points_of_a_line_have_the_drawn_size_and_place():
    points = pens.make_points(LINE, _Middle(), (10, 10))
    height = 7.25
    assert [point.down for point in points] == pytest.approx(
        [4.5 - height / 2, 4.5, 4.5 + height / 2, 4.5 + height / 2]
    )
    assert {point.right for point in points} == {4.5}


def test_points_of_a_line_have_the_drawn_speed():
    points = pens.make_points(LINE, _Middle(), (10, 10))
    seconds = 7.25 / 29.0  # height over speed
    assert [point.time_s - START_S for point in points] == pytest.approx(
        [0, seconds / 2, seconds, seconds]
    )
    assert [point.touches for point in points] == [True, True, True, False]


def test_the_pen_lifts_between_strokes():
    points = pens.make_points(ANGLE, _Middle(), (10, 10))
    lifted = [index for index, point in enumerate(points) if not point.touches]
    assert lifted == [2, 5]
    assert points[3].time_s - points[2].time_s == pytest.approx(pens.PAUSE_S)


def test_a_reversed_line_begins_where_the_other_ends():
    reversed_angle = pens.reverse_trace(ANGLE)
    assert reversed_angle.strokes[0][0].tolist() == [0.5, 0.0]
    assert reversed_angle.strokes[-1][-1].tolist() == [-0.5, -0.3]


def test_the_included_network_reads_straight_lines(tmp_path):
    network = pens.read_bundle(pens.SHIPPED)
    sensor = pens.find_sensor(network)
    decider = pens.make_decider(network, sensor)
    (row,) = pens.measure(decider, sensor, {"1": [LINE] * 8}, 0, lambda number: None)
    assert row["written"] == 8
    assert row["right"] >= 6
