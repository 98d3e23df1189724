"""Estimating the model of handwriting (:mod:`.shape_model`) from pen trajectories."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.cluster.vq import kmeans2

from deploy.errors import UserError
from deploy.files import hash_file
from deploy.terminal import show
from experiments import unipen
from pipeline.simulation import shape_model
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.shape_model import DIGITS, POINTS, Allograph, ShapeModel, resample_stroke

# Source and licence of files from which a model may be estimated, by their hash.
KNOWN_HANDWRITING = {
    "a66225d68d7d68591e62944df1ad33b3f5aa608e2df2505844b41f5568a80da4": {
        "source": "Pen-Based Recognition of Handwritten Digits, training writers; E. Alpaydin and "
        "F. Alimoglu, 1998",
        "licence": "CC BY 4.0",
    }
}

# Initial maximum for each number of strokes; rare allographs are dissolved.
MAX_ALLOGRAPHS = 10

# Minimum of digits and writers for an allograph: fewer would describe individuals.
MIN_DIGITS = 15
MIN_WRITERS = 3

MAX_COMPONENTS = 12

# Share of the variation that is assumed to be a person's, where writers are not known.
UNKNOWN_SHARE = 0.5

# Share of the variance that an allograph's components explain, within their maximum number.
EXPLAINED_SHARE = 0.97


def estimate_shape_model(
    traces, seed: int = 0, about: dict | None = None, max_allographs: int = MAX_ALLOGRAPHS
) -> ShapeModel:
    """Estimate the model.

    If no writer has two of the traces, the writers are not known: half of the variance of each way,
    and half of the choices of a way, are assumed to be a person's.

    Parameters
    ----------
    traces : sequence of Trace
        Trajectories of all ten digits, with their writers.
    seed : int
        Seed of the start of the search for allographs.
    about : dict, optional
        Source of the trajectories.
    max_allographs : int
        Largest number of ways of writing with an equal number of strokes.

    Returns
    -------
    ShapeModel

    Raises
    ------
    ValueError
        A digit is missing, or no way of writing one is common enough.
    """
    traces = [trace for trace in traces if trace.writer >= 0]
    digits = np.array([trace.digit for trace in traces], int)
    writers = np.array([trace.writer for trace in traces], int)
    missing = sorted(set(range(DIGITS)) - set(digits.tolist()))
    if missing:
        raise ValueError(f"no known writer wrote a {missing[0]}")
    allographs = []
    loyalty = []
    for digit in range(DIGITS):
        of_digit = [trace for trace in traces if trace.digit == digit]
        digit_allographs, share = _find_allographs(of_digit, seed, max_allographs)
        if not digit_allographs:
            raise ValueError(f"too few people wrote a {digit} in any one way")
        allographs.append(digit_allographs)
        loyalty.append(share)
    tempo, trial_tempo = _measure_tempo(traces, digits, writers)
    facts = {"digits": len(traces), **(about or {})}
    if len(set(writers.tolist())) < len(traces):
        facts["writers"] = len(set(writers.tolist()))
    return ShapeModel(tuple(allographs), tuple(loyalty), tempo, trial_tempo, facts)


def add_straight_one(model: ShapeModel) -> ShapeModel:
    """The model with a 1 as one straight stroke downwards, which few of the measured people write.

    Its components are the change of the speed along the stroke, its slant and its bow.
    """
    position = np.linspace(-0.5, 0.5, POINTS)
    eased = 1.5 * position - 2 * position**3
    zeros = np.zeros(POINTS)
    bow = 0.04 * (1 - (2 * position) ** 2)
    pace = ((position - eased) / 2, zeros)
    parts = (((position + eased) / 2, zeros), pace, (zeros, 0.2 * position), (zeros, bow))
    mean, *rows = (np.stack(part, 1).ravel() for part in parts)
    half = np.sqrt(0.5) * np.eye(len(rows))
    straight = Allograph(0.5, (POINTS,), mean, np.array(rows), half, half)
    allographs = list(model.allographs)
    allographs[1] = (*allographs[1], straight)
    return replace(model, allographs=tuple(allographs))


def _measure_tempo(traces, digits, writers):
    """Spreads of the logarithm of the speed between persons and within one.

    A tablet's points are evenly spaced in time.  A digit's mean speed is therefore its length (in
    heights) divided by their number, independently of the tablet's rate.
    """
    speed = np.array([_measure_log_speed(trace) for trace in traces])
    for digit in range(DIGITS):
        speed[digits == digit] -= speed[digits == digit].mean()
    means = {w: speed[writers == w].mean() for w in np.unique(writers)}
    residuals = speed - np.array([means[w] for w in writers])
    return float(np.std(list(means.values()), ddof=1)), float(residuals.std())


def _measure_log_speed(trace):
    """Logarithm of the mean distance between points of the same stroke."""
    length = sum(np.hypot(*np.diff(stroke, axis=0).T).sum() for stroke in trace.strokes)
    return np.log(length / sum(len(stroke) - 1 for stroke in trace.strokes))


def _find_allographs(traces, seed, max_allographs):
    """The allographs of a digit, and the share of digits in a person's habitual one."""
    used = 0
    clusters = []
    usage = []
    writers = sorted({trace.writer for trace in traces})
    for count in sorted({len(trace.strokes) for trace in traces}):
        of_count = [trace for trace in traces if len(trace.strokes) == count]
        points = _count_points(of_count, count)
        vectors = np.array([make_vector(trace, points) for trace in of_count])
        writer_of_trace = np.array([trace.writer for trace in of_count])
        for members in _find_clusters(vectors, writer_of_trace, seed, max_allographs):
            clusters.append((len(members), points, vectors[members], writer_of_trace[members]))
            usage.append(
                np.bincount(
                    np.searchsorted(writers, writer_of_trace[members]), minlength=len(writers)
                )
            )
            used += len(members)
    allographs = tuple(_make_allograph(n / used, *fields) for n, *fields in clusters)
    return allographs, _estimate_loyalty(np.array(usage).T) if clusters else 0.0


