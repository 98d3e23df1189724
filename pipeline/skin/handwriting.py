"""Handwriting as motion: the kinematic theory of rapid human movement.

A digit is an action plan, a list of points that the pen aims at.  Each stroke towards the next
point sets off before the last has come to rest; its speed follows a lognormal, its direction turns
steadily along a circular arc, and the pen's velocity is the vector sum of all strokes (the
sigma-lognormal model; R. Plamondon, "A kinematic theory of rapid human movements", Biological
Cybernetics 72, 1995; R. Plamondon and M. Djioua, Human Movement Science 25, 2006).
"""

from __future__ import annotations

import functools
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import expit, ndtr, ndtri

LOGNORMAL_REACH = 2.3
"""Standard deviations of the logarithm of time on either side that count as a stroke's length."""

MOST_TURN = 3.6
"""Largest turn of a stroke in radians; close to a full turn its circle would grow without bound."""


@dataclass(frozen=True)
class ActionPlan:
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
    tempo, force, scrape : float
        Logarithm of the factor on the speed, the force, and the vibration of the sliding tip.
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
    scrape: float
    sloppiness: float


NOBODY = Writer(
    allographs=(0,) * 10,
    habits=(),
    slant=0.0,
    tilt=0.0,
    height=0.0,
    width=0.0,
    down=0.0,
    right=0.0,
    tempo=0.0,
    force=0.0,
    scrape=0.0,
    sloppiness=1.0,
)
"""A writer without any traits, to hold the pen for recorded handwriting."""


def read_allographs() -> dict:
    """``allographs.toml`` as plain values: ways of writing, by digit."""
    return tomllib.loads(Path(__file__).with_name("allographs.toml").read_text("utf-8"))["digit"]


@functools.cache
def allographs() -> tuple:
    """Ways of writing each digit, from ``allographs.toml``.

    Returns
    -------
    tuple of tuple of (float, ActionPlan)
        For each digit, the share of writers with the habit, and the plan in a box of unit size.
    """
    digits = read_allographs()
    return tuple(
        tuple((entry["share"], _plan(entry["path"])) for entry in digits[str(digit)])
        for digit in range(10)
    )


def _plan(path):
    strokes = path[1:]
    return ActionPlan(
        points=np.array([[point[1], point[0]] for point in path], float),
        turns=np.radians([stroke[2] if len(stroke) > 2 else 0.0 for stroke in strokes]),
        in_air=np.array([len(stroke) > 3 for stroke in strokes]),
    )


def writers(rng, p) -> tuple:
    """Draw the people of an experiment.

    Each trait takes as many equally likely values as there are people, dealt out at random, so
    that every group is like every other on the whole and no seed gets only light-handed people.

    Parameters
    ----------
    rng : numpy.random.Generator
    p : pipeline.skin.parameters.Writers

    Returns
    -------
    tuple of Writer
    """
    deal = _Deal(rng, p.count)
    choices = np.array([deal.choices([share for share, _ in ways]) for ways in allographs()])
    traits = {
        name: getattr(p, name) * deal.normal()
        for name in ("slant", "tilt", "height", "width", "tempo", "force", "scrape")
    }
    down, right, sloppiness = (deal.normal() for _ in range(3))
    return tuple(
        Writer(
            allographs=tuple(int(choice) for choice in choices[:, who]),
            habits=tuple(
                p.habit * rng.standard_normal(ways[choice][1].points.shape)
                for ways, choice in zip(allographs(), choices[:, who], strict=True)
            ),
            **{name: float(values[who]) for name, values in traits.items()},
            down=float(p.place[0] * down[who]),
            right=float(p.place[1] * right[who]),
            sloppiness=float(np.exp(p.sloppiness * sloppiness[who])),
        )
        for who in range(p.count)
    )


class _Deal:
    """Stratified draws for a group: quantiles in random order."""

    def __init__(self, rng, count):
        self.rng, self.count = rng, count

    def normal(self):
        """Standard normal quantiles, in random order."""
        return ndtri((self.rng.permutation(self.count) + 0.5) / self.count)

    def choices(self, shares):
        """Indices that occur as often as their shares ask for, in random order."""
        level = (np.arange(self.count) + self.rng.random()) / self.count
        chosen = np.searchsorted(np.cumsum(shares) / np.sum(shares), level)
        return self.rng.permutation(np.minimum(chosen, len(shares) - 1))


def plan(digit: int, who: Writer, rng, p, form) -> ActionPlan:
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
    habit = who.habits[digit] if choice == who.allographs[digit] else 0.0
    wobble = p.wobble * who.sloppiness * rng.standard_normal(base.points.shape)
    rounder = p.roundness * who.sloppiness * rng.standard_normal(len(base.turns))
    place = placing(who, rng, p, form.height, form.width, form.down, form.right)
    return ActionPlan(
        points=place(base.points - 0.5 + habit + wobble),
        turns=np.clip(base.turns * np.exp(rounder), -MOST_TURN, MOST_TURN),
        in_air=base.in_air,
    )


