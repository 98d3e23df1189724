"""Recordings as in the published arrays of ST-MNIST, which keep the order of events, not their
times.

These arrays (``ST-MNIST-SPLIT`` in the repository ``GuoFM/DeepTactile``) divide the raw columns of
a recording into one hundred chunks of equal numbers, and have for each taxel and polarity whether
it is in a chunk.
"""

import numpy as np

from pipeline.recordings.events import Events, expand_bursts

# Chunks of a recording.
CHUNKS = 100

# Time that a chunk stands for: a hundredth of the recording's two seconds, in nanoseconds.
CHUNK_NS = 20_000_000


def chunk_events(events: Events) -> Events:
    """The events of a raw recording as in the published arrays.

    Returns
    -------
    Events
        One for each taxel and polarity in each chunk, at the chunk's number times
        :data:`CHUNK_NS`.
    """
    _, taxel, polarity = expand_bursts(events)
    size, remainder = divmod(len(taxel), CHUNKS)
    chunk = np.repeat(np.arange(CHUNKS), size + (np.arange(CHUNKS) < remainder))
    n_taxels = 1 + int(taxel.max(initial=0))
    code = (chunk * n_taxels + taxel) * 2 + (polarity < 0)
    chunk_and_taxel, falls = np.divmod(np.unique(code), 2)
    chunk, taxel = np.divmod(chunk_and_taxel, n_taxels)
    return Events(chunk * CHUNK_NS, taxel, 1 - 2 * falls, np.ones(len(taxel)))
