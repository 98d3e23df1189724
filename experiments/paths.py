"""The path of the pen of a recording, from the taxels that report in each chunk.

The published arrays have, for each of the one hundred chunks of a recording, the taxels that report
in it; most of them are under the pen.  The path is the most probable sequence of positions of a
hidden Markov model (A. Viterbi, "Error bounds for convolutional codes and an asymptotically optimum
decoding algorithm", IEEE Transactions on Information Theory 13, 1967): a report comes from near the
pen or, rarely, from anywhere; the pen moves a little from one chunk to the next or, rarely, is
lifted and lands anywhere.
"""

import itertools

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pipeline.recordings.chunks import CHUNKS
from pipeline.recordings.sensor import GRID, N_TAXELS

# Distance of the positions that a pen may have, in taxels, and their number along each side.
POSITION_STEP_TAXELS = 0.5
SIDE = 2 * GRID + 1
POSITIONS = POSITION_STEP_TAXELS * np.arange(SIDE) - 0.5

# Standard deviation of the distance of a report from the pen, in taxels, and the share of reports
# that come from anywhere.
REPORT_SPREAD = 0.9
STRAY_SHARE = 0.02

# Reports of a taxel that count completely; those of a taxel with more of them count less, so that a
# hot taxel does not attract the pen.
FULL_REPORTS = 12

# Standard deviation of the pen's movement in a chunk, in taxels, the largest movement in steps,
# and the logarithm of the probability of a lift relative to no movement.
MOVE_SPREAD = 0.6
MAX_MOVE_STEPS = 3
LIFT_LOG_PROBABILITY = -9.0

# Stands for the position before a lift.
LIFTED = -1

# A pen that moves farther than this number of taxels within this number of chunks was lifted.
LIFT_TAXELS = 3.0
LIFT_CHUNKS = 3

# A stroke has at least this number of chunks, and extends over at least this number of taxels.
MIN_STROKE_CHUNKS = 4
MIN_STROKE_TAXELS = 1.4

# Smoothing of a path: of positions in taxels, and of times in chunks.
NEAR_TAXELS = 1.3
SMOOTHING_CHUNKS = 1.2

# Recordings whose paths are sought together.
BATCH_RECORDINGS = 400

ROW = np.arange(N_TAXELS) % GRID
COLUMN = np.arange(N_TAXELS) // GRID


def find_paths(bits) -> list:
    """The strokes of the pen in each recording.

    Parameters
    ----------
    bits : ndarray of bool, shape (n, 100, 2, 100)
        See :func:`experiments.fidelity.chunk_recordings`.

    Returns
    -------
    list of list of ndarray, shape (n_points, 2)
        For each recording its strokes: (down, right) in taxels, one point a chunk.
    """
    paths = []
    for first in range(0, len(bits), BATCH_RECORDINGS):
        reports = weigh_reports(bits[first : first + BATCH_RECORDINGS])
        positions, lifts = seek_positions(reports)
        for path, lift, report in zip(positions, lifts, reports, strict=True):
            strokes = itertools.chain.from_iterable(
                cut_leaps(stroke) for stroke in smooth_strokes(path, lift, report)
            )
            paths.append([stroke for stroke in strokes if _is_stroke(stroke)])
    return paths


def weigh_reports(bits) -> np.ndarray:
    """Weight of the reports of each taxel in each chunk, shape (n, 100 taxels, 100 chunks)."""
    reports = bits.sum(2, dtype=np.float32)
    total = reports.sum(2, keepdims=True)
    return reports * np.minimum(1, FULL_REPORTS / np.maximum(total, 1))


def seek_positions(reports) -> tuple:
    """The most probable positions of the pen.

    Parameters
    ----------
    reports : ndarray of float32, shape (n, 100, 100)
        See :func:`weigh_reports`.

    Returns
    -------
    positions : ndarray of float, shape (n, 100, 2)
        (down, right) in taxels.
    lifts : ndarray of bool, shape (n, 100)
        True where the pen has landed anew.
    """
    count = len(reports)
    evidence = _log_likelihood()
    score = np.zeros((count, SIDE, SIDE), np.float32)
    # Where the pen was before it came to each position: the index of one, or LIFTED.
    came = np.full((CHUNKS, count, SIDE, SIDE), LIFTED, np.int16)
    likeliest = np.zeros((CHUNKS, count), int)
    index = np.arange(SIDE**2, dtype=np.int16).reshape(1, SIDE, SIDE)
    for chunk in range(CHUNKS):
        if chunk:
            likeliest[chunk - 1] = score.reshape(count, -1).argmax(1)
            lifted = score.max((1, 2), keepdims=True) + LIFT_LOG_PROBABILITY
            # The cost of a move is that along the rows and that along the columns.
            moved, before = _move_along(score, np.broadcast_to(index, score.shape), 1)
            moved, before = _move_along(moved, before, 2)
            came[chunk] = np.where(moved > lifted, before, LIFTED)
            score = np.maximum(moved, lifted)
        score = score + (reports[:, :, chunk] @ evidence).reshape(score.shape)
    return _follow_back(score, came, likeliest)


