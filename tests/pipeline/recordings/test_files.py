"""Zips and folders of recordings: what belongs to a source, splits, writing, the cache."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from deploy.errors import UserError
from deploy.files import hash_file
from pipeline.recordings import cached_recordings
from pipeline.recordings.files import listing, reading
from pipeline.recordings.files.listing import list_source
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.files.writing import write_mat_zip
from pipeline.recordings.formats.mat import encode_lookup_table
from pipeline.recordings.interpretation.options import ReadingOptions
from pipeline.recordings.sensor import Sensor, TaxelMap
from pipeline.sources import load_recordings
from tests.pipeline.handmade import (
    archive,
    assert_same,
    encrypt,
    good_members,
    mat5,
    npz,
    recordings,
    spiketrain,
)
from tests.pipeline.recordings.sources import error, put

# Real recordings, which are not part of the project.
SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"


def strip(index=0, taxels=7, signs=(1, -1), **named):
    """A recording of a sensor in one row: an event on each taxel, 10 ms apart."""
    n = np.arange(taxels)
    t = 1e-2 * n + 1e-3 * index * n
    return npz(**{"x": n, "y": 0 * n, "t": t, "p": np.resize(signs, taxels), **named})


def members(layout="{}/{}.npz", classes="ab", per_class=3, **how):
    return {
        layout.format(name, i): strip(i + 10 * number, **how)
        for number, name in enumerate(classes)
        for i in range(per_class)
    }


def published(per_class=3, **how):
    """A source with a published split: no recording in both parts."""
    test = members("test/{}/t{}.npz", per_class=1, **how)
    return {**members("train/{}/{}.npz", per_class=per_class), **test}


# --- what belongs to a source ---------------------------------------------------------------------


@pytest.mark.parametrize("end", ["", ".zip"])
@pytest.mark.parametrize("around", ["", "data_submission/", "a/b/c/"])
def test_a_source_is_a_folder_of_folders_of_classes(tmp_path, end, around):
    files = members(around + "{}/{}.npz", "ab")
    other = {".DS_Store": b"", "__MACOSX/a/._0.npz": b"", "README": b"", "LICENSE.md": b""}
    other |= {f"{around}a/notes.txt": b"", "about.md": b"", f"{around}.git/x.npz": b""}
    read = read_source(put(tmp_path / f"s{end}", {**files, **other}), jobs=1)
    assert read.ids == ("a/0", "a/1", "a/2", "b/0", "b/1", "b/2")
    assert read.sensor.classes == ("a", "b")
    assert read.labels.tolist() == [0, 0, 0, 1, 1, 1]
    assert not read.is_split


def test_the_published_archive(tmp_path):
    table = encode_lookup_table(recordings([]).taxels)
    put(tmp_path / "st.zip", {**good_members(2), "data_submission/LUT.mat": table})
    read = read_source(tmp_path / "st.zip", jobs=2)
    assert read.sensor == Sensor()
    assert read.ids[:3] == ("0/000", "0/001", "1/000")
    assert (len(read), read.source.name) == (20, "st.zip")
    some = {name: c for name, c in good_members().items() if "/3/" in name or "/7/" in name}
    part = read_source(put(tmp_path / "part.zip", some), jobs=1)
    assert (part.sensor, part.labels.tolist()) == (Sensor(), [3, 7])


@pytest.mark.parametrize(
    ("name", "fact"),
    [
        ("labels.json", "is not a recording"),
        ("a/labels.json", "is not a recording"),
        ("loose.npz", "not in a folder of a class"),
        ("a/b/deep.npz", "in a folder inside"),
        ("a/x.csv", r"\.npz and \.csv"),
        ("empty/.keep", "a class without a recording"),
    ],
)
def test_anything_else_is_named(tmp_path, name, fact):
    for end in ("", ".zip"):
        path = put(tmp_path / f"s{end}", {**members(), name: strip()})
        line = error(path)
        assert name.removesuffix("/.keep") in line
        with pytest.raises(UserError, match=fact):
            read_source(path, jobs=1)
        if "and" not in fact:
            read = read_source(path, jobs=1, skip_bad=True)
            assert (len(read), len(read.source.left_out)) == (6, 1)


def test_recordings_that_are_not_in_folders(tmp_path):
    """A folder of one class, of which the user gives the inside."""
    path = put(tmp_path / "s", {f"{i}.npz": strip(i) for i in range(3)})
    assert "give the folder above" in error(path)


@pytest.mark.parametrize("content", [b"", b"PK", b"no zip"])
def test_no_source(tmp_path, content):
    (tmp_path / "s.zip").write_bytes(content)
    assert "not a zip archive" in error(tmp_path / "s.zip")
    assert "no such file" in error(tmp_path / "nothing.zip")
    assert "holds no recordings" in error(put(tmp_path / "t.zip", {"a/b.json": b""}))
    assert "tonic" in error(put(tmp_path / "old.zip", {"a/b.aedat": b""}))


def test_damaged_members_are_refused_by_name(tmp_path):
    put(tmp_path / "s.zip", {**members(), "a/bad.npz": b"no recording", "b/none.npz": b""})
    with pytest.raises(UserError) as caught:
        read_source(tmp_path / "s.zip", jobs=1)
    assert [line.split(": ")[1][:14] for line in caught.value.lines] == [
        "2 of 8 files r", "1 of 8 files r", "1 of 8 files r"
    ]  # fmt: skip
    encrypt(put(tmp_path / "e.zip", members()), "a/1.npz")
    assert "a/1.npz cannot be read" in error(tmp_path / "e.zip")
    put(tmp_path / "d.zip", {**members(), "../x.npz": strip()})
    file = zipfile.ZipFile(tmp_path / "d.zip", "a")
    with file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr("a/1.npz", strip())
    read = read_source(tmp_path / "d.zip", jobs=1, skip_bad=True)
    assert (len(read), len(read.source.left_out)) == (6, 2)


def test_a_source_with_too_many_events_or_files(tmp_path, monkeypatch):
    path = put(tmp_path / "s.zip", members())
    monkeypatch.setattr(reading, "MAX_SOURCE_EVENTS", 30)
    assert "more than 30 events" in error(path)
    monkeypatch.setattr(listing, "MAX_FILES", 5)
    assert "6 recordings, more than 5" in error(path)


def test_the_same_for_any_number_of_processes(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "FILES_PER_JOB", 2)
    put(tmp_path / "s.zip", members())
    assert_same(*(read_source(tmp_path / "s.zip", jobs=jobs) for jobs in (1, 2)))


# --- published splits -----------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("train", "test"), ("Training", "TESTING")])
@pytest.mark.parametrize("around", ["", "data/"])
def test_a_published_split_is_found(tmp_path, names, around):
    to = dict(zip(("train", "test"), names, strict=True))
    files = {
        f"{around}{to[name.split('/')[0]]}/{name.split('/', 1)[1]}": content
        for name, content in published().items()
    }
    read = read_source(put(tmp_path / "s.zip", {**files, "README.md": b""}), jobs=1)
    assert read.parts == ("train",) * 6 + ("test",) * 2
    assert read.ids == (
        *(f"train/{c}/{i}" for c in "ab" for i in range(3)),
        "test/a/t0",
        "test/b/t0",
    )
    assert read.sensor.classes == ("a", "b")


def test_classes_that_are_called_train_and_test(tmp_path):
    read = read_source(put(tmp_path / "s.zip", members(classes=("train", "test"))), jobs=1)
    assert not read.is_split
    assert read.sensor.classes == ("test", "train")
    only = read_source(put(tmp_path / "t.zip", members("train/{}/{}.npz")), jobs=1)
    assert (only.is_split, only.ids[0]) == (False, "a/0")


@pytest.mark.parametrize(
    ("more", "fact"),
    [
        ({"val/a/0.npz": strip()}, "'val' next to train and test"),
        ({"other/a/0.npz": strip()}, "other/a/0.npz is neither in train nor in test"),
        ({"test/x.npz": strip()}, "test/x.npz is not in a folder of a class"),
    ],
)
def test_a_published_split_with_something_else(tmp_path, more, fact):
    assert fact in error(put(tmp_path / "s.zip", {**published(), **more}))


@pytest.mark.parametrize(
    ("how", "fact"),
    [
        ({"taxels": 30}, "sensors: train has 1 x 7 taxels, test has 1 x 30 taxels"),
        ({"t": 1000 * np.arange(7)}, "units of time"),
    ],
)
def test_parts_that_do_not_fit_each_other(tmp_path, how, fact):
    line = error(put(tmp_path / "s.zip", published(**how)))
    assert fact in line


@pytest.mark.parametrize(("name", "n", "parts", "size"), [
    ("ev-objects.zip", 36, (576, 144), (1, 39)), ("nuskin-letters.zip", 27, (1079, 269), (1, 80)),
])  # fmt: skip
def test_real_touch(name, n, parts, size):
    if not (SHARED / name).exists():
        pytest.skip(f"needs {name}, real recordings that are not part of the project")
    read = read_source(SHARED / name)
    assert (len(read.sensor.classes), read.source.time_unit) == (n, "us")
    assert tuple(read.parts.count(part) for part in ("train", "test")) == parts
    assert (read.sensor.rows, read.sensor.columns) == size


# --- positions of taxels --------------------------------------------------------------------------

POSITIONS = b"taxel,x,y\n" + b"".join(b"%d,%d,%f\n" % (i, i % 3, -i / 3) for i in range(7))


def test_positions_of_taxels_in_one_row(tmp_path):
    files = {**members(), "taxels.csv": POSITIONS}
    read = read_source(put(tmp_path / "s.zip", files), jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (1, 7)
    np.testing.assert_allclose(read.taxels.positions[4], [1, -4 / 3], atol=1e-6)
    cached = [load_recordings(str(tmp_path / "s.zip"), jobs=1) for _ in range(2)]
    assert_same(*cached)
    assert_same(cached[1], read)
    inside = {f"data/{name}": content for name, content in files.items()}
    assert read_source(put(tmp_path / "in.zip", inside), jobs=1).taxels.positions is not None
    assert recordings([]).taxels.positions is None


@pytest.mark.parametrize(
    ("table", "fact"),
    [
        (POSITIONS.replace(b"3,0,-1.000000\n", b""), "taxel 3 is missing"),
        (POSITIONS + b"3,9,9\n", "has taxel 3 twice"),
        (POSITIONS + b"7,9,9\n", "taxel 7 is"),
        (POSITIONS + b"-1,9,9\n", "taxel -1 is"),
        (POSITIONS.replace(b"taxel", b"t"), "columns taxel, x and y"),
        (POSITIONS.replace(b"1,1,", b"1,one,"), "columns taxel, x and y"),
        (POSITIONS.replace(b"1,1,", b"1,nan,"), "not finite"),
        (b"\xff", "columns taxel, x and y"),
        (b"", "no taxels"),
    ],
)
def test_bad_positions(tmp_path, table, fact):
    line = error(put(tmp_path / "s.zip", {**members(), "taxels.csv": table}))
    assert fact in line
    assert "taxels.csv" in line


def test_a_look_up_table_beside_numbered_taxels(tmp_path):
    """LUT.mat gives the places of taxels that files of events number by x, in one row."""
    table = encode_lookup_table(TaxelMap(np.arange(7) // 4, 2 * (np.arange(7) % 4)))
    path = put(tmp_path / "s.zip", {**members(), "LUT.mat": table})
    read = read_source(path, jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (2, 7)
    taxel = read[0].taxel
    assert read.taxels.row[taxel].tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert read.taxels.column[taxel].tolist() == [0, 2, 4, 6, 0, 2, 4]
    more = put(tmp_path / "m.zip", {**members(), "a/x.npz": strip(5, 8), "LUT.mat": table})
    assert "a/x.npz has taxel 7, LUT.mat" in error(more)
    square = npz(x=[0, 1], y=[0, 1], t=[0, 0.5], p=[1, 0])
    rows = {f"{name}/{i}.npz": square for name in "ab" for i in range(2)}
    assert "2 rows: remove LUT.mat" in error(put(tmp_path / "r.zip", {**rows, "LUT.mat": table}))


# --- writing --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("encoding", "name"), [("utf-8", "círcle"), ("cp437", "ä")])
def test_names_of_a_zip_without_the_mark_of_utf8(tmp_path, encoding, name):
    """As Info-ZIP's ``zip`` writes them on Linux, and old programs in code page 437."""
    path, stand_in = tmp_path / "own.zip", "_" * len(name.encode(encoding))
    archive(path, members(classes=(stand_in, "b")))
    content = path.read_bytes().replace(f"{stand_in}/".encode(), f"{name}/".encode(encoding))
    path.write_bytes(content)
    assert sorted(read_source(path, jobs=1).sensor.classes) == sorted(("b", name))


