"""Handwriting as motion: the kinematic theory of rapid human movement.

A digit is an action plan, a list of points that the pen aims at.  Each stroke towards the next
point sets off before the last has come to rest; its speed follows a lognormal, its direction turns
steadily along a circular arc, and the pen's velocity is the vector sum of all strokes (the
sigma-lognormal model; R. Plamondon, "A kinematic theory of rapid human movements", Biological
Cybernetics 72, 1995; R. Plamondon and M. Djioua, Human Movement Science 25, 2006).
"""

from __future__ import annotations

import functools
import importlib.resources
import tomllib
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

LOGNORMAL_REACH = 2.3
"""Standard deviations of the logarithm of time on either side that count as a stroke's length."""


@dataclass(frozen=True)
class Plan:
    """Points that the pen aims at.

    Attributes
    ----------
    points : ndarray of float, shape (n + 1, 2)
        (down, right): in a box one high and one wide, or in taxels once it is placed on the skin.
    turns : ndarray of float, shape (n,)
        Angle in radians by which each stroke turns on its way, positive clockwise.
    in_air : ndarray of bool, shape (n,)
        Whether the pen is lifted during the stroke.
    """

    points: np.ndarray
    turns: np.ndarray
    in_air: np.ndarray


@dataclass(frozen=True)
class Motion:
    """The movement of a pen over the skin.

    Attributes
    ----------
    time_s : ndarray of float, shape (n,)
        Evenly spaced.
    down, right : ndarrays of float, shape (n,)
        Position of the tip in taxels: 0 is the centre of the first row or column of taxels.
    force : ndarray of float, shape (n,)
        Force of the tip, 1 for a person who presses neither hard nor lightly; 0 in the air.
    """

    time_s: np.ndarray
    down: np.ndarray
    right: np.ndarray
    force: np.ndarray


@dataclass(frozen=True)
class Writer:
    """What stays the same from digit to digit of one person.

    Attributes
    ----------
    allographs : tuple of int
        For each digit, which way of writing it is this person's habit.
    habits : tuple of ndarray
        For each digit, shape (n + 1, 2): where this person's points stand off the usual ones.
    slant, tilt : float
        Shear to the right, and rotation, in radians.
    height, width : float
        Logarithm of this person's factor on the size of digits.
    down, right : float
        Where this person writes, off the usual place, in taxels.
    tempo, force : float
        Logarithm of the factor on speed and force.
    sloppiness : float
        Factor on the variation from one digit to the next.
    """

    allographs: tuple
    habits: tuple
    slant: float
    tilt: float
    height: float
    width: float
    down: float
    right: float
    tempo: float
    force: float
    sloppiness: float


@functools.cache
def allographs() -> tuple:
    """Ways of writing each digit, from ``allographs.toml``.

    Returns
    -------
    tuple of tuple of (float, Plan)
        For each digit, the share of writers with the habit, and the plan in a box of unit size.
    """
    text = importlib.resources.files(__package__).joinpath("allographs.toml").read_text("utf-8")
    digits = tomllib.loads(text)["digit"]
    return tuple(
        tuple((entry["share"], _plan(entry["path"])) for entry in digits[str(digit)])
        for digit in range(10)
    )


def _plan(path):
    strokes = path[1:]
    return Plan(
        points=np.array([[point[1], point[0]] for point in path], float),
        turns=np.radians([stroke[2] if len(stroke) > 2 else 0.0 for stroke in strokes]),
        in_air=np.array([len(stroke) > 3 for stroke in strokes]),
    )


def writer(rng, p) -> Writer:
    """Draw a person.

    Parameters
    ----------
    rng : numpy.random.Generator
    p : pipeline.skin.parameters.Writers
    """
    choices = tuple(
        int(rng.choice(len(ways), p=[share for share, _ in ways])) for ways in allographs()
    )
    habits = tuple(
        p.habit * rng.standard_normal(ways[choice][1].points.shape)
        for ways, choice in zip(allographs(), choices, strict=True)
    )
    slant, tilt, height, width, down, right, tempo, force, sloppiness = rng.standard_normal(9)
    return Writer(
        allographs=choices,
        habits=habits,
        slant=p.slant * slant,
        tilt=p.tilt * tilt,
        height=p.height * height,
        width=p.width * width,
        down=p.place * down,
        right=p.place * right,
        tempo=p.tempo * tempo,
        force=p.force * force,
        sloppiness=float(np.exp(p.sloppiness * sloppiness)),
    )


