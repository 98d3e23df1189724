"""One recording, one ``.npz`` file: the events of any event-based sensor as four arrays.

``x`` is the taxel's column, counted from the left, and ``y`` its row, counted from the top, whole
numbers from 0 as event cameras have them; ``t`` is the time in seconds, ``p`` the polarity, 1 or
-1.  Each array has one entry an event, in any order of time.  Nothing in a file is executed: only
plain arrays of numbers are read, and no more than a recording can have.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import dataclass

import numpy as np

from pipeline.recordings.events import Events
from pipeline.recordings.matfile import LATEST_S, MAX_SIDE, BadRecording

ARRAYS = ("x", "y", "t", "p")

MAX_EVENTS = 5_000_000
"""Events of one recording."""


@dataclass(frozen=True)
class EventRecording:
    """What one file holds, in order of time.

    Attributes
    ----------
    x, y : ndarrays of int64, shape (n,)
        Column and row, from 0.
    time_ns : ndarray of int64, shape (n,)
    polarity : ndarray of int8, shape (n,)
    """

    x: np.ndarray
    y: np.ndarray
    time_ns: np.ndarray
    polarity: np.ndarray
    simulated = False
    writer = -1

    def events(self, rows: int) -> Events:
        """With taxels counted as :meth:`pipeline.recordings.events.TaxelMap.grid` does."""
        taxel = self.y + rows * self.x
        return Events(self.time_ns, taxel, self.polarity, np.ones(len(taxel)))


def read_events(content: bytes) -> EventRecording:
    """Read a recording.

    Parameters
    ----------
    content : bytes
        Of a ``.npz`` file.

    Raises
    ------
    BadRecording
        Not such a file; arrays that are missing, of different lengths, empty, or not of numbers;
        coordinates that are no whole numbers from 0; times that are NaN, negative or not seconds;
        polarities other than 1 and -1.
    """
    arrays = {name: _array(content, name) for name in ARRAYS}
    lengths = {len(array) for array in arrays.values()}
    if len(lengths) != 1:
        listed = ", ".join(f"{name} {len(array)}" for name, array in arrays.items())
        raise BadRecording(f"has arrays of different lengths: {listed}")
    if lengths == {0}:
        raise BadRecording("is empty: no events")
    x, y, t, p = (arrays[name] for name in ARRAYS)
    if not np.isfinite(t).all():
        raise BadRecording("has a time that is NaN or infinite")
    if t.min() < 0:
        raise BadRecording("has a negative time")
    if t.max() > LATEST_S:
        raise BadRecording(
            f"times go up to {t.max():g}, not seconds up to {LATEST_S:g}; "
            "in milliseconds or microseconds?"
        )
    for name, places in (("x", x), ("y", y)):
        outside = ~(places >= 0) | ~(places < MAX_SIDE) | (places != np.floor(places))
        if outside.any():
            raise BadRecording(
                f"{name} has {places[outside][0]:g}, not whole numbers from 0 to {MAX_SIDE - 1}"
            )
    if not np.isin(p, (-1, 1)).all():
        raise BadRecording(f"p has {p[~np.isin(p, (-1, 1))][0]:g}, not 1 (ON) or -1 (OFF)")
    time_ns = np.rint(np.asarray(t, float) * 1e9).astype(np.int64)
    order = np.argsort(time_ns, kind="stable")
    return EventRecording(
        *(np.asarray(a, np.int64)[order] for a in (x, y)),
        time_ns[order],
        np.asarray(p, np.int8)[order],
    )


def _array(content, name):
    """A one-dimensional array of numbers, its declared size held against the bytes there are."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            member = archive.getinfo(f"{name}.npy")
            if member.file_size > 8 * MAX_EVENTS + 4096:
                raise BadRecording(f"{name!r} has more than {MAX_EVENTS} entries")
            with archive.open(member) as file:
                data = io.BytesIO(file.read(member.file_size))
        version = np.lib.format.read_magic(data)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, _, dtype = read_header(data)
        if dtype.kind not in "fiu" or dtype.itemsize > 8 or len(shape) != 1:
            raise BadRecording(f"{name!r} is not a row of numbers")
        values = np.frombuffer(data.read(), dtype)
        if len(values) != shape[0]:
            raise BadRecording(f"{name!r} is damaged")
        return values
    except BadRecording:
        raise
    except KeyError as error:
        if f"{name}.npy" in str(error):
            raise BadRecording(f"has no array {name!r}; expected x, y, t and p") from error
        raise BadRecording("is a damaged .npz file") from error
    except zipfile.BadZipFile as error:
        raise BadRecording("is not a .npz file, or damaged") from error
    except (ValueError, TypeError, OSError, EOFError, zlib.error, RuntimeError) as error:
        raise BadRecording("is a damaged .npz file") from error
    except (NotImplementedError, SyntaxError, OverflowError, MemoryError) as error:
        raise BadRecording("is a damaged .npz file") from error
    except Exception as error:  # other packings fail in their own ways
        raise BadRecording(f"is a damaged .npz file ({type(error).__name__})") from error
