"""Handwriting as motion: people, what they write, and the pen's movement over the skin.

A digit is a trace: the pen's positions along each stroke at even times, drawn from the model of
handwriting (:mod:`pipeline.simulation.shape_model`) or recorded on a tablet
(``experiments/unipen.py``).  Both are placed on the skin and written with the trace's own speed
along each stroke.
"""

import itertools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.special import expit

from pipeline.simulation.shape_model import DIGITS, ShapeModel, space_points_evenly


@dataclass(frozen=True)
class Trace:
    """One digit as a pen's trajectory.

    Attributes
    ----------
    digit : int
    writer : int
        Number of the writer; -1 if it is not known.
    strokes : tuple of ndarray, shape (n, 2)
        (down, right) along each contact of the pen, evenly spaced in time.  The bounding box of the
        digit has a height of 1 and is centred on 0.
    """

    digit: int
    writer: int
    strokes: tuple


@dataclass(frozen=True)
class Motion:
    """The movement of a pen over the skin.

    Attributes
    ----------
    time_s : ndarray of float, shape (n,)
        Times, evenly spaced.
    down, right : ndarrays of float, shape (n,)
        Position of the tip in taxels: 0 is the centre of the first row or column of taxels.
    force : ndarray of float, shape (n,)
        Force of the tip; 1 is a typical force, 0 in the air.
    """

    time_s: np.ndarray
    down: np.ndarray
    right: np.ndarray
    force: np.ndarray


@dataclass(frozen=True)
class Writer:
    """The habits of one person, the same for all digits.

    Attributes
    ----------
    allographs : tuple of int
        For each digit, the index of this person's habitual way of writing it.
    offsets : ndarray, shape (10, n_ways, rank)
        For each digit and way of writing it, this person's standard normal draws; see
        :meth:`pipeline.simulation.shape_model.Allograph.make_strokes`.
    backwards : ndarray of float, shape (10,)
        From 0 to 1: a digit is drawn from its end to its beginning if this is less than the share
        of the people who do so (``backwards`` of the parameters).
    placing : ndarray, shape (3,)
        Standard normal draws of this person's place and size; see :func:`draw_placing`.
    tempo, force, scrape : float
        Logarithm of the factor on the speed, the force, and the vibration of the sliding tip.
    even : float
        Share, from 0 to 1, by which this person evens out the speed.
    session : float
        From 0 to 1: when this person writes, which determines the hot taxels
        (:mod:`pipeline.simulation.spurious_events`).
    """

    allographs: tuple = ()
    offsets: np.ndarray = field(default_factory=lambda: np.zeros((DIGITS, 0, 0)))
    backwards: np.ndarray = field(default_factory=lambda: np.ones(DIGITS))
    placing: np.ndarray = field(default_factory=lambda: np.zeros(3))
    tempo: float = 0.0
    force: float = 0.0
    scrape: float = 0.0
    even: float = 0.0
    session: float = 0.0


# A writer without any traits, for recorded handwriting.
NOBODY = Writer()


def draw_writer(rng, parameters) -> Writer:
    """Draw a person.

    Parameters
    ----------
    rng : numpy.random.Generator
    parameters : pipeline.simulation.parameters.Parameters
    """
    shapes = parameters.shapes
    size = DIGITS, shapes.most_ways, shapes.highest_rank
    faster, harder, rougher = rng.standard_normal(3)
    habit_share = np.sqrt(parameters.writers.habit)
    return Writer(
        allographs=tuple(draw_way(rng, digit, shapes) for digit in range(DIGITS)),
        offsets=rng.standard_normal(size),
        backwards=rng.random(DIGITS),
        placing=rng.standard_normal(3),
        tempo=parameters.shapes.tempo * faster,
        force=habit_share * parameters.trials.force * harder,
        scrape=habit_share * parameters.trials.scrape * rougher,
        even=rng.random(),
        session=rng.random(),
    )


def draw_way(rng, digit: int, shapes: ShapeModel) -> int:
    """Draw the index of a way of writing a digit with the shares of the ways."""
    shares = shapes.cumulative_shares[digit]
    return int(np.searchsorted(shares, rng.random() * shares[-1], "right"))


class Shape(NamedTuple):
    """What is drawn of a digit's shape.

    Attributes
    ----------
    way : int
        Index of the way of writing.
    along : ndarray, shape (k,)
        Deviation from the way's mean, in units of its components.
    """

    way: int
    along: np.ndarray


def draw_shape(digit: int, who: Writer, rng, shapes: ShapeModel) -> Shape:
    """Draw the shape of one digit as one person writes it this time."""
    choice = who.allographs[digit]
    if rng.random() >= shapes.loyalty[digit]:
        choice = draw_way(rng, digit, shapes)
    way = shapes.allographs[digit][choice]
    person = who.offsets[digit, choice, : way.rank]
    trial = rng.standard_normal(way.rank)
    return Shape(choice, way.between @ person + way.within @ trial)


