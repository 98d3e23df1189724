"""A statistical model of handwritten digits as trajectories of a pen.

Each digit is written in one of several ways (allographs: which strokes, in which order and
direction, of which kind of shape).  A trajectory of one allograph is a vector of the pen's
positions, evenly spaced in time along each stroke, and of the share of the time of each stroke.
The vector is Gaussian around the allograph's mean, within a few principal components, and its
deviation is the sum of an offset that is constant for a person and an allograph, and of a variation
from one digit to the next:

    x = mean + (between^(1/2) a_person + within^(1/2) b) components,    a_person, b ~ N(0, 1)

It is a point distribution model (T. F. Cootes et al., "Active shape models", Computer Vision and
Image Understanding 61, 1995) with time as the correspondence of the points, and its two covariances
are those of the two-covariance model of speaker recognition (N. Bruemmer and E. de Villiers, "The
speaker partitioning problem", Odyssey 2010).

Two files have the parameters of models and the sources of their data: ``handwriting.npz``, of
people who write on a tablet (:mod:`experiments.handwriting` estimates it), and ``fitted.npz``, of
people who write on the sensor (:mod:`experiments.calibration`).
"""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deploy.files import read_arrays, write_arrays

# The model of people who write on a tablet.
MODEL = Path(__file__).with_name("handwriting.npz")

# Positions of a trajectory, all of its strokes together.
POINTS = 32

DIGITS = 10


@dataclass(frozen=True)
class Allograph:
    """One way of writing a digit.

    Attributes
    ----------
    share : float
        Share of the digits that are written in this way.
    points : tuple of int
        Number of positions of each stroke; :data:`POINTS` in total.
    mean : ndarray, shape (n,)
        Positions (down, right) stroke by stroke, in a box of height 1 around 0; then, for each
        stroke except the first, the logarithm of its writing time relative to the first one:
        ``n = 2 * POINTS + len(points) - 1``.
    components : ndarray, shape (k, n)
        Principal components, each as long as a standard deviation of the digits along it.
    between, within : ndarray, shape (k, k)
        Square roots of the covariances between persons (of their offsets) and within a person, in
        units of the components.
    """

    share: float
    points: tuple
    mean: np.ndarray
    components: np.ndarray
    between: np.ndarray
    within: np.ndarray

    @property
    def rank(self) -> int:
        """Number of components."""
        return len(self.components)

    def make_strokes(self, along) -> tuple:
        """The strokes of one digit.

        Parameters
        ----------
        along : ndarray, shape (k,)
            Deviation from the mean, in units of the components.

        Returns
        -------
        tuple of ndarray, shape (n, 2)
            (down, right) along each stroke, evenly spaced in time, in a box of height 1 around 0.
        """
        drawn = self.mean + along @ self.components
        strokes = np.split(drawn[: 2 * POINTS].reshape(POINTS, 2), np.cumsum(self.points)[:-1])
        ratio = np.exp(np.concatenate([[0.0], np.clip(drawn[2 * POINTS :], -3, 3)]))
        counts = np.maximum(np.rint(ratio / ratio.sum() * POINTS).astype(int), 3)
        return fit_in_box(
            resample_stroke(stroke, count) for stroke, count in zip(strokes, counts, strict=True)
        )


@dataclass(frozen=True)
class ShapeModel:
    """A statistical model of how people write the ten digits.

    Attributes
    ----------
    allographs : tuple of tuple of Allograph
        Allographs of each digit.
    loyalty : tuple of float
        For each digit, the share that a person writes in the habitual way; the other digits are
        written in any way, with the frequencies among people.
    tempo, trial_tempo : float
        Standard deviations of the logarithm of the pen's speed, between persons and from one digit
        of a person to the next.
    about : dict
        Source of the model's data: ``source``, ``licence``, ``sha256`` of the file,
        ``writers``, ``digits``.
    """

    allographs: tuple
    loyalty: tuple
    tempo: float
    trial_tempo: float
    about: dict

    @functools.cached_property
    def most_ways(self) -> int:
        """Number of allographs of the digit that has most."""
        return max(map(len, self.allographs))

    @functools.cached_property
    def highest_rank(self) -> int:
        """Number of components of the allograph that has most."""
        return max(way.rank for ways in self.allographs for way in ways)

    @functools.cached_property
    def cumulative_shares(self) -> tuple:
        """For each digit the cumulative sums of the shares of its allographs."""
        return tuple(map(_accumulate_shares, self.allographs))

    def to_arrays(self) -> dict:
        """The parameters as arrays, for a file; the inverse of :meth:`from_arrays`."""
        arrays = {
            "about": np.array(json.dumps(self.about, sort_keys=True)),
            "loyalty": np.array(self.loyalty),
            "tempo": np.array([self.tempo, self.trial_tempo]),
        }
        for digit, ways in enumerate(self.allographs):
            arrays |= {f"{digit}.{part}": array for part, array in _pack(ways).items()}
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict) -> ShapeModel:
        """The model of :meth:`to_arrays`."""
        ways = []
        for digit in range(DIGITS):
            ways.append(_unpack({part: arrays[f"{digit}.{part}"] for part in PARTS}))
        tempo, trial_tempo = arrays["tempo"].astype(float).tolist()
        return cls(
            allographs=tuple(ways),
            loyalty=tuple(arrays["loyalty"].astype(float).tolist()),
            tempo=tempo,
            trial_tempo=trial_tempo,
            about=json.loads(str(arrays["about"])),
        )

    def join(self, other: ShapeModel, share: float) -> ShapeModel:
        """This model, and for a share of the digits the ways of writing of other people.

        Parameters
        ----------
        other : ShapeModel
            Its speeds and habits are left out.
        share : float
            From 0 to 1.
        """
        allographs = tuple(
            (*scale_shares(ways, 1 - share), *scale_shares(other_ways, share))
            for ways, other_ways in zip(self.allographs, other.allographs, strict=True)
        )
        return replace(self, allographs=allographs)

    def vary(self, factor: float) -> ShapeModel:
        """The model with another factor on all deviations from the means."""
        return replace(
            self, allographs=tuple(_scale_deviations(ways, factor) for ways in self.allographs)
        )

    def compute_hash(self) -> str:
        """Hexadecimal SHA-256 over the parameters as they are stored."""
        digest = hashlib.sha256()
        for name, array in sorted(self.to_arrays().items()):
            if name != "about":
                digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def _accumulate_shares(ways):
    return np.cumsum([way.share for way in ways])