def _move_along(score, before, axis):
    """Best scores after a move along an axis, and the positions before it."""
    reach = range(-MAX_MOVE_STEPS, MAX_MOVE_STEPS + 1)
    best = np.full_like(score, -np.inf)
    origin = before
    for move in reach:
        target = [slice(None)] * 3
        source = [slice(None)] * 3
        target[axis] = slice(max(-move, 0), SIDE - max(move, 0))
        source[axis] = slice(max(move, 0), SIDE - max(-move, 0))
        candidate = np.full_like(score, -np.inf)
        cost = np.float32((POSITION_STEP_TAXELS * move) ** 2 / (2 * MOVE_SPREAD**2))
        candidate[tuple(target)] = score[tuple(source)] - cost
        origins = np.zeros_like(before)
        origins[tuple(target)] = before[tuple(source)]
        is_better = candidate > best
        best = np.where(is_better, candidate, best)
        origin = np.where(is_better, origins, origin)
    return best, origin


def _log_likelihood():
    """Logarithm of the probability of a report of a taxel, for a pen at a position.

    Returns
    -------
    ndarray of float32, shape (100 taxels, n_positions)
    """
    down = POSITIONS[None, :, None] - ROW[:, None, None]
    right = POSITIONS[None, None, :] - COLUMN[:, None, None]
    near = np.exp(-(down**2 + right**2) / (2 * REPORT_SPREAD**2)) / (2 * np.pi * REPORT_SPREAD**2)
    chance = (1 - STRAY_SHARE) * near + STRAY_SHARE / N_TAXELS
    return np.log(chance).reshape(N_TAXELS, -1).astype(np.float32)


def _follow_back(score, came, likeliest):
    """Positions and lifts of the best sequences, from the last chunk to the first."""
    count = len(score)
    index = np.zeros((count, CHUNKS), int)
    lifts = np.zeros((count, CHUNKS), bool)
    index[:, -1] = score.reshape(count, -1).argmax(1)
    for chunk in range(CHUNKS - 1, 0, -1):
        before = came[chunk].reshape(count, -1)[np.arange(count), index[:, chunk]]
        lifts[:, chunk] = before == LIFTED
        index[:, chunk - 1] = np.where(lifts[:, chunk], likeliest[chunk - 1], before)
    return np.stack([POSITIONS[index // SIDE], POSITIONS[index % SIDE]], -1), lifts


def smooth_strokes(positions, lifts, reports) -> list:
    """The strokes of a recording: means of the reports near the most probable positions.

    Parameters
    ----------
    positions : ndarray, shape (100, 2)
    lifts : ndarray of bool, shape (100,)
    reports : ndarray, shape (100 taxels, 100 chunks)

    Returns
    -------
    list of ndarray, shape (n, 2)
    """
    taxels = np.stack([ROW, COLUMN], 1)
    strokes = []
    for first, end in itertools.pairwise([0, *np.flatnonzero(lifts), CHUNKS]):
        path = positions[first:end]
        squares = ((path[:, None] - taxels) ** 2).sum(-1)
        weight = np.exp(-squares / (2 * NEAR_TAXELS**2)) * reports[:, first:end].T
        prior = 0.3
        total = gaussian_filter1d(weight.sum(1) + prior, SMOOTHING_CHUNKS, mode="nearest")
        mean = gaussian_filter1d(
            weight @ taxels + prior * path, SMOOTHING_CHUNKS, axis=0, mode="nearest"
        )
        strokes.append(mean / total[:, None])
    return strokes


def cut_leaps(stroke) -> list:
    """The parts of a stroke in which the pen is not too fast to touch."""
    leap = np.hypot(*(stroke[LIFT_CHUNKS:] - stroke[:-LIFT_CHUNKS]).T)
    touches = np.ones(len(stroke), bool)
    for start in np.flatnonzero(leap >= LIFT_TAXELS):
        touches[start + 1 : start + LIFT_CHUNKS] = False
    borders = np.flatnonzero(np.diff(touches)) + 1
    parts = np.split(np.arange(len(stroke)), borders)
    return [stroke[part] for part in parts if len(part) and touches[part[0]]]


def _is_stroke(stroke):
    if len(stroke) < MIN_STROKE_CHUNKS:
        return False
    return np.hypot(*np.ptp(stroke, axis=0)) >= MIN_STROKE_TAXELS
