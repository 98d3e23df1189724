"""Limits of the total size of a source of recordings, in time and memory.

Each file has its own limit (:mod:`pipeline.data.mat5`), which does not limit a thousand
files.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.data.mat5 import LARGEST

MOST_EVENTS = 22_000_000
"""Events of a source.  The published recordings have 20 million columns, and a quarter as many
events; a million events take up to 75 MB and a tenth of a second."""

MOST_BYTES = 24_000_000_000
"""Bytes of a source's recordings when unpacked; reading 1 GB takes a second.  The published ones
have 16 GB."""

MOST_FILES = 100_000
"""Recordings of a source."""

UNPACKED = 1032
"""Maximum compression ratio of zlib."""


@dataclass
class Spent:
    """The amount of data that was read from a source.

    Attributes
    ----------
    events, bytes : int
    """

    events: int = 0
    bytes: int = 0

    def add(self, recording, size: int = 0):
        """Count a recording, or one that was refused.

        Parameters
        ----------
        recording : MatRecording, EventRecording or str
        size : int
            Size in bytes of a refused file, whose unpacked part is not known.
        """
        if isinstance(recording, str):
            self.bytes += min(UNPACKED * size, LARGEST)
        elif hasattr(recording, "n_taxels"):  # a matrix with a row for each taxel
            self.events += len(recording.events)
            self.bytes += 8 * (recording.n_taxels + 1) * int(recording.events.columns.sum())
        else:
            self.events += len(recording.polarity)
            self.bytes += 32 * len(recording.polarity)

    @property
    def too_much(self) -> str | None:
        """The limit that is exceeded, or None."""
        if self.events > MOST_EVENTS:
            return f"more than {MOST_EVENTS:,} events in all"
        if self.bytes > MOST_BYTES:
            return f"more than {MOST_BYTES:,} bytes in all, unpacked"
        return None
