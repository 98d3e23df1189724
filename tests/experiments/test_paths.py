"""The paths of pens, from recordings whose paths are known."""

import numpy as np
import pytest

from experiments.fidelity import chunk_recordings
from experiments.paths import cut_leaps, find_paths
from pipeline.recordings.sensor import N_TAXELS
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.simulate import SimulationSetup, simulate_recordings


def line(start, end, points=30):
    return np.linspace(start, end, points)


def report(places):
    """Bits of a sensor that reports, in each chunk, the taxels near a place."""
    taxels = np.stack([np.arange(N_TAXELS) % 10, np.arange(N_TAXELS) // 10], 1)
    near = ((places[:, None] - taxels) ** 2).sum(-1) < 1.5
    return np.repeat(near.T[None, :, None], 2, axis=2)


def test_a_path_is_followed():
    places = line([1, 2], [8, 6], 100)
    ((stroke,),) = find_paths(report(places))
    assert np.hypot(*(stroke - places).T).mean() < 0.3


def test_a_lifted_pen_begins_another_stroke():
    places = np.concatenate([line([1, 2], [8, 2], 50), line([2, 7], [8, 7], 50)])
    ((first, second),) = find_paths(report(places))
    assert first[:, 1] == pytest.approx(2, abs=0.4)
    assert second[:, 1] == pytest.approx(7, abs=0.4)


def test_a_hot_taxel_does_not_attract_the_pen():
    places = line([1, 2], [8, 2], 100)
    bits = report(places)
    bits[0, 95] = True
    ((stroke,),) = find_paths(bits)
    assert np.hypot(*(stroke - places).T).max() < 0.8


def test_what_a_pen_does_too_fast_is_not_touched():
    stroke = np.concatenate([line([1, 1], [7, 1]), line([1, 7], [7, 7])])
    first, second = cut_leaps(stroke)
    assert first[:, 1].max() == 1
    assert second[:, 1].min() == 7


def test_the_path_of_simulated_recordings():
    seven = (line([-0.5, -0.3], [-0.5, 0.3]), line([-0.45, 0.3], [0.5, 0.0]))
    joined = (np.concatenate(seven),)
    setup = SimulationSetup(traces=(Trace(7, 0, joined),))
    bits = chunk_recordings(simulate_recordings(0, [0] * 7 + [20, 0, 0], 1, setup=setup))
    ends = []
    for strokes in find_paths(bits):
        points = np.concatenate(strokes)
        ends.append([points[0, 0] < points[-1, 0] - 3, points[0, 1] < points[10, 1] + 0.5])
    assert np.mean(ends) > 0.85
