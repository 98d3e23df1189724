"""N-MNIST's files, and .dat files with events of type 0."""

import numpy as np
import pytest

from pipeline.recordings.formats import read_file
from pipeline.recordings.formats.recording import BadRecording

# x, y, polarity and time of the events of each file.
EVENTS = ((33, 2, 1, 5), (0, 31, 0, 300), (7, 7, 1, 70_000))
HEADER = b"% Data file containing Event2d events.\n% Version 2\n% Height 60\n% Width 100\n"


def pack_bin(events):
    packed = [(x << 32 | y << 24 | p << 23 | t).to_bytes(5, "big") for x, y, p, t in events]
    return b"".join(packed)


def pack_dat(events, kind=0):
    packed = [(t, x | y << 14 | p << 28) for x, y, p, t in events]
    return HEADER + bytes([kind, 8]) + np.array(packed, "<u4").tobytes()


@pytest.mark.parametrize(("pack", "suffix"), [(pack_bin, "bin"), (pack_dat, "dat")])
def test_events(pack, suffix):
    recording = read_file(pack(EVENTS), f"a/1.{suffix}")
    x, y, p, t = zip(*EVENTS, strict=True)
    assert recording.x.tolist() == list(x)
    assert recording.y.tolist() == list(y)
    assert recording.time.tolist() == list(t)
    assert recording.polarity.tolist() == [2 * value - 1 for value in p]
    assert recording.unit == "us"
    assert recording.size == ((60, 100) if suffix == "dat" else None)


def test_an_overflow_adds_to_the_times_after_it():
    events = (EVENTS[0], (0, 240, 0, 10), (1, 1, 1, 20))
    assert read_file(pack_bin(events), "a/1.bin").time.tolist() == [5, 20 + (1 << 13)]


@pytest.mark.parametrize(
    "content", [pack_bin(EVENTS)[:-1], pack_bin(EVENTS[::-1]), pack_dat(EVENTS)[:-1]]
)
def test_other_files(content):
    with pytest.raises(BadRecording):
        read_file(content, "a/1.dat" if content.startswith(b"%") else "a/1.bin")


def test_the_reason_of_the_library_is_passed_on():
    pytest.importorskip("faery")
    with pytest.raises(BadRecording, match=r"faery.*npz"):
        read_file(pack_dat(EVENTS, kind=7), "a/1.dat")