def _scale_deviations(ways, factor):
    return tuple(
        replace(way, between=factor * way.between, within=factor * way.within) for way in ways
    )


def scale_shares(ways, total: float) -> tuple:
    """Ways of writing a digit with the same ratios of their shares and another sum."""
    present = sum(way.share for way in ways)
    return tuple(replace(way, share=way.share * total / present) for way in ways)


# Arrays that a digit's allographs are stored as, those of all of them stacked.
PARTS = ("share", "points", "rank", "mean", "components", "between", "within")


def _pack(ways) -> dict:
    """A digit's allographs as arrays of equal size, padded with zeros."""
    k = max(way.rank for way in ways)
    strokes = max(len(way.points) for way in ways)
    n = 2 * POINTS + strokes - 1
    sizes = {"mean": (n,), "components": (k, n), "between": (k, k), "within": (k, k)}
    packed = {name: np.zeros((len(ways), *size), np.float16) for name, size in sizes.items()}
    points = np.zeros((len(ways), strokes), np.uint8)
    for number, way in enumerate(ways):
        points[number, : len(way.points)] = way.points
        for name, array in packed.items():
            values: np.ndarray = getattr(way, name)
            corner: tuple = (number, *map(slice, values.shape))
            array[corner] = values
    return packed | {
        "points": points,
        "share": np.array([way.share for way in ways], np.float32),
        "rank": np.array([way.rank for way in ways], np.uint8),
    }


def _unpack(arrays) -> tuple:
    """The inverse of :func:`_pack`."""
    ways = []
    for share, points, rank, mean, components, between, within in zip(
        *(arrays[part] for part in PARTS), strict=True
    ):
        points = tuple(int(count) for count in points[points > 0])
        k = int(rank)
        n = 2 * POINTS + len(points) - 1
        parts = mean[:n], components[:k, :n], between[:k, :k], within[:k, :k]
        ways.append(Allograph(float(share), points, *(part.astype(float) for part in parts)))
    return tuple(ways)


def fit_in_box(strokes) -> tuple:
    """Strokes shifted and scaled to a box of height 1 around 0, with the same proportions.

    Parameters
    ----------
    strokes : iterable of ndarray, shape (n, 2)
    """
    strokes = tuple(strokes)
    points = np.concatenate(strokes)
    low = points.min(axis=0)
    high = points.max(axis=0)
    height = max(high[0] - low[0], 1e-9)
    return tuple((stroke - (low + high) / 2) / height for stroke in strokes)


def resample_stroke(stroke, count: int) -> np.ndarray:
    """A stroke with another number of evenly spaced times, shape (count, 2)."""
    at = np.linspace(0, len(stroke) - 1, count)
    return np.stack([np.interp(at, np.arange(len(stroke)), axis) for axis in stroke.T], 1)


def space_points_evenly(stroke, share: float) -> np.ndarray:
    """A stroke whose times are evenly spaced along its path, by a share from 0 to 1."""
    steps = np.hypot(*np.diff(stroke, axis=0).T)
    path = np.concatenate([[0.0], np.cumsum(steps)]) / max(steps.sum(), 1e-9)
    at = share * np.linspace(0, 1, len(stroke)) + (1 - share) * path
    return np.stack([np.interp(at, path, axis) for axis in stroke.T], 1)


@functools.cache
def read_tablet_model() -> ShapeModel:
    """The built-in model of people who write on a tablet."""
    return read_shape_model(MODEL)


def read_shape_model(path) -> ShapeModel:
    """Read a model from a file that :func:`write_shape_model` has written."""
    return ShapeModel.from_arrays(read_arrays(path, "install the package again"))


def write_shape_model(path, model: ShapeModel):
    """Write a model to a file; equal models give equal bytes."""
    write_arrays(path, **model.to_arrays())
