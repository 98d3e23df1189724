"""Files of events: every format, the unit of time, and what is wrong with whole sets of them."""

import io
import struct

import numpy as np
import pytest

from deploy.errors import SeveralErrors, UserError
from deploy.files import read_json
from pipeline.data.archive import export_zip, read_source
from pipeline.data.eventarrays import recording_of
from pipeline.data.eventfile import read_events
from pipeline.data.facts import facts_of_file, reading_text
from pipeline.data.images import aggregate
from pipeline.data.matfile import BadRecording
from pipeline.data.sensors import Reading
from tests.command import call, missing
from tests.own_sensor import CLASSES, COLUMNS, ROWS, gestures, write_folder
from tests.pipeline.handmade import archive, assert_same, npz

X, Y, T, P = (np.array(a) for a in ([3, 0, 11, 5], [0, 8, 2, 2], [50, 300, 300, 838], [1, 0, 1, 0]))
"""Four events in order of time, in milliseconds; 12 columns, 9 rows."""


def npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def structured(t=T):
    array = np.empty(4, [("x", "<i2"), ("y", "<i2"), ("p", "?"), ("t", "<i8")])
    array["x"], array["y"], array["t"], array["p"] = X, Y, t, P
    return array


def nmnist(t=1000 * T) -> bytes:
    rows = np.stack([X, Y, P << 7 | t >> 16, t >> 8 & 255, t & 255], 1)
    return rows.astype(np.uint8).tobytes()


def aedat3(t=1000 * T) -> bytes:
    """A packet of something else, then one of events of pixels, one of which is not valid."""
    other = struct.pack("<HHIIIIII", 0, 0, 8, 4, 0, 1, 1, 1) + bytes(8)
    words = [(int(x) << 17 | int(y) << 2 | int(p) << 1 | 1, int(when))
             for x, y, p, when in zip(X, Y, P, t, strict=True)]  # fmt: skip
    words.insert(2, (7 << 17 | 7 << 2, int(t[1])))
    pixels = struct.pack("<HHIIIIII", 1, 0, 8, 4, 0, 5, 5, 4)
    pixels += b"".join(struct.pack("<II", *word) for word in words)
    return b"#!AER-DAT3.1\r\n#Format: RAW\r\n#!END-HEADER\r\n" + other + pixels


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
    "rows of DV.npz": npz(np.stack([T, X, Y, P], 1)),
    "structured.npy": npy(structured()),
    "rows.npy": npy(np.stack([X, Y, T, P], 1).astype(float)),
    "columns first.npy": npy(np.asfortranarray(np.stack([X, Y, P, T], 1))),
    "lines.csv": CSV.encode(),
    "named.csv": NAMED_CSV.encode(),
    "nmnist.bin": nmnist(),
    "gesture.aedat": aedat3(),
}


@pytest.mark.parametrize("name", FILES)
def test_a_format_is_read(name):
    read = read_events(FILES[name], name)
    np.testing.assert_array_equal(read.x, X)
    np.testing.assert_array_equal(read.y, Y)
    np.testing.assert_array_equal(read.polarity, 2 * P - 1)
    np.testing.assert_array_equal(read.time, 1000 * T if read.unit == "us" else T)


@pytest.mark.parametrize(("order", "scale"), [("xytp", 1), ("txyp", 1000)])
def test_the_order_of_columns_without_names(order, scale):
    """x increases and the times do not: they are no x, unless they are larger than any x."""
    columns = {"x": [1, 2, 3, 3], "y": [2, 2, 1, 2], "t": [10, 30, 20, 40], "p": [1, 0, 1, 0]}
    if order == "txyp":
        columns["t"] = [10, 20, 30, 40]
    columns["t"] = scale * np.array(columns["t"])
    rows = np.stack([columns[name] for name in order], 1)
    read = read_events("\n".join(",".join(map(str, row)) for row in rows).encode(), "a.csv")
    assert sorted(read.x) == columns["x"]
    assert sorted(read.time) == sorted(columns["t"])


