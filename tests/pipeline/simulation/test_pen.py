"""A recording that grows piece by piece, on the simulation's own skin."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.recordings.events import EVENT_DTYPES
from pipeline.simulation import aces, parameters
from pipeline.simulation.contact import Creep, Receptors, add_vibration, press_skin, spread_force
from pipeline.simulation.handwriting import Motion
from pipeline.simulation.pen import START_S, PenPoint, Writing

P = parameters.read_parameters()
STEP = 1e-3


def swipe(n=400):
    """Down the skin, landing and lifting on the way."""
    time = STEP * np.arange(n)
    force = np.where((time > 0.05) & (time < 0.3), 0.5, 0.0)
    return Motion(time, np.linspace(1, 8, n), np.linspace(3, 5, n), force)


def cuts(n, seed=0):
    return np.split(np.arange(n), np.sort(np.random.default_rng(seed).choice(n, 12)))


def test_the_film_piece_by_piece_is_the_film_at_once():
    motion = swipe()
    _, whole, felt_speed = press_skin(motion, np.ones(100), -1.0, P.skin)  # every taxel
    speed = np.hypot(np.gradient(motion.down, STEP), np.gradient(motion.right, STEP))
    np.testing.assert_allclose(felt_speed, speed)
    Creep(100, STEP, P.skin).advance(whole)
    add_vibration(whole, speed, np.random.default_rng(7), P.skin)
    film, rng, parts = Creep(100, STEP, P.skin), np.random.default_rng(7), []
    for rows in cuts(len(speed)):
        signal = spread_force(motion.down[rows], motion.right[rows], motion.force[rows], P.skin)
        film.advance(signal)
        add_vibration(signal, speed[rows], rng, P.skin)
        parts.append(signal)
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=1e-5, atol=1e-7)


def test_receptors_piece_by_piece_are_receptors_at_once():
    signal = np.cumsum(np.random.default_rng(0).standard_normal((300, 5)), axis=0)
    settings = (np.full(5, 1.5), np.full(5, 1.0), STEP, 3.27e-3, 88e-6)
    whole = Receptors(signal[0], *settings).advance(signal[1:])
    receptors = Receptors(signal[0], *settings)
    parts = [receptors.advance(signal[1:][rows]) for rows in cuts(299)]
    for one, other in zip(zip(*parts, strict=True), whole, strict=True):
        np.testing.assert_array_equal(np.concatenate(one), other)
    assert len(whole[0]) > 50


def test_the_decoder_piece_by_piece_is_the_decoder_at_once():
    rng = np.random.default_rng(0)
    time = np.sort(rng.uniform(0, 3e4, 400))  # so dense that most wait for another's end
    taxel, polarity = rng.integers(0, 100, 400), rng.choice([-1, 1], 400)
    whole = aces.make_bursts(time, taxel, polarity, P.aces)
    decoder, parts, before = aces.Decoder(P.aces), [], 0.0
    for until in (10.0, 5000.0, 5001.0, 2e4, 1e9):
        now = (time > before) & (time <= until + 30)  # receptors look a little past the step
        parts.append(decoder.advance(time[now], taxel[now], polarity[now], until))
        before = until + 30
    for name in EVENT_DTYPES:
        found = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(found, getattr(whole, name))


def written(seed=0, rate_s=0.01, p=P, pieces=None, pressure=0.5):
    """A line downwards in half a second, told at a rate; ``pieces`` divides the time otherwise."""
    writing = Writing([seed], p)
    for t in np.arange(0, 0.5, rate_s):
        writing.add_point(PenPoint(START_S + t, 1 + 14 * t, 4.5, pressure, True))
        if pieces is None:
            writing.advance(START_S + t)
    writing.add_point(PenPoint(START_S + 0.5, 8, 4.5, pressure, False))
    for until in pieces or [writing.settled_s]:
        writing.advance(until)
    return writing


def test_events_follow_the_pen():
    events = written().events
    assert len(events) > 50
    assert events.time_ns[0] >= START_S * 1e9
    near = np.isin(events.taxel // 10, (3, 4, 5, 6))  # columns of the line and beside it
    assert near.mean() > 0.9
    rows = events.taxel[near] % 10
    early, late = np.array_split(rows, 2)
    assert early.mean() + 2 < late.mean()


def test_the_pen_presses_like_the_mean_of_all_digits():
    wide = replace(P, forms=tuple(replace(form, contact=form.contact + 0.5) for form in P.forms))
    hard = replace(P, forms=tuple(replace(form, force=form.force + 0.5) for form in P.forms))
    reached = [len(np.unique(written(p=p).events.taxel)) for p in (P, wide, hard)]
    assert reached[1] > reached[0]
    assert reached[2] > reached[0]


def test_how_time_is_divided_changes_nothing_but_rounding():
    quiet = replace(P, skin=replace(P.skin, noise=0.0, scrape=0.0))
    once = written(p=quiet, pieces=[1.0]).events
    often = written(p=quiet, pieces=list(np.arange(0.2, 1.0, 0.0131)) + [1.0]).events
    assert abs(len(once) - len(often)) <= 2
    assert (
        np.abs(
            np.bincount(once.taxel, minlength=100) - np.bincount(often.taxel, minlength=100)
        ).max()
        <= 1
    )


def test_a_rough_skin_scrapes_more_however_fast_the_pen_is():
    """Beyond ``scrape_speed`` it does not depend on the speed, but on the skin it does."""
    fast = replace(P.skin, scrape_speed=1e-3)
    counts = [
        len(written(p=replace(P, skin=fast, trials=replace(P.trials, scrape=scrape))).events)
        for scrape in (0.0, 1.0)
    ]
    assert counts[0] != counts[1]


def test_a_pen_that_rests_is_silent_after_a_while():
    writing = Writing([0], P)
    writing.add_point(PenPoint(START_S, 4, 4, 0.5, True))
    writing.advance(START_S + 0.5)
    assert len(writing.events) > 0
    assert len(writing.advance(START_S + 1.5)) <= 2


def test_nothing_happens_before_the_pen_comes_or_when_time_goes_back():
    writing = Writing([0], P)
    assert len(writing.advance(3.0)) == 0
    assert writing.time_s == START_S
    writing.add_point(PenPoint(START_S, 4, 4, 0.5, True))
    writing.advance(START_S + 0.2)
    now = writing.time_s
    assert len(writing.advance(START_S)) == 0
    assert writing.time_s == now
    writing.add_point(PenPoint(START_S, 4, 5, 0.5, True))  # told late: counts as from now
    writing.advance(START_S + 0.3)
    assert writing.time_s > now


@pytest.mark.parametrize(
    ("place", "why"),
    [((np.nan, 1), "finite"), ((1, np.inf), "finite"), ((-3, 1), "outside"), ((1, 12), "outside")],
)
def test_points_that_no_pen_makes_are_refused(place, why):
    with pytest.raises(ValueError, match=why):
        Writing([0], P).add_point(PenPoint(START_S, *place, 0.5, True))


def drawn(size, polarities=2):
    """Events of a line over a skin, from near its first taxel to near its last."""
    writing = Writing([1], P, size, polarities)
    for share in np.linspace(0, 1, 30):
        down, right = (share * (side - 1) for side in size)
        writing.add_point(PenPoint(START_S + 0.5 * share, down, right, 0.5, True))
        writing.advance(START_S + 0.5 * share)
    writing.advance(START_S + 0.6)
    return writing
