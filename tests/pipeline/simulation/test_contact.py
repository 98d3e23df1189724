"""Contact and film."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from pipeline.simulation import parameters
from pipeline.simulation.contact import Creep, add_vibration, press_skin
from pipeline.simulation.handwriting import Motion

P = parameters.read_parameters().skin
QUIET = replace(P, scrape=0.0, noise=0.0)
STEP = 1e-3


def resting(down, right, force):
    force = np.asarray(force, float)
    n = len(force)
    return Motion(STEP * np.arange(n), np.full(n, float(down)), np.full(n, float(right)), force)


def signal_of(motion, gain, least, seed, p):
    """Taxels and their signal, all the way through the film."""
    rng = np.random.default_rng(seed)
    taxels, felt, speed = press_skin(motion, gain, least, p)
    Creep(len(taxels), STEP, p).advance(felt)
    add_vibration(felt, speed, rng, p)
    return taxels, felt


def image(motion, p=QUIET, gain=None, row=-1):
    gain = np.ones(100) if gain is None else gain
    taxels, signal = signal_of(motion, gain, 1e-6, 0, p)
    full = np.zeros(100)
    full[taxels] = signal[row]
    return full.reshape(10, 10).T  # address runs down the rows first


def test_pressure_spreads_to_neighbours_around_the_tip():
    pressed = image(resting(3, 6, [1.0] * 2000))
    assert np.unravel_index(pressed.argmax(), (10, 10)) == (3, 6)
    assert pressed[3, 6] == pytest.approx(1, abs=1e-3)
    beside = np.exp(-0.5 / P.spread**2)
    for neighbour in ((2, 6), (4, 6), (3, 5), (3, 7)):
        assert pressed[neighbour] == pytest.approx(beside, abs=1e-3)


def test_gain_is_the_taxels_own():
    gain = np.ones(100)
    gain[63] = 2.0  # row 3, column 6
    even = image(resting(3, 6, [1.0] * 500))
    uneven = image(resting(3, 6, [1.0] * 500), gain=gain)
    assert uneven[3, 6] == pytest.approx(2 * even[3, 6])
    assert uneven[4, 6] == pytest.approx(even[4, 6])


def test_the_film_comes_back_later_than_it_went():
    up_and_down = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, 0, 200)])
    motion = resting(3, 6, up_and_down)
    rising, falling = (image(motion, row=row)[3, 6] for row in (100, 299))
    assert motion.force[100] == pytest.approx(motion.force[299], abs=1e-9)
    assert falling > rising + 0.02


def test_only_a_sliding_tip_scrapes():
    n = 1000
    still = resting(5, 5, np.ones(n))
    sliding = replace(still, right=np.linspace(4, 6, n) + 0.0)
    p = replace(P, noise=0.0)

    def restless(motion):
        _, signal = signal_of(motion, np.ones(100), 0.5, 1, p)
        return np.abs(np.diff(signal, 2, axis=0)).max()

    assert restless(still) < 1e-3
    assert restless(sliding) > 10 * restless(still)


def test_the_film_is_a_filter_of_first_order():
    felt = np.random.default_rng(0).standard_normal((300, 7)).astype(np.float32)
    lag = np.exp(-STEP / P.creep_s)
    late = lfilter([1 - lag], [1, -lag], felt.astype(float), axis=0)
    expected = felt + P.creep * (late - felt)
    Creep(7, STEP, P).advance(felt)
    np.testing.assert_allclose(felt, expected, rtol=1e-5, atol=1e-6)