@pytest.mark.parametrize(("suffix", "version"), [
    (".aedat4", None), (".raw", "evt2"), (".raw", "evt3"), (".dat", "dat2"),
])  # fmt: skip
def test_a_camera_s_file_is_read(tmp_path, suffix, version):
    faery = pytest.importorskip("faery", reason="reads files of cameras")
    events = np.empty(4, faery.EVENTS_DTYPE)
    events["t"], events["x"], events["y"], events["on"] = 1000 * T, X, Y, P
    path = tmp_path / f"a{suffix}"
    faery.events_stream_from_array(events, (COLUMNS, ROWS)).to_file(path, version=version)
    read = read_events(path.read_bytes(), path.name)
    np.testing.assert_array_equal(read.x, X)
    np.testing.assert_array_equal(read.y, Y)
    np.testing.assert_array_equal(np.diff(read.time), np.diff(1000 * T))
    np.testing.assert_array_equal(read.polarity, 2 * P - 1)
    assert (read.unit, read.size) == ("us", (ROWS, COLUMNS))
    for damaged in (path.read_bytes()[:40], b"no camera's", b""):
        with pytest.raises(BadRecording):
            read_events(damaged, path.name)


@pytest.mark.parametrize(("name", "content", "fact"), [
    ("a.bin", nmnist()[:-1], "N-MNIST"),
    ("a.aedat", b"x", "AEDAT"),
    ("a.aedat", aedat3()[:-1], "short"),
    ("a.aedat", aedat3()[:60], "short"),
    ("a.aedat", b"#!AER-DAT3.1\r\n#!END-HEADER\r\n", "empty"),
    ("a.csv", b"1,2,3,4\n1,2,3", "line"),
    ("a.csv", b"\xff", "UTF-8"),
    ("a.csv", b"x,y,t\n1,2,3", "'p'"),
    ("a.npy", npy(np.zeros((2, 5))), r"\(2, 5\)"),
    ("a.npy", npy(X)[:-1], "damaged"),
    ("a.npz", npz(x=X, y=Y, t=T), "'p'"),
    ("a.npz", npz(x=X, y=Y, t=T, p=[-1, 0, 1, 0]), "p has -1, 0 and 1"),
])  # fmt: skip
def test_a_damaged_file_is_refused(name, content, fact):
    with pytest.raises(BadRecording, match=fact):
        read_events(content, name)


def own(per_class=4, scale=1e6, kind=np.int64, **instead):
    """Members of an archive of gestures, times in microseconds unless told otherwise."""
    members = {}
    for index, ((x, y, t, p), label) in enumerate(gestures(per_class)):
        arrays = {
            "x": x,
            "y": y,
            "t": np.rint(t * scale).astype(kind) if kind else t * scale,
            "p": p,
        }
        changed = {name: change(arrays[name]) for name, change in instead.items()}
        members[f"{CLASSES[label]}/{index:03d}.npz"] = npz(**{**arrays, **changed})
    return members


@pytest.mark.parametrize(("scale", "kind", "unit"), [
    (1, None, "seconds"), (1e3, np.int64, "milliseconds"), (1e3, None, "milliseconds"),
    (1e6, np.int64, "microseconds"), (1e6, float, "microseconds"), (1e9, np.int64, "nanoseconds"),
])  # fmt: skip
def test_the_unit_of_time_is_recognised_and_said(tmp_path, scale, kind, unit):
    archive(tmp_path / "own.zip", own(scale=scale, kind=kind))
    read = read_source(tmp_path / "own.zip", jobs=1)
    expected = np.concatenate([t for (_, _, t, _), _ in gestures(4)])
    np.testing.assert_allclose(read.events.time_ns * 1e-9, expected, atol=6e-4)
    text = reading_text(read)
    facts = ("16 recordings", f"{ROWS} rows", f"{COLUMNS} columns", "4 classes", f" {unit}")
    assert missing(text, *facts) == []


