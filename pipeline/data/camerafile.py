"""Files of event cameras: AEDAT4 (iniVation), EVT2, EVT2.1, EVT3 and DAT (Prophesee).

They are read with faery (https://github.com/aestream/faery, LGPL 3): one library reads all of them,
it has wheels for Python 3.11 to 3.13 and depends on NumPy only.  It is optional:
``pip install 'stmnist-loihi[cameras]'``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from pipeline.data.eventarrays import MAX_EVENTS, EventRecording, recording_of
from pipeline.data.matfile import BadRecording

CAMERA_SUFFIXES = (".aedat4", ".raw", ".dat")


def read_camera(content: bytes, suffix: str) -> EventRecording:
    """Read a file of an event camera.

    Parameters
    ----------
    content : bytes
    suffix : str
        The end of the file's name, one of :data:`CAMERA_SUFFIXES`.

    Raises
    ------
    BadRecording
        faery is not installed, or the file is damaged or not a recording.
    """
    try:
        import faery
    except ImportError as error:
        raise BadRecording(
            "needs the package faery; install it: pip install 'stmnist-loihi[cameras]'"
        ) from error
    if not content:
        raise BadRecording("is an empty file")
    # faery opens files by their name only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"recording{suffix}"
        path.write_bytes(content)
        parts, number = [], 0
        try:
            stream = faery.events_stream_from_file(path)
            columns, rows = stream.dimensions()
            for part in stream:
                parts.append(part.copy())
                number += len(part)
                if number > MAX_EVENTS:
                    raise BadRecording(f"has more than {MAX_EVENTS} events")
        except BadRecording:
            raise
        except BaseException as error:
            # A damaged file may end in a panic of faery's Rust, which is no Exception.
            if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError)):
                raise
            raise BadRecording(f"is damaged, or not a {suffix} file") from error
    events = np.concatenate(parts) if parts else np.empty(0, faery.EVENTS_DTYPE)
    read = recording_of({name: events[name] for name in ("x", "y", "t", "p")}, "us")
    return EventRecording(
        read.x, read.y, read.time, read.polarity, read.unit, (int(rows), int(columns))
    )