def placing(who: Writer, rng, p, height, width, down, right):
    """How a digit's box comes to lie on the skin this time.

    Parameters
    ----------
    who : Writer
    rng : numpy.random.Generator
    p : pipeline.skin.parameters.Trials
    height, width, down, right : float
        Usual size and centre of the box, in taxels.

    Returns
    -------
    callable
        From points of shape (n, 2) in a unit box around 0 to points in taxels.
    """
    slant, tilt, higher, wider, lower, righter = who.sloppiness * rng.standard_normal(6)
    scale = [
        height * np.exp(who.height + p.size * higher),
        width * np.exp(who.width + p.size * wider),
    ]
    shear = np.array([[1, 0], [-np.tan(who.slant + p.slant * slant), 1]])
    angle = who.tilt + p.tilt * tilt
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centre = [down + who.down + p.place[0] * lower, right + who.right + p.place[1] * righter]
    return lambda points: points * scale @ shear.T @ turn.T + centre


def length_s(plan: ActionPlan, p) -> float:
    """Seconds from the first stroke's start to the last one's end, at tempo 1."""
    begin, last = _timing(plan, 1.0, p)
    return float(begin[-1] + last[-1])


def move(plan: ActionPlan, tempo: float, step_s: float, start_s: float, p) -> Motion:
    """Carry out a plan.

    Stroke ``i`` starts while the one before it still moves.  At time ``t`` it has covered the share
    ``F_i(t)``, a lognormal distribution function, of its arc.  Since the arc is a circle's, the
    stroke's displacement is known in closed form, and the pen's is the sum over the strokes.

    Parameters
    ----------
    plan : ActionPlan
        In taxels.
    tempo : float
        Factor on the speed.
    step_s, start_s : float
        Time step, and time of setting off, in seconds.
    p : pipeline.skin.parameters.Kinematics

    Returns
    -------
    Motion
        From ``p.landing_s`` before the first stroke to ``p.settle_s`` after the last one.
    """
    begin, last = _timing(plan, tempo, p)
    time = np.arange(-p.landing_s, begin[-1] + last[-1] + p.settle_s, step_s)
    # A lognormal whose reach on either side of the median is the stroke's time.
    median = last / (2 * np.sinh(LOGNORMAL_REACH * p.sigma))
    onset = begin - median * np.exp(-LOGNORMAL_REACH * p.sigma)
    since = np.maximum(time[:, None] - onset, 1e-9)
    share = ndtr(np.log(since / median) / p.sigma)  # (time, stroke)

    chord = np.diff(plan.points, axis=0)
    heading = np.arctan2(chord[:, 0], chord[:, 1]) - plan.turns / 2
    # Half the turn so far, on either side of the chord so far: no special case for straight lines.
    half = plan.turns * share / 2
    covered = _arc(plan) * share * np.sinc(half / np.pi)
    return Motion(
        time_s=start_s + time,
        down=plan.points[0, 0] + (covered * np.sin(heading + half)).sum(axis=1),
        right=plan.points[0, 1] + (covered * np.cos(heading + half)).sum(axis=1),
        force=on_skin(time, *_contacts(plan, begin, last, p), p),
    )


def _arc(plan):
    """Length of each stroke along its arc."""
    return np.hypot(*np.diff(plan.points, axis=0).T) / np.sinc(plan.turns / (2 * np.pi))


def _timing(plan, tempo, p):
    """Start and length in time of each stroke."""
    # Isochrony: a stroke of twice the length takes less than twice the time.
    arc = np.maximum(_arc(plan), 0.3)
    last = p.stroke_s * (arc / p.stroke_taxels) ** p.isochrony / tempo
    return np.concatenate([[0.0], np.cumsum(last[:-1] * (1 - p.overlap))]), last


def _contacts(plan, begin, last, p):
    """Times at which the pen comes down and is lifted."""
    down = ~plan.in_air
    edges = np.flatnonzero(np.diff(np.concatenate([[False], down, [False]]).astype(int)))
    first, after = edges.reshape(-1, 2).T
    return begin[first], begin[after - 1] + p.lift * last[after - 1]


def on_skin(time, lands, lifts, p):
    """Force over time: 0 in the air and 1 on the skin, rising and falling smoothly.

    Parameters
    ----------
    time : ndarray of float, shape (n,)
    lands, lifts : ndarrays of float, shape (n_contacts,)
    p : pipeline.skin.parameters.Kinematics
    """
    width = p.landing_s / 4
    rise = expit((time[:, None] - lands) / width)
    fall = expit((lifts - time[:, None]) / width)
    force = (rise * fall).max(axis=1)
    return np.where(force < 0.02, 0.0, force)