@pytest.mark.parametrize(("named", "unit", "time"), [
    ({"t": T, "start_us": np.array([7])}, "", T),
    ({"t_ms": T, "event_us": T}, "ms", T),
    ({"t": T, "t_us": 1000 * T}, "us", 1000 * T),
    ({"T_US": 1000 * T}, "us", 1000 * T),
])  # fmt: skip
def test_the_unit_is_that_of_the_name_of_the_times(named, unit, time):
    read = recording_of({"x": X, "y": Y, "p": P, **named})
    assert read.unit == unit
    np.testing.assert_array_equal(read.time, time)


def test_the_unit_that_is_given_counts(tmp_path):
    archive(tmp_path / "own.zip", own(scale=1e6))
    read = read_source(tmp_path / "own.zip", jobs=1, reading=Reading(time_unit="ns"))
    assert read.events.time_ns.max() < 2_100_000
    with pytest.raises(UserError, match=r"16 of 16 .*milliseconds.*time"):
        read_source(tmp_path / "own.zip", jobs=1, reading=Reading(time_unit="ms"))


def test_a_clock_that_runs_since_1970(tmp_path):
    """A camera's clock: recordings begin with their first event."""
    archive(tmp_path / "own.zip", own(t=lambda t: t + 1_700_000_000_000_000))
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert (read.events.time_ns[read.offsets[:-1]] == 0).all()
    assert read.sensor.duration_s < 2


def test_a_clock_that_began_with_the_first_recording(tmp_path):
    """Recordings of up to 1.9 s, one every 10 s; those of the first minute are no exception."""
    members = {}
    for index, ((x, y, t, p), label) in enumerate(gestures(4)):
        members[f"{CLASSES[label]}/{index:03d}.npz"] = npz(x=x, y=y, t_s=t + 10 * index, p=p)
    for number in (16, 5):  # until 150 s, and until 40 s
        archive(tmp_path / "own.zip", dict(list(members.items())[:number]))
        read = read_source(tmp_path / "own.zip", jobs=1)
        assert (read.events.time_ns[read.offsets[:-1]] == 0).all()
        assert read.sensor.duration_s < 2


def refused(tmp_path, members, reading=None) -> list:
    """The lines of the error that reading an archive ends with."""
    archive(tmp_path / "own.zip", members)
    with pytest.raises(UserError) as caught:
        read_source(tmp_path / "own.zip", jobs=1, reading=reading or Reading())
    return list(getattr(caught.value, "lines", [str(caught.value)]))


def test_mixed_units(tmp_path):
    members = own()
    name = min(members)
    x, y, t, p = gestures(1)[0][0]
    (line,) = refused(tmp_path, {**members, name: npz(x=x, y=y, t=t, p=p)})
    assert missing(line, "1 of 16 ", name, "time") == []


def test_coordinates_from_1(tmp_path):
    (line,) = refused(tmp_path, own(x=lambda x: x + 1, y=lambda y: y + 1))
    assert missing(line, "16 of 16", "x = 0", "y = 0", "skin.rows") == []
    taken = read_source(tmp_path / "own.zip", jobs=1, reading=Reading(ROWS + 1, COLUMNS + 1))
    assert aggregate(taken)[:, 0].sum() == 0


def test_sensors_of_different_sizes(tmp_path):
    members, (x, y, t, p) = own(), gestures(1)[0][0]
    other = {f"{CLASSES[0]}/other{i}.npz": npz(x=3 * x, y=3 * y, t=t * 1e6, p=p) for i in (0, 1)}
    (line,) = refused(tmp_path, {**members, **other})
    assert missing(line, "2 of 18 ", "other0.npz", "--rows") == []
    assert len(read_source(tmp_path / "own.zip", jobs=1, reading=Reading(27, 36))) == 18


def test_as_many_recordings_of_a_larger_sensor(tmp_path):
    filled = {"t": np.arange(4) / 10, "p": [1, 0, 1, 0]}
    small = npz(x=[0, 11, 0, 11], y=[0, 8, 8, 0], **filled)
    large = npz(x=[0, 23, 0, 23], y=[0, 17, 17, 0], **filled)
    members = {f"{name}/{i}.npz": c for name in "ab" for i, c in enumerate([small, large] * 4)}
    (line,) = refused(tmp_path, members)
    assert missing(line, "8 of 16 ", "--rows") == []
    partly = npz(x=[0, 4, 0, 4], y=[0, 8, 8, 0], **filled)  # a short touch on the large sensor
    archive(tmp_path / "one.zip", {**members, "a/0.npz": partly})
    assert len(read_source(tmp_path / "one.zip", jobs=1)) == 16


