"""Handwriting as motion: people, what they write, and the pen's movement over the skin.

A digit is a trace: the pen's positions along each stroke at even times, drawn from the model of
handwriting (:mod:`pipeline.simulation.shape_model`) or recorded on a tablet
(``experiments/unipen.py``).  Both are placed on the skin and written with the trace's own speed
along each stroke.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.special import expit, ndtr, ndtri

from pipeline.simulation.shape_model import ShapeModel, boxed, evened


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
        Evenly spaced.
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
    offsets : tuple of tuple of ndarray
        For each digit and each way of writing it, this person's standard normal draws; see
        :meth:`pipeline.simulation.shape_model.Allograph.strokes`.
    slant : float
        Shear to the right, as its tangent.
    width : float
        Logarithm of this person's factor on the width of digits.
    size : float
        Logarithm of this person's factor on the height and the width of digits.
    down, right : float
        Offset of this person's writing from the usual place, in taxels.
    tempo, force, scrape : float
        Logarithm of the factor on the speed, the force, and the vibration of the sliding tip.
    sloppiness : float
        Factor on the variation of place and size from one digit to the next.
    even : float
        Share, from 0 to 1, by which this person evens out the speed.
    """

    allographs: tuple = ()
    offsets: tuple = ()
    slant: float = 0.0
    width: float = 0.0
    size: float = 0.0
    down: float = 0.0
    right: float = 0.0
    tempo: float = 0.0
    force: float = 0.0
    scrape: float = 0.0
    sloppiness: float = 1.0
    even: float = 0.0


# A writer without any traits, for recorded handwriting.
NOBODY = Writer()


def writers(rng, p, shapes: ShapeModel) -> tuple:
    """Draw the people of an experiment.

    Each trait takes as many equally likely values as there are people, assigned at random, so that
    the groups of all seeds are similar on average.

    Parameters
    ----------
    rng : numpy.random.Generator
    p : section ``[writers]`` of ``parameters.toml``
    shapes : ShapeModel

    Returns
    -------
    tuple of Writer
    """
    deal = _Deal(rng, p.count)
    choices = np.array([deal.choices(_shares(ways)) for ways in shapes.allographs])
    spreads = {
        "slant": shapes.slant,
        "width": shapes.width,
        "size": p.size,
        "tempo": shapes.tempo,
        "force": p.force,
        "scrape": p.scrape,
    }
    traits = {name: spread * deal.normal() for name, spread in spreads.items()}
    down, right, sloppiness = (deal.normal() for _ in range(3))
    # Drawn only if it is used: the paper's people stay as they are.
    traits["even"] = shapes.evenness * ndtr(deal.normal()) if shapes.evenness else np.zeros(p.count)
    return tuple(
        Writer(
            allographs=tuple(int(choice) for choice in choices[:, who]),
            offsets=tuple(
                tuple(rng.standard_normal(way.rank) for way in ways) for ways in shapes.allographs
            ),
            **{name: float(values[who]) for name, values in traits.items()},
            down=float(p.place[0] * down[who]),
            right=float(p.place[1] * right[who]),
            sloppiness=float(np.exp(p.sloppiness * sloppiness[who])),
        )
        for who in range(p.count)
    )


def _shares(ways):
    shares = np.array([way.share for way in ways])
    return shares / shares.sum()


class _Deal:
    """Stratified draws for a group: quantiles in random order."""

    def __init__(self, rng, count):
        self.rng, self.count = rng, count

    def normal(self):
        """Standard normal quantiles, in random order."""
        return ndtri((self.rng.permutation(self.count) + 0.5) / self.count)

    def choices(self, shares):
        """Indices with frequencies according to their shares, in random order."""
        level = (np.arange(self.count) + self.rng.random()) / self.count
        chosen = np.searchsorted(np.cumsum(shares), level)
        return self.rng.permutation(np.minimum(chosen, len(shares) - 1))


