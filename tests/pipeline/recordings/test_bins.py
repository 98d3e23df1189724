"""Published arrays (taxels, channels, bins): ``.npy`` files with the class in folder or name."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats.bins import make_binned_recording
from pipeline.recordings.interpretation.options import ReadingOptions
from pipeline.sources import load_recordings
from tests.pipeline.recordings.sources import error, put

# Real recordings, which are not part of the project.
SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"


def npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def counts(seed=0, shape=(39, 2, 25), dtype=float):
    return (np.random.default_rng(seed).random(shape) < 0.05).astype(dtype)


def published(shape=(39, 2, 25), around="", classes="012", **more):
    """A source as published: train and test, the class in each file's name."""
    files = {
        f"{around}{subset}/sample_{i}_label_{label}.npy": npy(counts(hash(f"{label}{i}") % 99 + n))
        for n, subset in enumerate(("train", "test"))
        for i, label in enumerate(2 * classes)
    }
    if shape != (39, 2, 25):
        files = {name: npy(counts(i, shape)) for i, name in enumerate(files)}
    return {**files, **{f"{around}{name}": content for name, content in more.items()}}


@pytest.mark.parametrize("dtype", [float, np.float32, np.uint8, np.int64, bool, ">f8"])
def test_each_count_is_an_event(dtype):
    array = counts(dtype=dtype)
    read = make_binned_recording(array)
    taxel, channel, index = np.nonzero(array)
    found = sorted(zip(read.x, read.polarity, read.time, strict=True))
    expected = sorted(zip(taxel, np.where(channel == 0, 1, -1), index, strict=True))
    assert found == expected
    assert (np.diff(read.time) >= 0).all()


def test_the_events_of_a_bin_are_spread_over_it():
    array = np.zeros((3, 1, 4), int)
    array[1, 0, 2], array[2, 0, 0] = 4, 1
    read = make_binned_recording(array)
    assert read.time.tolist() == [0, 2, 2.25, 2.5, 2.75]
    assert read.x.tolist() == [2, 1, 1, 1, 1]


@pytest.mark.parametrize("end", ["", ".zip"])
@pytest.mark.parametrize("around", ["", "Ev-Objects/"])
def test_a_published_split_with_the_classes_in_the_names(tmp_path, end, around):
    more = {"../__MACOSX/._x_label_1.npy": b""} if end and around else {}
    path = put(tmp_path / f"s{end}", published(around=around, **more))
    if more:
        with zipfile.ZipFile(path, "a") as file:
            file.writestr("__MACOSX/Ev-Objects/train/._sample_0_label_0.npy", b"x")
        path = put(tmp_path / f"s{end}", published(around=around))
    read = read_source(path, jobs=1)
    assert (read.parts.count("train"), read.parts.count("test")) == (6, 6)
    assert read.sensor.classes == ("0", "1", "2")
    assert (read.sensor.rows, read.sensor.columns, read.sensor.polarities) == (1, 39, 2)
    assert read.sensor.duration_s == 0.5
    assert read.ids[0] == "train/0/sample_0"
    assert (read.source.bin_ms, read.source.rise, read.source.time_unit) == (20, 0, "")
    assert "20 ms" in read.source.remarks[0]
    assert "channel 0" in read.source.remarks[0]


