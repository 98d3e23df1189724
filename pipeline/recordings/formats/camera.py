"""Files of event cameras: iniVation's ``.aedat4``, Prophesee's ``.raw`` and ``.dat``.

They are read with faery (https://github.com/aestream/faery, LGPL 3), which is optional.  It does
not read ``.dat`` files with events of type 0, which :mod:`pipeline.recordings.formats.atis` does.
"""

import tempfile
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from deploy.errors import shorten_error
from deploy.terminal import silence_native_errors
from pipeline.recordings.formats.atis import is_old_dat, read_old_dat
from pipeline.recordings.formats.recording import (
    MAX_EVENTS,
    BadRecording,
    EventRecording,
    make_recording,
)

ENDINGS = (".aedat4", ".raw", ".dat")

# The format of iniVation's cameras before .aedat4, which faery does not read either.
OLD_ENDING = ".aedat"

# The remedy for it.
CONVERT_OLD = (
    "convert .aedat files to .npz with arrays x, y, t and p: tonic reads them (pip install tonic; "
    "tonic.io.read_dvs_128, read_davis_346 or read_dvs_ibm, by the camera)"
)


def read_camera(content: bytes, name: str) -> EventRecording:
    """Read a camera's file.

    Raises
    ------
    BadRecording
        faery is not installed; or the file is damaged, has too many events or none.
    """
    ending = PurePosixPath(name).suffix.lower()
    if ending == ".dat" and is_old_dat(content):
        return read_old_dat(content)
    try:
        import faery
    except ImportError as error:
        raise BadRecording(
            "needs the package faery; install it: pip install 'stmnist-loihi[cameras]'"
        ) from error
    with tempfile.TemporaryDirectory() as folder:  # faery opens files by their names only
        path = Path(folder) / f"recording{ending}"
        path.write_bytes(content)
        try:
            with silence_native_errors():  # a panic of faery's Rust prints where it happened
                events, (columns, rows) = _read_events(faery, path)
        except BadRecording:
            raise
        except BaseException as error:
            # A damaged file may end in a panic of faery's Rust, which is no Exception.
            if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError)):
                raise
            reason = shorten_error(str(error).replace(str(path), name), 120)
            raise BadRecording(
                f"cannot be read by faery ({reason}); it is damaged, or not a {ending} file that "
                "faery supports: convert it to .npz with arrays x, y, t and p"
            ) from error
    recording = make_recording({"t_us": events["t"], **{name: events[name] for name in "xyp"}})
    # Events outside of the size are reported with the source.
    return replace(recording, size=(int(rows), int(columns)))


def _read_events(faery, path):
    """The events of a file, and the numbers of columns and rows."""
    stream = faery.events_stream_from_file(path)
    parts = [np.empty(0, faery.EVENTS_DTYPE)]
    for part in stream:
        parts.append(part.copy())
        if sum(map(len, parts)) > MAX_EVENTS:
            raise BadRecording(f"has more than {MAX_EVENTS} events")
    return np.concatenate(parts), stream.dimensions()