def test_recordings_come_back_from_a_zip(tmp_path):
    made = recordings([(0, 5, 1, 4), (160, 17, -1, 2)], [(0, 99, 1, 1)])
    write_mat_zip(tmp_path / "out.zip", made)
    read = read_source(tmp_path / "out.zip", jobs=1)
    assert_same(read, made, source=False)
    assert read.source.simulated
    first = hash_file(tmp_path / "out.zip")
    write_mat_zip(tmp_path / "out.zip", made)
    assert hash_file(tmp_path / "out.zip") == first
    parts = recordings([(0, 5, 1, 4)], [(0, 9, 1, 1)], parts=("train", "test"))
    write_mat_zip(tmp_path / "p.zip", source_with_ids(parts))
    assert read_source(tmp_path / "p.zip", jobs=1).parts == ("train", "test")


def source_with_ids(made):
    object.__setattr__(made, "ids", tuple(f"{part}/0/{i}" for i, part in enumerate(made.parts)))
    return made


# --- identity and cache ---------------------------------------------------------------------------


def test_the_content_is_that_of_the_files_that_are_read(tmp_path):
    one, other = (put(tmp_path / name, members()) for name in ("one", "other"))
    first = listing.hash_content(list_source(one))
    assert listing.hash_content(list_source(other)) == first
    put(other, {"README.md": b"new"})
    assert listing.hash_content(list_source(other)) == first
    put(other, {"a/9.npz": strip(9)})
    assert listing.hash_content(list_source(other)) != first