def test_a_hundred_taxels_are_the_grid_of_st_mnist(tmp_path):
    """Column k // 10 and row k % 10; channel 1 is the rise of pressure."""
    array = np.zeros((100, 2, 10))
    array[37, 1, 3], array[37, 0, 5] = 1, 1
    members = {f"{name}/{i}.npy": npy(np.roll(array, i, 2)) for name in "38" for i in range(2)}
    path = put(tmp_path / "s.zip", members)
    read = read_source(path, jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (10, 10)
    taxel = read[0].taxel
    assert (read.taxels.row[taxel].tolist(), read.taxels.column[taxel].tolist()) == (
        [7] * 2,
        [3] * 2,
    )
    assert read[0].polarity.tolist() == [1, -1]
    assert read[0].time_ns.tolist() == [60_000_000, 100_000_000]
    assert "order" in read.source.remarks[0]
    other = read_source(path, jobs=1, reading=ReadingOptions(bin_ms=5, rise=0))
    assert other[0].polarity.tolist() == [-1, 1]
    assert other[0].time_ns.tolist() == [15_000_000, 25_000_000]
    assert not read.is_split


def test_a_strip_unless_rows_or_positions_say_otherwise(tmp_path):
    path = put(tmp_path / "s.zip", published((36, 2, 20)))
    read = read_source(path, jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (1, 36)
    read = read_source(path, jobs=1, reading=ReadingOptions(rows=4))
    assert (read.sensor.rows, read.sensor.columns) == (4, 9)
    table = b"taxel,x,y\n" + b"".join(b"%d,%d,0\n" % (i, i) for i in range(100))
    grid = put(tmp_path / "g.zip", {**published((100, 2, 20)), "taxels.csv": table})
    read = read_source(grid, jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (1, 100)
    assert read.taxels.positions[7].tolist() == [7, 0]


def test_one_channel_has_rises_only(tmp_path):
    path = put(tmp_path / "s", published((20, 1, 30)))
    read = load_recordings(str(path), jobs=1)
    assert read.sensor.polarities == 1
    assert (read.events.polarity == 1).all()
    assert "data.rise=0" in error(path, reading=ReadingOptions(rise=1))
    again = load_recordings(str(path), jobs=1)
    assert (again.source, again.sensor) == (read.source, read.sensor)


@pytest.mark.parametrize(
    ("name", "array", "fact"),
    [
        ("train/bad_label_1.npy", counts() / 2, "0.5, not counts of events"),
        ("train/bad_label_1.npy", -counts(), "-1, not counts of events"),
        ("train/bad_label_1.npy", np.full((39, 2, 25), np.nan), "NaN or infinite"),
        ("train/bad_label_1.npy", counts()[:, None], "4 dimensions (39 x 1 x 2 x 25)"),
        ("train/bad_label_1.npy", counts(shape=(39, 3, 25)), "3 channels, not 1 or 2"),
        ("train/bad_label_1.npy", np.zeros((39, 2, 25)), "empty: no events"),
        ("train/bad_label_1.npy", counts(shape=(40, 2, 25)), "has 40 taxels, not 39 as most"),
        ("train/bad_label_1.npy", counts(shape=(39, 2, 26)), "2 channels and 26 bins, most"),
        ("train/bad_label_1.npy", counts(shape=(39, 1, 25)), "1 channels and 25 bins, most"),
        (
            "train/bad_label_1.npy",
            np.array([[0.0, 0, 0, 1], [1, 0, 90, 0]]),
            "a list of events, unlike",
        ),
        ("train/bad_label_x.npy", counts(), "the label 'x' in its name, which is no class"),
        ("train/bad_label_.npy", counts(), "the label '' in its name, which is no class"),
        ("train/bad.npy", counts(), "not in a folder of a class"),
        ("train/2/bad_label_1.npy", counts(), "folder of class '2', and has the label '1'"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, name, array, fact):
    path = put(tmp_path / "s", published(**{name: npy(array)}))
    line = error(path)
    assert name in line
    assert fact in line
    assert len(read_source(path, jobs=1, skip_bad=True)) == 12


def test_a_repository_with_several_data_sets(tmp_path):
    repository = tmp_path / "DeepTactile"
    for name in ("ST-MNIST-SPLIT", "Ev-Objects"):
        put(repository / name, published())
    (repository / "main.py").write_text("")
    line = error(repository)
    assert "Ev-Objects, ST-MNIST-SPLIT" in line
    assert str(repository / "Ev-Objects") in line
    for name in ("ST-MNIST-SPLIT", "Ev-Objects"):
        assert read_source(repository / name, jobs=1).is_split
    zips = tmp_path / "TactileSGNet"
    zips.mkdir()
    put(zips / "Ev-Objects.zip", published(around="Ev-Objects/"))
    assert str(zips / "Ev-Objects.zip") in error(zips)


def test_bins_that_would_last_too_long(tmp_path):
    path = put(tmp_path / "s", published())
    assert "data.bin" in error(path, reading=ReadingOptions(bin_ms=5000))


@pytest.mark.parametrize(
    ("name", "shape", "rise"),
    [("stmnist-train.zip", (100, 2, 100), 1), ("ev-objects.zip", (39, 2, 250), 0)],
)
def test_real_arrays_give_the_same_events(tmp_path, name, shape, rise):
    """Some recordings that were converted from the published arrays are turned back into them."""
    if not (SHARED / name).exists():
        pytest.skip(f"needs {name}, real recordings that are not part of the project")
    members, originals = {}, {}
    with zipfile.ZipFile(SHARED / name) as file:
        for member in sorted(n for n in file.namelist() if n.endswith(".npz"))[::60]:
            originals[member] = file.read(member)
            with np.load(io.BytesIO(originals[member])) as arrays:
                x, y, t, p = (arrays[key].astype(int) for key in "xytp")
            array = np.zeros(shape)
            array[
                10 * x + y if shape[0] == 100 else x, np.where(p, rise, 1 - rise), t // 20_000
            ] = 1
            members[member.replace(".npz", ".npy")] = npy(array)
    read = read_source(put(tmp_path / "s.zip", members), jobs=1)
    expected = read_source(put(tmp_path / "originals.zip", originals), jobs=1)
    assert read.ids == expected.ids
    assert read.hashes == expected.hashes
    assert read.sensor.duration_s == expected.sensor.duration_s