def _count_points(traces, count):
    """Number of positions of each stroke: proportional to its share of the time, at least four."""
    steps = np.array([len(stroke) - 1 for trace in traces for stroke in trace.strokes])
    shares = np.mean(steps.reshape(len(traces), count), axis=0)
    points = np.maximum(np.floor(shares / shares.sum() * POINTS), 4).astype(int)
    points[points.argmax()] += POINTS - points.sum()
    return tuple(int(n) for n in points)


def make_vector(trace: Trace, points) -> np.ndarray:
    """A trajectory as the vector that :class:`.Allograph` describes."""
    coordinates = [
        resample_stroke(s, n).ravel() for s, n in zip(trace.strokes, points, strict=True)
    ]
    log_times = np.log([len(stroke) - 1 for stroke in trace.strokes])
    return np.concatenate([*coordinates, log_times[1:] - log_times[0]])


def _find_clusters(vectors, writers, seed, max_clusters):
    """Indices of each allograph's trajectories (k-means), without those of rare allographs.

    An allograph that is too rare is removed, and its trajectories are assigned to the nearest other
    one, until no allograph is too rare.  If none remains, the trajectories are left out.
    """
    if not _is_common(np.arange(len(vectors)), writers):
        return []
    count = min(max_clusters, len(vectors) // MIN_DIGITS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one that becomes empty is dissolved below
        centres, _ = kmeans2(vectors, count, iter=50, minit="++", seed=seed)
    while True:
        nearest = ((vectors[:, None] - centres[None]) ** 2).sum(-1).argmin(1)
        members = [np.flatnonzero(nearest == number) for number in range(len(centres))]
        rare = [
            number for number, indices in enumerate(members) if not _is_common(indices, writers)
        ]
        if not rare:
            return members
        rarest = min(rare, key=lambda number: len(members[number]))
        centres = np.delete(centres, rarest, axis=0)


def _is_common(members, writers):
    return len(members) >= MIN_DIGITS and len(set(writers[members])) >= MIN_WRITERS


def _make_allograph(share, points, vectors, writers):
    mean = vectors.mean(axis=0)
    _, size, rows = np.linalg.svd(vectors - mean, full_matrices=False)
    rows = rows * np.sign(rows[np.arange(len(rows)), np.abs(rows).argmax(axis=1)])[:, None]
    explained = np.cumsum(size**2) / (size**2).sum()
    count = min(int(np.searchsorted(explained, EXPLAINED_SHARE)) + 1, MAX_COMPONENTS)
    components = rows[:count] * (size[:count, None] / np.sqrt(len(vectors)))
    scores = (vectors - mean) @ rows[:count].T / size[:count] * np.sqrt(len(vectors))
    between, within = _estimate_covariances(scores, writers)
    return Allograph(share, points, mean, components, _compute_root(between), _compute_root(within))


def _estimate_covariances(scores, writers):
    """Covariances between and within persons, by the moments of a one-way analysis of variance."""
    people, index = np.unique(writers, return_inverse=True)
    if len(people) == len(scores):
        total = scores.T @ scores / len(scores)
        return UNKNOWN_SHARE * total, (1 - UNKNOWN_SHARE) * total
    counts = np.bincount(index)
    means = np.array([scores[index == i].mean(axis=0) for i in range(len(people))])
    residuals = scores - means[index]
    within = residuals.T @ residuals / max(len(scores) - len(people), 1)
    deviations = (means - scores.mean(axis=0)) * np.sqrt(counts)[:, None]
    mean_count = (counts.sum() - (counts**2).sum() / counts.sum()) / (len(people) - 1)
    between = (deviations.T @ deviations / (len(people) - 1) - within) / mean_count
    return between, within


def _compute_root(covariance):
    """A square root of a covariance; negative eigenvalues are replaced by 0."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0))


def _estimate_loyalty(usage):
    """Estimate the share of a person's digits that are written in the habitual way.

    Let a share ``q`` of a person's digits be written in one habitual way, which is drawn with the
    frequencies among people, and let the other digits be drawn independently with the same
    frequencies.  Two digits of a person then have the same way with the probability ``s + q^2 (1 -
    s)``, where ``s`` is the probability for two people.

    Parameters
    ----------
    usage : ndarray of int, shape (writers, ways)
    """
    usage = usage[usage.sum(axis=1) >= 2]
    if not len(usage):
        return UNKNOWN_SHARE
    n = usage.sum(axis=1)
    share_of_pairs = (usage * (usage - 1)).sum() / (n * (n - 1)).sum()
    chance = ((usage.sum(axis=0) / usage.sum()) ** 2).sum()
    if chance > 1 - 1e-9:
        return 1.0
    return float(np.sqrt(np.clip((share_of_pairs - chance) / (1 - chance), 0, 1)))


def main(
    file: Annotated[Path, typer.Argument(help="UNIPEN file of digits, with their writers.")],
    seed: Annotated[int, typer.Option(help="Seed of the search.", min=0, max=2**31 - 1)] = 0,
    out: Annotated[
        Path, typer.Option(help="File for the model.", show_default="the one that is read")
    ] = shape_model.MODEL,
):
    """Estimate the model of handwriting from recorded pen trajectories.

    pipeline/simulation/shape_model.py describes the model.  The file has its parameters and no
    trajectory; the simulation reads the file that is written by default.
    """
    traces = unipen.read(file)
    content = hash_file(file)
    about = {"sha256": content, **KNOWN_HANDWRITING.get(content, {"source": file.name})}
    try:
        model = add_straight_one(estimate_shape_model(traces, seed, about))
    except ValueError as error:
        raise UserError(f"{file}: {error}; give digits of more people") from error
    shape_model.write_shape_model(out, model)
    ways = ", ".join(f"{digit}: {len(ways)}" for digit, ways in enumerate(model.allographs))
    about = model.about
    show(f"{about['digits']} digits of {about['writers']} writers; ways of writing {ways}")
    show(f"{out}: {out.stat().st_size} bytes")