def write_digit(digit: int, shape: Shape, who: Writer, parameters) -> tuple:
    """The strokes of one digit.

    Parameters
    ----------
    digit : int
    shape : Shape
    who : Writer
    parameters : pipeline.simulation.parameters.Parameters

    Returns
    -------
    tuple of ndarray, shape (n, 2)
        As in a :class:`Trace`.
    """
    strokes = parameters.shapes.allographs[digit][shape.way].make_strokes(shape.along)
    strokes = tuple(space_points_evenly(stroke, who.even) for stroke in strokes)
    if who.backwards[digit] < parameters.writers.backwards[digit]:
        return tuple(stroke[::-1] for stroke in strokes[::-1])
    return strokes


def draw_placing(who: Writer, rng, form, habit: float):
    """Draw the position and size of a digit's box on the skin in one trial.

    Parameters
    ----------
    who : Writer
    rng : numpy.random.Generator
    form : pipeline.simulation.parameters.Form
        Place and height of the digit.
    habit : float
        Share of the variance that is between persons.

    Returns
    -------
    callable
        Function from points of shape (n, 2), in a box of height 1 around 0, to points in taxels.
    """
    drawn = np.sqrt(habit) * who.placing + np.sqrt(1 - habit) * rng.standard_normal(3)
    typical = np.array([form.down, form.right, np.log(form.height)])
    *centre, log_height = typical + np.array(form.variation) @ np.clip(drawn, -2.5, 2.5)
    return lambda points: points * np.exp(log_height) + centre


def measure_duration_s(strokes, kinematics) -> float:
    """Duration in seconds of :func:`move_pen` at tempo 1."""
    return float(_time_points(strokes, 1.0, kinematics)[-1][-1])


def move_pen(strokes, tempo: float, step_s: float, start_s: float, kinematics) -> Motion:
    """Write strokes on the skin.

    Along each stroke the points are evenly spaced in time, so that the writer's changes of speed
    are preserved.  The total duration follows from the length, because the files of tablets rarely
    have a reliable sampling rate and do not have the time between strokes.

    Parameters
    ----------
    strokes : sequence of ndarray, shape (n, 2)
        (down, right) in taxels.
    tempo : float
        Factor on the speed.
    step_s, start_s : float
        Time step, and start of the movement, in seconds.
    kinematics : section ``[kinematics]`` of ``parameters.toml``

    Returns
    -------
    Motion
        From ``kinematics.landing_s`` before the first stroke to ``kinematics.settle_s`` after the
        last one.
    """
    clock = _time_points(strokes, tempo, kinematics)
    end_s = clock[-1][-1]
    time_s = np.arange(-kinematics.landing_s, end_s + kinematics.settle_s, step_s)
    path = PchipInterpolator(np.concatenate(clock), np.concatenate(strokes))
    down, right = path(np.clip(time_s, 0, end_s)).T
    lands_s, lifts_s = np.array([(stroke[0], stroke[-1]) for stroke in clock]).T
    force = compute_contact_force(time_s, lands_s, lifts_s, kinematics)
    return Motion(start_s + time_s, down, right, force)


def _time_points(strokes, tempo, kinematics):
    """Time of each point of each stroke, from the first point on."""
    path = sum(np.hypot(*np.diff(stroke, axis=0).T).sum() for stroke in strokes)
    interval = (
        max(path, 1.0) / kinematics.speed / tempo / sum(len(stroke) - 1 for stroke in strokes)
    )
    clock = [interval * np.arange(len(strokes[0]))]
    for before, stroke in itertools.pairwise(strokes):
        # Isochrony: the way through the air takes less than twice the time for twice the length.
        leap = max(np.hypot(*(stroke[0] - before[-1])), 0.3)
        lands = (
            clock[-1][-1]
            + kinematics.lift_s * (leap / kinematics.lift_taxels) ** kinematics.isochrony / tempo
        )
        clock.append(lands + interval * np.arange(len(stroke)))
    return clock


def compute_contact_force(time_s, lands_s, lifts_s, kinematics):
    """Force over time: 0 in the air and 1 on the skin, rising and falling smoothly.

    Parameters
    ----------
    time_s : ndarray of float, shape (n,)
    lands_s, lifts_s : ndarrays of float, shape (n_contacts,)
    kinematics : section ``[kinematics]`` of ``parameters.toml``
    """
    width_s = kinematics.landing_s / 4
    rise = expit((time_s[:, None] - lands_s) / width_s)
    fall = expit((lifts_s - time_s[:, None]) / width_s)
    force = (rise * fall).max(axis=1)
    return np.where(force < 0.02, 0.0, force)
