"""The formats conform, and what checks it finds the usual mistakes of a reader."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import h5py
import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.recordings.conformance import assert_format_conforms
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats import READERS
from pipeline.recordings.formats.recording import (
    BadRecording,
    make_numbered_recording,
    make_recording,
)
from tests.pipeline.handmade import mat5, npz

EVENTS = {"x": [3, 0, 1], "y": [1, 2, 0], "t": [0.1, 0.25, 0.5], "p": [1, -1, 1]}
ARRAYS = {
    "x": np.array([3, 0, 1]),
    "y": np.array([1, 2, 0]),
    "t_ms": np.array([100, 250, 500]),
    "p": np.array([1, 0, 1]),
}
ROWS, COLUMNS = 3, 4
LINES = b"x,y,t_ms,p\n3,1,100,1\n0,2,250,0\n1,0,500,1\n"

# Columns of taxel 2 (rise), 0 (fall) and 1 (rise); the last row has the times.
SPIKETRAIN = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0], [0.1, 0.25, 0.5]])
NUMBERED = {"x": [2, 0, 1], "y": [0, 0, 0], "t": [0.1, 0.25, 0.5], "p": [1, -1, 1]}


def make_npy() -> bytes:
    events = np.array(list(zip(*ARRAYS.values(), strict=True)), [(name, "i8") for name in ARRAYS])
    buffer = io.BytesIO()
    np.save(buffer, events)
    return buffer.getvalue()


def make_hdf5() -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, values in ARRAYS.items():
            file[f"events/{name}"] = values
    return buffer.getvalue()


def make_bin() -> bytes:
    columns = zip(*ARRAYS.values(), strict=True)
    packed = [x << 32 | y << 24 | p << 23 | 1000 * t_ms for x, y, t_ms, p in columns]
    return b"".join(int(event).to_bytes(5, "big") for event in packed)


def make_camera_file(ending, folder, version=None) -> bytes:
    faery = pytest.importorskip("faery", reason="reads files of cameras")
    events = np.empty(len(ARRAYS["x"]), faery.EVENTS_DTYPE)
    events["t"] = 1000 * ARRAYS["t_ms"]
    events["x"] = ARRAYS["x"]
    events["y"] = ARRAYS["y"]
    events["on"] = ARRAYS["p"]
    path = folder / f"recording{ending}"
    faery.events_stream_from_array(events, (COLUMNS, ROWS)).to_file(path, version=version)
    return path.read_bytes()


class FileOfFormat(NamedTuple):
    """A file with the events: a function of a folder makes its content.

    `size` is the size of the sensor if a file of this format has it.
    """

    make: Callable
    events: dict = EVENTS
    size: tuple | None = None


SIZE = (ROWS, COLUMNS)

# A file for each ending in READERS.
FILES = {
    ".aedat4": FileOfFormat(lambda folder: make_camera_file(".aedat4", folder), size=SIZE),
    ".bin": FileOfFormat(lambda folder: make_bin()),
    ".csv": FileOfFormat(lambda folder: LINES),
    ".dat": FileOfFormat(lambda folder: make_camera_file(".dat", folder, "dat2"), size=SIZE),
    ".h5": FileOfFormat(lambda folder: make_hdf5()),
    ".hdf5": FileOfFormat(lambda folder: make_hdf5()),
    ".mat": FileOfFormat(lambda folder: mat5(spiketrain=SPIKETRAIN), NUMBERED),
    ".npy": FileOfFormat(lambda folder: make_npy()),
    ".npz": FileOfFormat(lambda folder: npz(**ARRAYS, rows=ROWS, columns=COLUMNS), size=SIZE),
    ".raw": FileOfFormat(lambda folder: make_camera_file(".raw", folder, "evt3"), size=SIZE),
    ".txt": FileOfFormat(lambda folder: LINES),
}


@pytest.mark.parametrize("ending", sorted(READERS))
def test_every_format_conforms(tmp_path, ending):
    assert ending in FILES, f"add a file with the ending {ending} to FILES"
    file = FILES[ending]
    content = file.make(tmp_path)
    assert_format_conforms(ending, content, file.events, tmp_path / "source", size=file.size)


CONTENT = json.dumps([EVENTS[name] for name in "xytp"]).encode()


def read_well(content, name):
    try:
        x, y, t, p = json.loads(content)
    except (ValueError, TypeError) as error:
        raise BadRecording("is not four lists of numbers") from error
    return make_recording({"x": x, "y": y, "t_s": t, "p": p})


def read_refusing(read):
    """A reader that refuses what another one cannot read."""

    def refuse(content, name):
        try:
            return read(content, name)
        except (ValueError, TypeError, IndexError) as error:
            raise BadRecording("is not such a file") from error

    return refuse


def exchange(found):
    return replace(found, x=found.y, y=found.x)


def raise_key_error(content, name):
    return read_well(content, name) if content == CONTENT else {}["x"]


def alter(change):
    return lambda content, name: change(read_well(content, name))


MISTAKES = {
    "exchanged": alter(exchange),
    "from the top": alter(lambda found: replace(found, y=2 - found.y)),
    "count from 0": alter(lambda found: replace(found, x=found.x + 1)),
    "reversed": alter(lambda found: replace(found, polarity=-found.polarity)),
    "factor 0.001": alter(lambda found: replace(found, unit="ms")),
    "no unit": alter(lambda found: replace(found, unit="")),
    "order of time": alter(lambda found: replace(found, time=found.time[::-1].copy())),
    "8-bit integers": alter(lambda found: replace(found, polarity=found.polarity.astype(int))),
    "another one for the name": lambda content, name: replace(
        read_well(content, name), x=read_well(content, name).x + ("/" in name)
    ),
    "raises KeyError": raise_key_error,
    "EventRecording": lambda content, name: (content, name),
}


@pytest.mark.parametrize("said", MISTAKES)
def test_a_mistake_is_named(tmp_path, monkeypatch, said):
    monkeypatch.setitem(READERS, ".toy", MISTAKES[said])
    with pytest.raises(AssertionError, match=said):
        assert_format_conforms(".toy", CONTENT, EVENTS, tmp_path)


def test_a_good_reader_conforms(tmp_path, monkeypatch):
    monkeypatch.setitem(READERS, ".toy", read_well)
    assert_format_conforms(".toy", CONTENT, EVENTS, tmp_path)


def test_an_unexpected_error_of_a_reader_refuses_the_file(tmp_path, monkeypatch):
    monkeypatch.setitem(READERS, ".toy", raise_key_error)
    for name, content in (("a/0", CONTENT), ("a/1", CONTENT), ("b/0", CONTENT), ("b/1", b"{}")):
        path = tmp_path / f"{name}.toy"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"b/1\.toy .*'\.toy' raises KeyError: 'x'"):
        read_source(tmp_path, jobs=1)
    assert len(read_source(tmp_path, jobs=1, skip_bad=True)) == 3


COLUMNS_OF_TWO = {"x": [0, 1], "y": [0, 1], "t": [1, 2], "p": [0, 1]}


@pytest.mark.parametrize(
    "events",
    [
        *({**COLUMNS_OF_TWO, name: wrong} for name in "xytp" for wrong in ([[1], 0], [0, None])),
        *({**COLUMNS_OF_TWO, "x": wrong} for wrong in (5, None, "ab", {}, [{}, 1], [0, 10**30])),
        *(5, None, "abcd", {}, [], [[0, 0, 0.1, 1], 5], [1, 2, 3, 4], [[1], [[2]], None, "a"]),
        *([[1, [2]], [1, 2], [1, 2], [0, 1]], [[0, 0, [1], 1], [0, 0, 2, 1], [0, 0, 3, 1]]),
        {1: [2], None: [3]},
    ],
    ids=str,
)
def test_values_of_wrong_types_are_refused(events):
    with pytest.raises(BadRecording):
        make_recording(events)


@pytest.mark.parametrize(
    "size", [5, (3,), "ab", ("a", "b"), ([3], 4), (0, 4), (3.5, 4), (np.nan, 4)]
)
def test_a_size_of_a_wrong_type_is_refused(size):
    with pytest.raises(BadRecording, match="size"):
        make_recording(ARRAYS, size=size)


@pytest.mark.parametrize(
    ("size", "stated", "said"),
    [
        ((5, 4), (4, 5), "rows and columns of the size are exchanged"),
        ((4, 4), (4, 5), "the size is"),
        (None, (4, 5), "no size"),
        ((4, 3), None, "outside of the size"),
    ],
)
def test_a_wrong_size_is_named(tmp_path, monkeypatch, size, stated, said):
    monkeypatch.setitem(READERS, ".toy", alter(lambda found: replace(found, size=size)))
    with pytest.raises(AssertionError, match=said):
        assert_format_conforms(".toy", CONTENT, EVENTS, tmp_path, size=stated)


def test_a_recording_with_a_size_has_no_event_outside():
    assert make_recording(ARRAYS, size=(ROWS, COLUMNS)).size == (ROWS, COLUMNS)
    with pytest.raises(
        BadRecording, match="x = 3, y = 1, outside of its sensor of 4 rows"
    ) as error:
        make_recording(ARRAYS, size=(COLUMNS, ROWS))
    assert error.value.event == 0


def read_numbers(content, name):
    taxel, time_ns = np.array(json.loads(content), np.int64)
    return make_numbered_recording(taxel, time_ns, np.ones(2, np.int8), 1 + taxel.max())


def test_the_size_of_a_sensor_inferred_from_one_file_is_found(tmp_path, monkeypatch):
    monkeypatch.setitem(READERS, ".toy", read_refusing(read_numbers))
    events = {"x": [2, 0], "y": [0, 0], "t": [0.1, 0.25], "p": [1, 1]}
    content = b"[[2, 0], [100000000, 250000000]]"
    other = b"[[0, 1], [100000000, 250000000]]"
    assert_format_conforms(".toy", content, events, tmp_path / "one")
    with pytest.raises(AssertionError, match="fit together"):
        assert_format_conforms(".toy", content, events, tmp_path / "two", [other])


def test_an_ending_without_a_reader_is_named(tmp_path):
    with pytest.raises(AssertionError, match="has no reader"):
        assert_format_conforms(".none", CONTENT, EVENTS, tmp_path)


@pytest.mark.parametrize(
    ("taxels", "times", "fact"),
    [([], [], "empty"), ([0, 3], [1, 2], "0 to 2"), ([0, 1], [2, 1], "order")],
)
def test_numbered_taxels_that_cannot_be(taxels, times, fact):
    arrays = np.array(taxels, int), np.array(times, np.int64), np.ones(len(taxels), np.int8)
    with pytest.raises(BadRecording, match=fact):
        make_numbered_recording(*arrays, n_taxels=3)


def test_numbered_taxels_that_no_array_of_events_can_hold():
    taxel, time_ns, polarity = np.array([5]), np.array([1]), np.array([1], np.int8)
    with pytest.raises(BadRecording, match="more than 65536"):
        make_numbered_recording(taxel, time_ns, polarity, 70_000)
    with pytest.raises(BadRecording, match="polarity"):
        make_numbered_recording(taxel, time_ns, 0 * polarity, 100)


def test_numbered_taxels_have_times_in_nanoseconds():
    result = make_numbered_recording(np.array([0]), np.array([5]), np.array([1], np.int8), 3)
    assert result.layout == "numbered"
    with pytest.raises(ValueError, match="nanoseconds"):
        replace(result, unit="s")