def test_everything_that_is_wrong_is_said_at_once(tmp_path):
    """A line a kind, with a count, whatever the number of files."""
    members = own(x=lambda x: x + 1, y=lambda y: y + 1)
    some = [name for name in members if name.startswith(CLASSES[1])]
    nothing = npz(x=[], y=[], t=[], p=[])
    members |= dict.fromkeys(some[:3], nothing) | {"lone/0.npz": members[some[3]]}
    lines = refused(tmp_path, members)
    for facts in (["x = 0", "y = 0"], ["3 of 17 ", "empty"], ["'lone'"]):
        assert sum(not missing(line, *facts) for line in lines) == 1
    assert len(lines) == 3


def test_several_lines_on_the_terminal_and_nothing_written(tmp_path, capsys):
    members = own(x=lambda x: x + 1, y=lambda y: y + 1)
    archive(tmp_path / "own.zip", {**members, "lone/0.npz": npz(x=[], y=[], t=[], p=[])})
    assert call("ladder", tmp_path / "run", "--data", tmp_path / "own.zip") == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("stmnist: ") for line in lines)


def test_a_sensor_with_too_many_pixels_is_downsampled(tmp_path):
    members = own(x=lambda x: 100 * x, y=lambda y: 40 * y)
    (line,) = refused(tmp_path, members)
    assert "data.downsample=5" in line
    read = read_source(tmp_path / "own.zip", jobs=1, reading=Reading(downsample=40))
    assert (read.sensor.rows, read.sensor.columns) == (ROWS, 28)


@pytest.mark.parametrize("rows", [1, 2])
def test_a_sensor_of_one_row(tmp_path, rows):
    archive(tmp_path / "own.zip", own(y=lambda y: y % rows))
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (rows, COLUMNS)


def test_three_hundred_classes(tmp_path):
    content = npz(x=X, y=Y, t=T, p=P)
    members = {f"class {i}/{j}.npz": content for i in range(300) for j in (0, 1)}
    archive(tmp_path / "own.zip", members)
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert len(read.sensor.classes) == 300
    assert read.sensor.classes[299] == "class 299"


def test_an_export_is_read_again(tmp_path):
    folder = write_folder(tmp_path / "own", per_class=3)
    assert export_zip(tmp_path / "own.zip", folder) == 12
    again, first = read_source(tmp_path / "own.zip", jobs=1), read_source(folder, jobs=1)
    assert_same(again, first, source=False)
    assert again.sensor == first.sensor


def test_a_table_beside_the_classes_is_no_recording(tmp_path):
    archive(tmp_path / "own.zip", {**own(), "labels.csv": b"name,comment\na,b\n"})
    assert len(read_source(tmp_path / "own.zip", jobs=1)) == 16


def test_a_class_of_another_format_is_not_taken_for_tables(tmp_path):
    """Two classes of .npz files, and a third one of .csv files."""
    lines = {f"swipe/{i}.csv": CSV.encode() for i in range(4)}
    (line,) = refused(tmp_path, {**own(), **lines})
    assert missing(line, ".csv", "4 of 20 ", "swipe/0.csv") == []
    archive(tmp_path / "own.zip", {**own(), "about/people.csv": b"name,age\nA,30\n"})
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert (len(read), len(read.source.left_out)) == (16, 1)