def write(digit: int, who: Writer, rng, shapes: ShapeModel) -> tuple:
    """The strokes of one digit as one person writes it this time.

    Returns
    -------
    tuple of ndarray, shape (n, 2)
        As in a :class:`Trace`.
    """
    ways, choice = shapes.allographs[digit], who.allographs[digit]
    if rng.random() >= shapes.loyalty[digit]:
        choice = int(rng.choice(len(ways), p=_shares(ways)))
    way = ways[choice]
    strokes = way.strokes(who.offsets[digit][choice], rng.standard_normal(way.rank))
    leaning = np.array([[1.0, -who.slant], [0.0, np.exp(who.width)]])
    if who.even:
        strokes = (evened(stroke, who.even) for stroke in strokes)
    return boxed(stroke @ leaning for stroke in strokes)


def placing(who: Writer, rng, p, form, width):
    """The position and size of a digit's box on the skin in one trial.

    Parameters
    ----------
    who : Writer
    rng : numpy.random.Generator
    p : section ``[trials]`` of ``parameters.toml``
    form : pipeline.simulation.parameters.Form
        Usual height and place of the digit.
    width : float
        Width in taxels of a shape that is as wide as high: ``form.width``, or ``form.height`` to
        keep the proportions.

    Returns
    -------
    callable
        Function from points of shape (n, 2), in a box of height 1 around 0, to points in taxels.
    """
    larger, lower, righter = who.sloppiness * rng.standard_normal(3)
    scale = np.exp(who.size + p.size * larger) * np.array([form.height, width])
    centre = (
        form.down + who.down + p.place[0] * lower,
        form.right + who.right + p.place[1] * righter,
    )
    return lambda points: points * scale + centre


def length_s(strokes, p) -> float:
    """Duration in seconds of :func:`move` at tempo 1."""
    return float(_timing(strokes, 1.0, p)[-1][-1])


def move(strokes, tempo: float, step_s: float, start_s: float, p) -> Motion:
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
    p : section ``[kinematics]`` of ``parameters.toml``

    Returns
    -------
    Motion
        From ``p.landing_s`` before the first stroke to ``p.settle_s`` after the last one.
    """
    clock = _timing(strokes, tempo, p)
    end = clock[-1][-1]
    time = np.arange(-p.landing_s, end + p.settle_s, step_s)
    path = PchipInterpolator(np.concatenate(clock), np.concatenate(strokes))
    down, right = path(np.clip(time, 0, end)).T
    lands, lifts = np.array([(stroke[0], stroke[-1]) for stroke in clock]).T
    return Motion(start_s + time, down, right, on_skin(time, lands, lifts, p))


def _timing(strokes, tempo, p):
    """Time of each point of each stroke, from the first point on."""
    path = sum(np.hypot(*np.diff(stroke, axis=0).T).sum() for stroke in strokes)
    interval = max(path, 1.0) / p.speed / tempo / sum(len(stroke) - 1 for stroke in strokes)
    clock = [interval * np.arange(len(strokes[0]))]
    for before, stroke in itertools.pairwise(strokes):
        # Isochrony: the way through the air takes less than twice the time for twice the length.
        leap = max(np.hypot(*(stroke[0] - before[-1])), 0.3)
        lands = clock[-1][-1] + p.lift_s * (leap / p.lift_taxels) ** p.isochrony / tempo
        clock.append(lands + interval * np.arange(len(stroke)))
    return clock


def on_skin(time, lands, lifts, p):
    """Force over time: 0 in the air and 1 on the skin, rising and falling smoothly.

    Parameters
    ----------
    time : ndarray of float, shape (n,)
    lands, lifts : ndarrays of float, shape (n_contacts,)
    p : section ``[kinematics]`` of ``parameters.toml``
    """
    width = p.landing_s / 4
    rise = expit((time[:, None] - lands) / width)
    fall = expit((lifts - time[:, None]) / width)
    force = (rise * fall).max(axis=1)
    return np.where(force < 0.02, 0.0, force)