def test_recordings_are_read_once(tmp_path, monkeypatch):
    path = put(tmp_path / "s", members())
    first = load_recordings(str(path), jobs=1)
    with monkeypatch.context() as patch:
        patch.setattr(cached_recordings, "read_source", None)
        assert_same(load_recordings(str(path), jobs=1), first)
    put(path, {"a/1.npz": strip(30)})
    os.utime(path / "a" / "1.npz", (1, 1))
    assert load_recordings(str(path), jobs=1).source.sha256 != first.source.sha256


def test_a_spike_train_of_a_hundred_taxels_is_read_from_a_folder(tmp_path):
    put(tmp_path / "s", {"3/a.mat": mat5(spiketrain=spiketrain())})
    assert load_recordings(str(tmp_path / "s"), jobs=1).ids == ("3/a",)


def test_folders_on_another_disk(tmp_path):
    """Links to folders are followed, and a link in a circle ends."""
    for name in "ab":
        folder = tmp_path / "disk" / name
        folder.mkdir(parents=True)
        for i in range(3):
            (folder / f"{i}.npz").write_bytes(strip(i))
    own = tmp_path / "own"
    own.mkdir()
    for name in "ab":
        (own / name).symlink_to(tmp_path / "disk" / name)
    assert [entry.member for entry in list_source(own).entries] == [
        f"{name}/{i}.npz" for name in "ab" for i in range(3)
    ]
    (own / "c").symlink_to(own / "a")  # the same recordings in two classes
    (own / "taxels.csv").write_text("taxel,x,y")
    (tmp_path / "disk" / "a" / "again").symlink_to(own)
    assert len(list_source(own).entries) == 9


def test_a_single_recording_is_a_source_of_its_own_name(tmp_path):
    path = put(tmp_path / "some", members()) / "a" / "0.npz"
    options = ReadingOptions(labelled=False)
    assert read_source(path, jobs=1, reading=options).source.name == "0.npz"
    assert read_source(path.parent, jobs=1, reading=options).source.name == "a"
