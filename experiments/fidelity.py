"""Recordings in the published representation, and statistics of them that need no label.

See :mod:`pipeline.recordings.chunks`.
"""

import numpy as np
from scipy.ndimage import label

from deploy.errors import UserError
from pipeline.recordings.chunks import CHUNK_NS, CHUNKS, chunk_events
from pipeline.recordings.events import GRID, N_TAXELS, Recordings

# Taxels, rows and columns that have at least so many bits belong to the digit and not to strays.
FEWEST_BITS = 2


def chunk_recordings(recordings: Recordings) -> np.ndarray:
    """Recordings as in the published arrays.

    Parameters
    ----------
    recordings : Recordings
        Raw recordings, or some whose times are multiples of :data:`CHUNK_NS`, as in files that were
        made of the published arrays.

    Returns
    -------
    ndarray of bool, shape (n_samples, 100 taxels, 2, 100 chunks)
        The first of the two is a rise of the pressure.

    Raises
    ------
    UserError
        The recordings are not of the paper's sensor.
    """
    taxels, sensor = recordings.taxels, recordings.sensor
    if (sensor.rows, sensor.columns, sensor.polarities) != (GRID, GRID, 2):
        raise UserError(
            f"{recordings.source.name}: a sensor of {sensor} with {sensor.polarities} polarities; "
            "give recordings of 10x10 taxels with both polarities"
        )
    time = recordings.events.time_ns
    is_chunked = len(time) and not (time % CHUNK_NS).any() and time.max() < CHUNKS * CHUNK_NS
    bits = np.zeros((len(recordings), N_TAXELS, 2, CHUNKS), bool)
    place = taxels.column * GRID + taxels.row
    for index in range(len(recordings)):
        events = recordings[index] if is_chunked else chunk_events(recordings[index])
        chunk, falls = events.time_ns // CHUNK_NS, (events.polarity < 0).astype(int)
        bits[index, place[events.taxel], falls, chunk] = True
    return bits


def summarise_recordings(bits) -> dict:
    """Summaries of each recording, without its label.

    Parameters
    ----------
    bits : ndarray of bool, shape (n, 100, 2, 100)
        See :func:`chunk_recordings`.

    Returns
    -------
    dict of ndarray, shape (n,)
        ``bits``; ``active``, taxels with a bit; ``bits per taxel`` that is active, their mean, and
        ``median bits``; ``largest share`` of the bits in one taxel; ``neighbours`` of an active
        taxel that are active; ``isolated`` share of the active taxels; ``span`` of a taxel from its
        first to its last chunk; ``runs`` of chunks of a taxel, and ``run length``; ``one bit``,
        the share of the active taxels with a single one; ``rise over fall``; ``row`` and
        ``column``, means of the active taxels, from 1; ``height`` and ``width`` of the largest
        component.
    """
    counts = bits.sum(-1, dtype=np.int32)
    total = counts.sum(2)
    active, some = total > 0, np.maximum(total.sum(1), 1)
    n_active = np.maximum(active.sum(1), 1)
    row, column = np.arange(N_TAXELS) % GRID, np.arange(N_TAXELS) // GRID
    neighbours = count_neighbours(active)
    any_bit = bits.any(2)
    first = any_bit.argmax(-1)
    last = CHUNKS - 1 - any_bit[..., ::-1].argmax(-1)
    starts = any_bit & ~np.pad(any_bit, ((0, 0), (0, 0), (1, 0)))[..., :-1]
    runs = starts.sum((1, 2))
    height, width = _size_of_largest(total >= FEWEST_BITS)
    median = [np.median(row[row > 0]) if row.any() else 0.0 for row in total]
    return {
        "bits": some,
        "active": n_active,
        "bits per taxel": some / n_active,
        "median bits": np.array(median),
        "largest share": total.max(1) / some,
        "neighbours": (neighbours * active).sum(1) / n_active,
        "isolated": ((neighbours == 0) & active).sum(1) / n_active,
        "span": ((last - first + 1) * active).sum(1) / n_active,
        "runs": runs / n_active,
        "run length": any_bit.sum((1, 2)) / np.maximum(runs, 1),
        "one bit": (total == 1).sum(1) / n_active,
        "rise over fall": counts[..., 0].sum(1) / np.maximum(counts[..., 1].sum(1), 1),
        "row": (active * row).sum(1) / n_active + 1,
        "column": (active * column).sum(1) / n_active + 1,
        "height": height,
        "width": width,
    }


def count_neighbours(active):
    """Number of active taxels around each."""
    grid = np.pad(active.reshape(-1, GRID, GRID), ((0, 0), (1, 1), (1, 1))).astype(np.int32)
    shifted = (grid[:, i : i + GRID, j : j + GRID] for i in range(3) for j in range(3))
    around = sum(shifted) - grid[:, 1:-1, 1:-1]
    return around.reshape(len(active), N_TAXELS)


def _size_of_largest(active):
    """Rows and columns of the largest connected component of each recording."""
    sizes = np.zeros((len(active), 2))
    for index, grid in enumerate(active.reshape(-1, GRID, GRID)):
        components, count = label(grid, np.ones((3, 3)))
        if count:
            largest = components == 1 + np.bincount(components.ravel())[1:].argmax()
            sizes[index] = largest.any(0).sum(), largest.any(1).sum()
    return sizes.T


def measure_moments(bits, left_out) -> np.ndarray:
    """Place, size and shear of the digit of each recording.

    Parameters
    ----------
    bits : ndarray of bool, shape (n, 100, 2, 100)
    left_out : sequence of int
        Taxels to leave out: the hot ones.

    Returns
    -------
    ndarray of float, shape (n, 5)
        Means of row and column, their standard deviations, and the slope of column over row.
    """
    weight = weigh_taxels(bits, left_out)
    total = np.maximum(weight.sum(1), 1)
    row, column = np.arange(N_TAXELS) % GRID, np.arange(N_TAXELS) // GRID
    rows, columns = weight @ row / total, weight @ column / total
    down, right = row - rows[:, None], column - columns[:, None]
    heights = (weight * down**2).sum(1) / total
    widths = (weight * right**2).sum(1) / total
    slope = (weight * down * right).sum(1) / total / np.maximum(heights, 0.3)
    return np.stack([rows, columns, np.sqrt(heights), np.sqrt(widths), slope], 1)


def weigh_taxels(bits, left_out):
    """Bits of each taxel that belong to the digit, not more than eight, shape (n, 100)."""
    total = bits.sum((2, 3), dtype=np.int32)
    weight = np.minimum(total, 8) * (total > FEWEST_BITS)
    weight[:, list(left_out)] = 0
    return weight