def test_later_recordings_of_a_class_in_another_format_are_not_taken_for_tables(tmp_path):
    """After some weeks, recordings are saved as .csv in the same folders."""
    later = {f"{CLASSES[0]}/later{i}.csv": CSV.encode() for i in range(3)}
    table = {f"{CLASSES[0]}/about.csv": b"name,comment\na,b\n"}
    (line,) = refused(tmp_path, {**own(), **later, **table})
    assert missing(line, ".csv", "3 of 19 ", "later0.csv") == []
    names = [name for name in own() if name.startswith(CLASSES[0])]
    copies = {
        name.replace(".npz", end): CSV.encode() for name in names for end in (".csv", "_raw.csv")
    }
    archive(tmp_path / "own.zip", {**own(), **copies})
    assert len(read_source(tmp_path / "own.zip", jobs=1)) == 16


@pytest.mark.parametrize("place", ["about.csv", f"{CLASSES[0]}/about.csv", f"{CLASSES[0]}/x/a.npy"])
def test_a_table_beside_recordings_is_left_out(tmp_path, place):
    root = {f"own/{name}": content for name, content in own().items()}
    archive(tmp_path / "own.zip", {**root, f"own/{place}": b"a,b"})
    assert len(read_source(tmp_path / "own.zip", jobs=1)) == 16


@pytest.mark.parametrize("name", ["swipe/0.txt", "swipe/.DS_Store"])
def test_a_folder_beside_the_classes_without_recordings(tmp_path, name):
    archive(tmp_path / "own.zip", {**own(), name: b"x"})
    read = read_source(tmp_path / "own.zip", jobs=1)
    (line,) = read.source.left_out
    assert (len(read), line.partition(":")[0]) == (16, "swipe")


def test_a_class_that_is_a_link_to_a_folder(tmp_path):
    folder = write_folder(tmp_path / "own", per_class=2)
    (tmp_path / "elsewhere").mkdir()
    (folder / "swipe").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"swipe .*link"):
        read_source(folder, jobs=1)


def test_arrays_of_many_forms():
    for events in (
        (X, Y, T, P),
        [list(X), list(Y), list(T), list(P)],
        {"x": X, "y": Y, "t": T, "p": P == 1},
        {"Column": X, "row": Y, "timestamp": T, "polarity": P},
        structured(),
        np.stack([X, Y, T, P], 1),
    ):
        read = recording_of(events)
        np.testing.assert_array_equal(read.x, X)
        np.testing.assert_array_equal(read.time, T)
    with pytest.raises(BadRecording, match="shape"):
        recording_of(np.zeros((3, 3)))


def test_inspect_says_the_unit(tmp_path, capsys):
    path = tmp_path / "a.bin"
    path.write_bytes(nmnist())
    assert call("data", "inspect", path, "--json") == 0
    (tmp_path / "facts.json").write_text(capsys.readouterr().out)
    facts = read_json(tmp_path / "facts.json", "")
    assert facts["time_unit"] == "us"
    assert facts["sensor"] == {"rows": 9, "columns": 12}
    assert facts["t_last_s"] == pytest.approx(0.838)


def test_taxels_of_a_large_sensor_are_counted(tmp_path):
    """The numbers of its pixels are larger than 16 bits hold."""
    path = tmp_path / "a.npz"
    path.write_bytes(npz(x=[0, 512], y=[127, 127], t_us=[0, 900], p=[0, 1]))  # 512 * 128 = 2**16
    assert facts_of_file(path)["taxels"] == 2


def test_lines_of_several_errors():
    error = SeveralErrors(["one", "two"])
    assert error.lines == ("one", "two")
    assert str(error) == "one; two"


def test_the_unit_of_the_training_is_that_of_a_person_whose_files_have_none(tmp_path):
    """Taps of 55 ms fit milliseconds as well, as recordings of 55 s."""
    t = np.arange(0, 55_000, 5_000)
    members = {
        f"{name}/{i}.npz": npz(x=t % 3, y=t % 2, t=t, p=np.ones(len(t)))
        for name in "ab"
        for i in range(3)
    }
    archive(tmp_path / "fifth.zip", members)

    def unit(**given):
        read = read_source(tmp_path / "fifth.zip", jobs=1, reading=Reading(**given))
        return read.source.time_unit

    assert unit() == "ms"
    assert unit(usual_unit="us") == "us"
    assert unit(time_unit="ms", usual_unit="us") == "ms"
