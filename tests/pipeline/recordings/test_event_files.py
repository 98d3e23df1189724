"""Files of events in every format, and arrays written as such files."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.errors import SeveralErrors, UserError
from pipeline.recordings.files.writing import write_recordings
from pipeline.recordings.formats import read_file
from pipeline.recordings.formats.csv import read_csv
from pipeline.recordings.formats.recording import BadRecording, make_recording
from pipeline.recordings.images import make_tactile_images
from pipeline.recordings.interpretation.times import to_ns
from pipeline.recordings.sensor import TaxelMap
from pipeline.sources import load_recordings
from tests.own_sensor import CLASSES, COLUMNS, ROWS, gestures
from tests.pipeline.handmade import npz

# Four events in order of time, in milliseconds; 12 columns, 9 rows.
X, Y, T, P = (np.array(a) for a in ([3, 0, 11, 5], [0, 8, 2, 2], [50, 300, 300, 838], [1, 0, 1, 0]))


def npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def structured(t=T):
    array = np.empty(4, [("x", "<i2"), ("y", "<i2"), ("p", "?"), ("t", "<i8")])
    array["x"], array["y"], array["t"], array["p"] = X, Y, t, P
    return array


CSV = "\n".join(f"{x},{y},{t},{p}" for x, y, t, p in zip(X, Y, T, P, strict=True))
NAMED_CSV = "timestamp; polarity; x; y\n" + "\n".join(
    f"{t};{p};{x};{y}" for x, y, t, p in zip(X, Y, T, P, strict=True)
)

FILES = {
    "four arrays.npz": npz(x=X, y=Y, t=T, p=P),
    "truth values.npz": npz(x=X, y=Y, t=T, p=P == 1),
    "minus one.npz": npz(x=X, y=Y, t=T, p=2 * P - 1),
    "long names.npz": npz(x=X.astype(float), y=Y.astype(np.uint8), t=T.astype("f4"), p=P),
    "structured.npz": npz(events=structured()),
    "rows.npz": npz(np.stack([X, Y, T, P], 1)),
    "structured.npy": npy(structured()),
    "rows.npy": npy(np.stack([X, Y, T, P], 1).astype(float)),
    "columns first.npy": npy(np.asfortranarray(np.stack([X, Y, T, P], 1))),
    "lines.csv": CSV.encode(),
    "named.csv": NAMED_CSV.encode(),
    "by NumPy.csv": b"# x,y,t,p\n" + CSV.encode(),
    "with comments.csv": b"# on a strip\n" + CSV.encode() + b"\n# end, done\n \x1f\n",
    "other order.csv": b"# of 2020\n# p t, x, y\n"
    + "\n".join(f"{p},{t},{x},{y}" for x, y, t, p in zip(X, Y, T, P, strict=True)).encode(),
    "of Metavision.csv": b"%geometry:640,480\n" + CSV.encode(),
    "a remark in a line.csv": NAMED_CSV.encode() + b"  # lifted; at the end\n",
    "remarks after blanks.csv": CSV.replace(",", " ").encode() + b" # moved, twice\n",
    "a column of text.csv": b"x,note,y,t,p\n"
    + "\n".join(f"{x},up,{y},{t},{p}" for x, y, t, p in zip(X, Y, T, P, strict=True)).encode(),
    "semicolons and decimal commas.csv": b"x;y;t;p\n"
    + "\n".join(f"{x};{y};{t},0;{p}" for x, y, t, p in zip(X, Y, T, P, strict=True)).encode(),
    "signs.csv": NAMED_CSV.replace(";1;", ";+;").replace(";0;", ";-;").encode(),
    "a typographic minus.csv": NAMED_CSV.replace(";0;", ";\u22121;").encode(),
    "on and off.csv": b"x,y,t,on\n"
    + "\n".join(
        f"{x},{y},{t},{'ON' if p else 'OFF'}" for x, y, t, p in zip(X, Y, T, P, strict=True)
    ).encode(),
    "truth values.csv": NAMED_CSV.replace(";1;", ";True;").replace(";0;", ";false;").encode(),
}


@pytest.mark.parametrize("name", FILES)
def test_a_format_is_read(name):
    read = read_file(FILES[name], name)
    np.testing.assert_array_equal(read.x, X)
    np.testing.assert_array_equal(read.y, Y)
    np.testing.assert_array_equal(read.polarity, 2 * P - 1)
    np.testing.assert_array_equal(read.time, 1000 * T if read.unit == "us" else T)


@pytest.mark.parametrize(("suffix", "version"), [
    (".aedat4", None), (".raw", "evt2"), (".raw", "evt3"), (".dat", "dat2"),
])  # fmt: skip
def test_a_camera_s_file_is_read(tmp_path, capfd, suffix, version):
    faery = pytest.importorskip("faery", reason="reads files of cameras")
    events = np.empty(4, faery.EVENTS_DTYPE)
    events["t"], events["x"], events["y"], events["on"] = 1000 * T, X, Y, P
    path = tmp_path / f"a{suffix}"
    faery.events_stream_from_array(events, (COLUMNS, ROWS)).to_file(path, version=version)
    read = read_file(path.read_bytes(), path.name)
    np.testing.assert_array_equal(read.x, X)
    np.testing.assert_array_equal(read.y, Y)
    np.testing.assert_array_equal(np.diff(read.time), np.diff(1000 * T))
    np.testing.assert_array_equal(read.polarity, 2 * P - 1)
    assert (read.unit, read.size) == ("us", (ROWS, COLUMNS))
    header_alone = b"#!AER-DAT4.0\r\n" + bytes(200)
    for damaged in (path.read_bytes()[:40], b"no camera's", b"", header_alone):
        with pytest.raises(BadRecording):
            read_file(damaged, path.name)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("name", "content", "fact"), [
    ("a.csv", b"1,2,3,4\n1,2,3", "line 2 has 3 values"),
    ("a.csv", b"# of a sensor\n\nx,y,t,p\n1,2,3,1\n\n1,2,3.5s,1", "line 6: '3.5s' is not a number"),
    ("a.csv", b"when,col_x,col_y,sign\n1,2,3,1", "line 1 has none of the names x, y, t and p"),
    ("a.csv", b"t,x,y,p\n1,2,3,up", "line 2: 'up' is not a polarity; write 1 and 0"),
    ("a.csv", b"1 2 3 1\n1 2 4 1\n1 ? 3 1", "line 3: '\\?' is not a number"),
    ("a.csv", b"x,y,t,p\n1,2,3,1\n\n1.5,2,4,1", "line 4 has x 1.5"),
    ("a.csv", b"x,y,t,p\n1,2,3,1\n1,2,nan,1", "line 3 has a time that is NaN"),
    ("a.csv", b"1,2,3,1\n1,2,4,5", "line 2 has p 5"),
    ("a.csv", b"x,y,t,p\n1,2,3,-1\n1,2,3,1\n1,2,4,0", "line 4 has p -1, 0 and 1"),
    ("a.csv", b"\xff", "UTF-8"),
    ("a.csv", b"x,y,t,p\n", "empty"),
    ("a.csv", b"x,y,t\n1,2,3", "'p'"),
    ("a.csv", b"a,x,y,t,p\n9,1,2,0,1\n9,1,2,0,5,1", "line 3 has 6 columns below 5"),
    ("a.npy", npy(np.zeros((2, 5))), r"\(2, 5\)"),
    ("a.npy", npy(X)[:-1], "damaged"),
    ("a.npz", npz(x=X, y=Y, t=T), "'p'"),
    ("a.npz", npz(x=X, y=Y, t=T, p=[-1, 0, 1, 0]), "has p -1, 0 and 1"),
])  # fmt: skip
def test_a_damaged_file_is_refused(name, content, fact):
    with pytest.raises(BadRecording, match=fact):
        read_file(content, name)


@pytest.mark.parametrize(("named", "unit", "time"), [
    ({"t": T, "start_us": np.array([7])}, "", T),
    ({"t_ms": T, "event_us": T}, "ms", T),
    ({"t": T, "t_us": 1000 * T}, "us", 1000 * T),
    ({"T_US": 1000 * T}, "us", 1000 * T),
    ({"Time (ms)": T}, "ms", T),
    ({"timestamp[us]": 1000 * T, "ts": T}, "us", 1000 * T),
    ({"ts_ns": 10**6 * T}, "ns", 10**6 * T),
    ({"ts": T}, "", T),
])  # fmt: skip
def test_the_unit_is_that_of_the_name_of_the_times(named, unit, time):
    read = make_recording({"x": X, "y": Y, "p": P, **named})
    assert read.unit == unit
    np.testing.assert_array_equal(read.time, time)


@settings(max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_an_event_file_is_read_as_it_was_written(rows, columns, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 50))
    x, y = rng.integers(0, columns, n), rng.integers(0, rows, n)
    t, p = rng.permutation(n) * 1e-6, rng.choice([-1, 1], n).astype(np.int8)
    read = read_file(npz(x=x.astype(np.uint8), y=y.astype(float), t=t, p=p), "a.npz")
    order = np.argsort(t)
    np.testing.assert_array_equal(read.x, x[order])
    np.testing.assert_array_equal(read.y, y[order])
    np.testing.assert_array_equal(to_ns(read.time, "s"), np.arange(n) * 1000)
    np.testing.assert_array_equal(read.polarity, p[order])
    taxels = TaxelMap.grid(rows, columns)
    taxel = read.to_events(rows, read.time).taxel
    np.testing.assert_array_equal(taxels.column[taxel], x[order])
    np.testing.assert_array_equal(taxels.row[taxel], y[order])


GOOD = {"x": [0, 1], "y": [0, 2], "t": [0.1, 0.2], "p": [1, -1]}


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"x": [0, -1]}, "x -1, .* 0 to 16383"),
        ({"y": [0.5, 1]}, "y 0.5"),
        ({"y": [np.nan, 1]}, "y nan"),
        ({"x": [0, 16384]}, "x 16384, .* 0 to 16383"),
        ({"t": [0.1, np.nan]}, "NaN"),
        ({"t": [-0.1, 0.2]}, "negative"),
        ({"p": [1, 2]}, r"has p 2, .* 1 \(ON\) and -1 \(OFF\)"),
        ({"p": [1]}, "x 2, y 2, t 2, p 1"),
        ({"x": [], "y": [], "t": [], "p": []}, "empty"),
        ({"x": ["a", "b"]}, "'x'"),
        ({"x": [[0, 1]]}, "'x'"),
        ({"x": np.array([0, None])}, "'x'"),
        ({"t": np.array([0.1, 0.2], np.complex128)}, "'t'"),
    ],
)
def test_a_bad_event_file(change, fact):
    with pytest.raises(BadRecording, match=fact):
        read_file(npz(**{**GOOD, **change}), "a.npz")


@settings(max_examples=200)
@given(st.data())
def test_damaged_event_files_are_refused_or_read(data):
    content = bytearray(npz(**GOOD))
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        read = read_file(bytes(content), "a.npz")
    except BadRecording:
        return
    assert len(read.x) == len(read.y) == len(read.time) == len(read.polarity) > 0


def test_arrays_of_many_forms():
    for events in (
        (X, Y, T, P),
        [X, Y, T, P],
        {"x": X, "y": Y, "t": T, "p": P == 1},
        {"Column": X, "row": Y, "timestamp": T, "polarity": P},
        structured(),
        np.stack([X, Y, T, P], 1),
    ):
        read = make_recording(events)
        np.testing.assert_array_equal(read.x, X)
        np.testing.assert_array_equal(read.time, T)
    with pytest.raises(BadRecording, match="shape"):
        make_recording(np.zeros((3, 5)))
    with pytest.raises(BadRecording, match="polarity p"):
        make_recording((X, Y, T))


class LikeTonic:
    """A data set as Tonic has them: structured events in microseconds, and a number."""

    classes = CLASSES

    def __init__(self, per_class):
        self.items = gestures(per_class)

    def __len__(self):
        return len(self.items)

    def __getitem__(self, index):
        (x, y, t, p), label = self.items[index]
        events = np.empty(len(x), [("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
        events["x"], events["y"], events["t"], events["p"] = x, y, np.rint(t * 1e6), p > 0
        return events, label


def test_arrays_and_a_data_set_of_tonic_s_come_back(tmp_path):
    tonic = write_recordings(tmp_path / "tonic.zip", LikeTonic(3))
    plain = write_recordings(tmp_path / "plain.zip", gestures(3), CLASSES, "s", simulated=True)
    tonic, plain = (load_recordings(str(path), jobs=1) for path in (tonic, plain))
    assert tonic.sensor.classes == plain.sensor.classes == CLASSES
    assert (tonic.source.simulated, plain.source.simulated) == (False, True)
    np.testing.assert_array_equal(tonic.labels, [label for _, label in gestures(3)])
    np.testing.assert_array_equal(make_tactile_images(tonic), make_tactile_images(plain))
    expected = np.concatenate([t for (_, _, t, _), _ in gestures(3)])
    np.testing.assert_allclose(tonic.events.time_ns * 1e-9, expected, atol=1e-6)
    np.testing.assert_allclose(plain.events.time_ns * 1e-9, expected, atol=1e-9)


def test_names_writers_and_the_unit(tmp_path):
    named = [((x, y, 1000 * t, p), CLASSES[label]) for (x, y, t, p), label in gestures(2)]
    path = write_recordings(tmp_path / "a.zip", named, time_unit="ms", writers=range(8))
    read = load_recordings(str(path), jobs=1)
    assert read.sensor.classes == CLASSES
    assert sorted(read.writers.tolist()) == list(range(8))
    assert read.source.time_unit == "ms"


@pytest.mark.parametrize(("items", "fact"), [
    ([((0, 1), 0)] * 2, "2 of 2: recording 0"),
    ([(events, 9) for events, _ in gestures(1)], "label 9"),
    ([(events, "../up") for events, _ in gestures(1)], r"'\.\./up'"),
    ([(events, "unknown") for events, _ in gestures(1)], "'unknown'"),
    ([(label, events) for events, label in gestures(1)], "tuple"),
    ([], r"a\.zip"),
])  # fmt: skip
def test_what_cannot_be_written(tmp_path, items, fact):
    with pytest.raises(SeveralErrors, match=fact):
        write_recordings(tmp_path / "a.zip", items, CLASSES)
    assert list(tmp_path.iterdir()) == []


def test_classes_without_an_order(tmp_path):
    for classes in (set(CLASSES), frozenset(CLASSES)):
        with pytest.raises(ValueError, match="order"):
            write_recordings(tmp_path / "a.zip", gestures(1), classes)


def test_a_published_split_of_arrays(tmp_path):
    parts = ["train", "train", "test"] * 4
    path = write_recordings(tmp_path / "a.zip", gestures(3), CLASSES, parts=parts)
    read = load_recordings(str(path), jobs=1)
    assert read.parts == ("train",) * 8 + ("test",) * 4
    with pytest.raises(UserError, match="'train' or 'test'"):
        write_recordings(path, gestures(3), CLASSES, parts=["val"] * 12)


@pytest.mark.parametrize(("changes", "fact"), [
    ({"writers": [0] * 11}, "each"),
    ({"parts": ["train"] * 13}, "each"),
    ({"writers": [0.5] * 12}, "whole number"),
    ({"writers": [-1] * 12}, "whole number"),
    ({"classes": ["a", "b", "a", "c"]}, "same name"),
])  # fmt: skip
def test_writers_parts_and_classes_that_do_not_fit(tmp_path, changes, fact):
    for items in (gestures(3), iter(gestures(3))):  # as zip(events, labels) gives them
        with pytest.raises(UserError, match=fact):
            write_recordings(tmp_path / "a.zip", items, **{"classes": CLASSES, **changes})
    assert list(tmp_path.iterdir()) == []


def test_four_events_in_lists_are_rows_or_columns():
    rows = [[1, 2, 0, 1], [2, 2, 1, 0], [3, 3, 5, 1], [0, 1, 9, 0]]
    with pytest.raises(BadRecording, match="rows or columns"):
        make_recording(rows)
    np.testing.assert_array_equal(make_recording(np.array(rows)).x, [1, 2, 3, 0])


@pytest.mark.parametrize("first", ["x,y,t\n", ""])
def test_a_csv_without_a_polarity_says_what_to_write(first):
    with pytest.raises(BadRecording, match="polarity p: 1 for ON"):
        read_csv(f"{first}1,2,0.5\n2,2,0.6\n".encode())
