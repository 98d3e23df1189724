"""Files of ATIS cameras: N-MNIST's ``.bin``, and ``.dat`` with events of type 0, as in N-CARS.

The layouts are those of the data sets' own readers.
"""

import re
from dataclasses import replace

import numpy as np

from pipeline.recordings.formats.recording import BadRecording, EventRecording, make_recording

ENDINGS = (".bin",)

# Bytes of an event: in .bin x, y, polarity (1 bit) and time (23 bits); in .dat time (32 bits), x
# and y (14 bits each) and polarity.
BIN_EVENT_BYTES = 5
DAT_EVENT_BYTES = 8

# The row of an event in .bin that stands for an overflow of the time, and the time it adds.
OVERFLOW_ROW = 240
OVERFLOW_US = 1 << 13


def read_bin(content: bytes, name: str = "") -> EventRecording:
    """Read events of five bytes, as in N-MNIST and N-Caltech101.

    Nothing in a file says what it is: its length and the order of its times have to fit.

    Raises
    ------
    BadRecording
    """
    if len(content) % BIN_EVENT_BYTES:
        raise BadRecording(
            f"is not a file of N-MNIST: its length of {len(content)} bytes is not a multiple of "
            f"{BIN_EVENT_BYTES}; convert it to .npz with arrays x, y, t and p"
        )
    packed = np.frombuffer(content, np.uint8).reshape(-1, BIN_EVENT_BYTES)
    x, y, polarity_and_high, middle, low = packed.T.astype(np.int64)
    time = (polarity_and_high & 0x7F) << 16 | middle << 8 | low
    is_overflow = y == OVERFLOW_ROW
    time = (time + OVERFLOW_US * np.cumsum(is_overflow))[~is_overflow]
    if (np.diff(time) < 0).any():
        raise BadRecording(
            "is not a file of N-MNIST: its times are not in order; convert it to .npz with arrays "
            "x, y, t and p"
        )
    x, y, polarity = (values[~is_overflow] for values in (x, y, polarity_and_high >> 7))
    return make_recording({"x": x, "y": y, "t_us": time, "p": polarity})


def is_old_dat(content: bytes) -> bool:
    """True for a ``.dat`` file with events of type 0, which other readers do not support."""
    start = _find_end_of_header(content)
    return content[start : start + 2] == bytes([0, DAT_EVENT_BYTES])


def read_old_dat(content: bytes) -> EventRecording:
    """Read a ``.dat`` file with events of type 0.

    Raises
    ------
    BadRecording
    """
    start = _find_end_of_header(content)
    events = content[start + 2 :]
    if len(events) % DAT_EVENT_BYTES:
        raise BadRecording("is cut short within an event")
    time, packed = np.frombuffer(events, "<u4").reshape(-1, 2).T
    recording = make_recording(
        {
            "x": packed & 0x3FFF,
            "y": packed >> 14 & 0x3FFF,
            "t_us": time,
            "p": packed >> 28 & 1,
        }
    )
    header = content[:start].decode("latin-1").lower()
    sides = [re.search(rf"^% {side} (\d{{1,5}})\s*$", header, re.M) for side in ("height", "width")]
    size = [int(side[1]) for side in sides if side is not None]
    # Events outside of the size are reported with the source.
    return replace(recording, size=tuple(size) if len(size) == len(sides) else None)


def _find_end_of_header(content):
    """Position after the lines that begin with a per cent sign."""
    start = 0
    while content[start : start + 1] == b"%":
        start = content.find(b"\n", start) + 1 or len(content)
    return start