def plan(digit: int, who: Writer, rng, p, form) -> Plan:
    """One digit as one person sets out to write it this time, placed on the skin.

    Parameters
    ----------
    digit : int
    who : Writer
    rng : numpy.random.Generator
    p : pipeline.skin.parameters.Trials
        Variation from trial to trial.
    form : pipeline.skin.parameters.Form
        Usual size and place of this digit.
    """
    ways = allographs()[digit]
    choice = who.allographs[digit]
    if rng.random() < p.other_allograph:
        choice = int(rng.choice(len(ways), p=[share for share, _ in ways]))
    base = ways[choice][1]
    sloppy = who.sloppiness
    wobble = p.wobble * sloppy * rng.standard_normal(base.points.shape)
    habit = who.habits[digit] if choice == who.allographs[digit] else 0.0
    points = base.points + habit + wobble - 0.5
    slant, tilt, height, width, down, right = rng.standard_normal(6)
    points = points * [
        form.height * np.exp(who.height + p.size * sloppy * height),
        form.width * np.exp(who.width + p.size * sloppy * width),
    ]
    shear = who.slant + p.slant * sloppy * slant
    angle = who.tilt + p.tilt * sloppy * tilt
    points[:, 1] -= np.tan(shear) * points[:, 0]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = [
        form.down + who.down + p.place * sloppy * down,
        form.right + who.right + p.place * sloppy * right,
    ]
    turns = base.turns * np.exp(p.roundness * sloppy * rng.standard_normal(len(base.turns)))
    return Plan(points @ turn.T + centre, np.clip(turns, -3.6, 3.6), base.in_air)


def move(plan: Plan, tempo: float, step_s: float, start_s: float, p) -> Motion:
    """Carry out a plan.

    Stroke ``i`` starts while the one before it still moves.  At time ``t`` it has covered the share
    ``F_i(t)``, a lognormal distribution function, of its arc; since the arc is a circle's, the
    pen's position is a sum in closed form (Plamondon and Djioua 2006, equations 5 to 7,
    integrated).

    Parameters
    ----------
    plan : Plan
        In taxels.
    tempo : float
        Factor on the speed.
    step_s, start_s : float
        Time step, and time of setting off, in seconds.
    p : pipeline.skin.parameters.Kinematics
    """
    chord = np.diff(plan.points, axis=0)
    length = np.hypot(*chord.T)
    half = plan.turns / 2
    arc = length * np.where(half == 0, 1, half / np.sin(np.where(half == 0, 1, half)))
    # Isochrony: a stroke of twice the length takes less than twice the time.
    last = p.stroke_s * (np.maximum(arc, 0.3) / p.stroke_taxels) ** p.isochrony / tempo
    begin = np.concatenate([[0.0], np.cumsum(last[:-1] * (1 - p.overlap))])
    time = np.arange(0, begin[-1] + last[-1] + 2 * p.landing_s, step_s) - p.landing_s

    # Lognormal from begin to begin + last: reaches of its logarithm on either side of the median.
    median = last / (2 * np.sinh(LOGNORMAL_REACH * p.sigma))
    onset = begin - median * np.exp(-LOGNORMAL_REACH * p.sigma)
    since = np.maximum(time[:, None] - onset, 1e-9)
    share = ndtr(np.log(since / median) / p.sigma)  # (time, stroke)
    heading = np.arctan2(chord[:, 0], chord[:, 1]) - half
    turned = plan.turns * share
    straight = np.abs(plan.turns) < 1e-6
    radius = arc / np.where(straight, 1, plan.turns)
    right = np.where(
        straight,
        arc * share * np.cos(heading),
        radius * (np.sin(heading + turned) - np.sin(heading)),
    )
    down = np.where(
        straight,
        arc * share * np.sin(heading),
        radius * (np.cos(heading) - np.cos(heading + turned)),
    )
    return Motion(
        time_s=start_s + time,
        down=plan.points[0, 0] + down.sum(axis=1),
        right=plan.points[0, 1] + right.sum(axis=1),
        force=_on_skin(time, begin, last, plan.in_air, p),
    )


def _on_skin(time, begin, last, in_air, p):
    """Force from 0 in the air to 1 on the skin, rising and falling smoothly."""
    force = np.zeros(len(time))
    edges = np.flatnonzero(np.diff(np.concatenate([[True], in_air, [True]]).astype(int)))
    for first, after in edges.reshape(-1, 2):
        # The pen is down before it sets off and lifted as it comes to rest.
        here, gone = begin[first], begin[after - 1] + last[after - 1] * p.lift
        width = p.landing_s / 4
        rise = 1 / (1 + np.exp(-(time - here) / width))
        fall = 1 / (1 + np.exp((time - gone) / width))
        force = np.maximum(force, rise * fall)
    return np.where(force < 0.02, 0.0, force)
