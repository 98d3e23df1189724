"""Weights as contiguous runs that can be added as vectors.

The targets of a spike are adjacent, so a spike is a few runs: an offset in a pool of weights, a
first target, and a length.  Lengths are padded with zero weights to whole blocks of `LANES`.  Equal
runs, of which a convolution has many, share their place in the pool, so that the pool stays in the
L1 cache.  Weights are int16 where no sum of weights can exceed int16 (checked), else int32.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import Network

LANES = 32  # weights in a block: one vector of 512 bits in int16
MAX_GAP = 64  # largest number of zeros that are faster to add than a new run


class Wiring(NamedTuple):
    """The weights in the form that the kernel adds.

    Attributes
    ----------
    reach : (n_segments, 2) int array
        First group of sources with weights into each segment, and one past the last; the
        inputs are group 0, segment s is group s + 1.
    pool : int16 or int32 array
        Weights of all runs, in blocks of `LANES`.
    first : (n_segments, n_sources + 1) int32 array
        The first run of each source of spikes into each segment.
    place, target, length : (n_runs,) int32 array
        Offset of a run in the pool, its first compartment in the segment, and its length.
    """

    reach: np.ndarray
    pool: np.ndarray
    first: np.ndarray
    place: np.ndarray
    target: np.ndarray
    length: np.ndarray


def wiring(network: Network) -> Wiring:
    """Split the rows of the weight matrix into runs; equal runs are shared."""
    dtype = network.weight_type
    pool, places, size = [], {}, 0
    first, place, target, length = [], [], [], []
    for start, stop in zip(network.segments.start, network.segments.stop):
        weights = network.weights[:, start:stop]
        first.append([len(place)])
        for row in range(weights.shape[0]):
            part = slice(weights.indptr[row], weights.indptr[row + 1])
            columns, values = weights.indices[part], weights.data[part]
            for run in _runs(columns):
                begin = columns[run.start]
                n_blocks = -(-(columns[run.stop - 1] + 1 - begin) // LANES)
                padded = np.zeros(n_blocks * LANES, dtype)
                padded[columns[run] - begin] = values[run]
                key = padded.tobytes()
                if key not in places:
                    places[key] = size
                    pool.append(padded)
                    size += len(padded)
                place.append(places[key])
                target.append(begin)
                length.append(len(padded))
            first[-1].append(len(place))
    first = np.array(first, np.int32)
    edges = np.concatenate([[0, network.n_inputs], network.n_inputs + network.segments.stop])
    return Wiring(
        np.array([_reach(runs[edges]) for runs in first]),
        np.concatenate(pool) if pool else np.zeros(LANES, dtype),
        *(np.array(part, np.int32) for part in (first, place, target, length)),
    )


def _reach(edges):
    """First group with runs, and one past the last, from the runs at the groups' edges."""
    used = np.flatnonzero(np.diff(edges))
    return (used[0], used[-1] + 1) if len(used) else (0, 0)


def _runs(columns):
    """Slices of sorted column numbers without gaps above `MAX_GAP`."""
    if len(columns) == 0:
        return []
    cuts = np.flatnonzero(np.diff(columns) > MAX_GAP) + 1
    edges = [0, *cuts.tolist(), len(columns)]
    return [slice(a, b) for a, b in zip(edges, edges[1:])]
