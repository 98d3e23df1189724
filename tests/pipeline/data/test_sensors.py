"""Recordings of other sensors: any classes, any number of taxels, .mat or .npz."""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deploy.errors import UserError
from pipeline.data.archive import export_zip, read_source
from pipeline.data.dataset import Dataset, require_recordings_fit
from pipeline.data.eventfile import read_events
from pipeline.data.events import Sensor, TaxelMap
from pipeline.data.images import aggregate
from pipeline.data.library import load_recordings, recordings_of
from pipeline.data.matfile import BadRecording, lookup_table_bytes, read_lookup_table
from pipeline.data.sensors import Reading, class_order
from pipeline.data.timeunits import to_ns
from pipeline.settings import Settings
from tests.command import call, missing
from tests.pipeline.handmade import archive, assert_same, good_members, mat5, npz, spiketrain

NAMES = ("circle", "line 2", "line 10", "wave", "zig-zag")


def gesture(rng, rows=16, columns=12, n=30) -> bytes:
    return npz(
        x=rng.integers(0, columns, n),
        y=rng.integers(0, rows, n),
        t=np.sort(rng.uniform(0.1, 1.34, n)),
        p=rng.choice([-1, 1], n),
    )


def gestures(per_class=4, names=NAMES, seed=0, **options):
    rng = np.random.default_rng(seed)
    return {f"{name}/{i}.npz": gesture(rng, **options) for name in names for i in range(per_class)}


def array_of(n_taxels, n=6):
    """A ``spiketrain`` of another array: taxels 0, 1, ..., an event each, 10 ms apart."""
    array = np.zeros((n_taxels + 1, n))
    array[np.arange(n) % n_taxels, np.arange(n)] = np.where(np.arange(n) % 2, -1, 1)
    array[-1] = 0.25 + 0.01 * np.arange(n)
    return array


def test_event_files_in_folders_of_any_names(tmp_path):
    archive(tmp_path / "g.zip", {"top/" + name: c for name, c in gestures().items()})
    read = read_source(tmp_path / "g.zip", jobs=1)
    assert read.sensor.classes == NAMES  # 2 before 10
    assert (read.sensor.rows, read.sensor.columns) == (16, 12)  # the largest coordinates are there
    assert read.sensor.polarities == 2
    assert read.sensor.duration_s == pytest.approx(1.4)
    np.testing.assert_array_equal(read.labels, np.repeat(np.arange(5), 4))
    assert read.ids[:2] == ("circle/0", "circle/1")
    assert len(read.taxels) == 16 * 12


def test_coordinates_come_out_where_they_went_in(tmp_path):
    content = npz(x=[1, 4, 1], y=[3, 0, 3], t=[0.5, 0.1, 0.2], p=[1, -1, 1])
    archive(tmp_path / "g.zip", {"a/0.npz": content, "b/0.npz": content})
    read = read_source(tmp_path / "g.zip", jobs=1)
    np.testing.assert_array_equal(read[0].time_ns, [100_000_000, 200_000_000, 500_000_000])
    np.testing.assert_array_equal(read[0].polarity, [-1, 1, 1])
    image = aggregate(read)[0]
    assert image.shape == (4, 5)
    expected = np.zeros((4, 5))
    expected[3, 1], expected[0, 4] = 2, 1
    np.testing.assert_array_equal(image, expected)


@settings(max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_an_event_file_is_read_as_it_was_written(rows, columns, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 50))
    x, y = rng.integers(0, columns, n), rng.integers(0, rows, n)
    t, p = rng.permutation(n) * 1e-6, rng.choice([-1, 1], n)
    read = read_events(npz(x=x.astype(np.uint8), y=y.astype(float), t=t, p=p.astype(np.int8)))
    order = np.argsort(t)
    np.testing.assert_array_equal(read.x, x[order])
    np.testing.assert_array_equal(read.y, y[order])
    np.testing.assert_array_equal(to_ns(read.time, "s"), np.arange(n) * 1000)
    np.testing.assert_array_equal(read.polarity, p[order])
    taxels = TaxelMap.grid(rows, columns)
    taxel = read.events(rows, read.time).taxel
    np.testing.assert_array_equal(taxels.column[taxel], x[order])
    np.testing.assert_array_equal(taxels.row[taxel], y[order])


GOOD = {"x": [0, 1], "y": [0, 2], "t": [0.1, 0.2], "p": [1, -1]}


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"x": [0, -1]}, "x has -1, .* 0 to 16383"),
        ({"y": [0.5, 1]}, "y has 0.5"),
        ({"y": [np.nan, 1]}, "y has nan"),
        ({"x": [0, 16384]}, "x has 16384, .* 0 to 16383"),
        ({"t": [0.1, np.nan]}, "NaN"),
        ({"t": [-0.1, 0.2]}, "negative"),
        ({"p": [1, 2]}, r"p has 2, .* 1 \(ON\) and -1 \(OFF\)"),
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
        read_events(npz(**{**GOOD, **change}))


def test_other_contents():
    with pytest.raises(BadRecording, match=r"'p'.* x, y, t and p"):
        read_events(npz(x=[1], y=[1], t=[1]))
    for content in (b"", b"no zip", npz(**GOOD)[:100]):
        with pytest.raises(BadRecording, match=r"\.npz"):
            read_events(content)


def test_an_event_file_that_says_it_is_larger_than_it_is():
    """The header of an array declares a terabyte, which nobody sets aside."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "<f8", "fortran_order": False, "shape": (10**11,)}
    )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name in "xytp":
            file.writestr(f"{name}.npy", buffer.getvalue())
    with pytest.raises(BadRecording, match="'x'"):
        read_events(out.getvalue())


def test_what_an_event_file_has_besides_its_events_is_not_unpacked():
    """Nor are arrays that have together more than any recording can have."""
    large = np.zeros(12_000_000)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **GOOD, image=large)
    tracemalloc.start()
    try:
        assert read_events(buffer.getvalue()).x.tolist() == [0, 1]
        buffer = io.BytesIO()
        np.savez_compressed(buffer, x=large, y=large, t=large, p=large)
        with pytest.raises(BadRecording, match="more than 5000000"):
            read_events(buffer.getvalue())
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


@settings(max_examples=200)
@given(st.data())
def test_damaged_event_files_are_refused_or_read(data):
    content = bytearray(npz(**GOOD))
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        read = read_events(bytes(content))
    except BadRecording:
        return
    assert len(read.x) == len(read.y) == len(read.time) == len(read.polarity) > 0


def test_the_published_layout_with_another_number_of_taxels(tmp_path):
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(36, 5 + i))
               for name in ("soft", "hard") for i in range(3)}  # fmt: skip
    archive(tmp_path / "s.zip", members)
    read = read_source(tmp_path / "s.zip", jobs=1)
    assert read.sensor == Sensor(6, 6, 2, pytest.approx(0.4), ("hard", "soft"))
    assert (read.taxels.row[7], read.taxels.column[7]) == (1, 1)
    given = read_source(tmp_path / "s.zip", jobs=1, reading=Reading(4, 9))
    assert (given.sensor.rows, given.sensor.columns) == (4, 9)
    assert (given.taxels.row[7], given.taxels.column[7]) == (3, 1)
    assert read_source(tmp_path / "s.zip", jobs=1, reading=Reading(columns=9)).sensor.rows == 4


@pytest.mark.parametrize("table", [None, TaxelMap.grid(4, 16)])
def test_an_export_of_another_number_of_taxels(tmp_path, table):
    """It has a look-up table if the source has one."""
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(64)) for name in "ab" for i in (0, 1)}
    if table is not None:
        members["LUT.mat"] = lookup_table_bytes(table)
    archive(tmp_path / "s.zip", members)
    assert export_zip(tmp_path / "out.zip", tmp_path / "s.zip") == 4
    read, again = (read_source(tmp_path / f"{name}.zip", jobs=1) for name in ("s", "out"))
    assert again.sensor == read.sensor
    assert_same(again, read, source=False)


def test_a_lookup_table_with_gaps(tmp_path):
    """Five taxels as the five of a die, on three by three places."""
    places = TaxelMap(np.array([0, 0, 1, 2, 2]), np.array([0, 2, 1, 0, 2]))
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(5)) for name in "ab" for i in (0, 1)}
    archive(tmp_path / "s.zip", {**members, "LUT.mat": lookup_table_bytes(places)})
    read = read_source(tmp_path / "s.zip", jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (3, 3)
    image = aggregate(read)[0]
    np.testing.assert_array_equal(image, [[2, 0, 1], [0, 1, 0], [1, 0, 1]])
    wider = read_source(tmp_path / "s.zip", jobs=1, reading=Reading(5, 5))
    assert aggregate(wider).shape == (4, 5, 5)
    with pytest.raises(UserError, match=r"LUT\.mat.* 2 rows .* 3\b"):
        read_source(tmp_path / "s.zip", jobs=1, reading=Reading(2))


def test_two_taxels_at_one_place():
    table = np.array([[1, 1], [1, 2], [1, 1]], float)
    with pytest.raises(BadRecording, match=r"X and Y .* 3 "):
        read_lookup_table(mat5(LUT=table))


def test_taxels_in_no_square_need_a_table_or_numbers(tmp_path):
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(39)) for name in "ab" for i in (0, 1)}
    archive(tmp_path / "s.zip", members)
    with pytest.raises(UserError, match=r" 39 .* 6 .* 6.*LUT\.mat.*skin\.rows"):
        read_source(tmp_path / "s.zip", jobs=1)


def test_another_number_of_taxels_than_the_others(tmp_path):
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(16)) for name in "ab" for i in range(3)}
    archive(tmp_path / "s.zip", {**members, "a/odd.mat": mat5(spiketrain=array_of(25))})
    with pytest.raises(UserError, match=r"1 of 7 .*a/odd\.mat .* 26 .* 17 "):
        read_source(tmp_path / "s.zip", jobs=1)
    read = read_source(tmp_path / "s.zip", jobs=1, skip_bad=True)
    assert (len(read), len(read.source.left_out)) == (6, 1)


def test_coordinates_outside_are_refused_by_name(tmp_path):
    archive(tmp_path / "g.zip", gestures())
    with pytest.raises(UserError, match=r"20 of 20 .* circle/0\.npz .* y = 1\d, .* 8 rows"):
        read_source(tmp_path / "g.zip", jobs=1, reading=Reading(8))


def test_only_on_events(tmp_path):
    content = npz(x=[0, 1], y=[0, 1], t=[0.1, 0.2], p=[1, 1])
    archive(tmp_path / "g.zip", {"a/0.npz": content, "b/0.npz": content})
    assert read_source(tmp_path / "g.zip", jobs=1).sensor.polarities == 1


def test_both_kinds_of_files(tmp_path):
    archive(tmp_path / "g.zip", {**gestures(), "wave/x.mat": mat5(spiketrain=spiketrain())})
    with pytest.raises(UserError, match=r"g\.zip: .*\.mat and \.npz"):
        read_source(tmp_path / "g.zip", jobs=1)


def test_an_empty_class(tmp_path):
    for name, content in gestures().items():
        (tmp_path / "g" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "g" / name).write_bytes(content)
    (tmp_path / "g" / "spiral").mkdir()
    (tmp_path / "g" / ".git").mkdir()
    with pytest.raises(UserError, match=r"1 of 21 .*spiral"):
        read_source(tmp_path / "g", jobs=1)
    with zipfile.ZipFile(tmp_path / "g.zip", "w") as file:
        for name, content in gestures().items():
            file.writestr(name, content)
        file.writestr("spiral/", b"")
    with pytest.raises(UserError, match=r"1 of 21 .*spiral"):
        read_source(tmp_path / "g.zip", jobs=1)
    assert read_source(tmp_path / "g", jobs=1, skip_bad=True).sensor.classes == NAMES


def test_files_beside_the_folders_of_classes(tmp_path):
    extra = gestures(names=("x",), per_class=1)["x/0.npz"]
    archive(tmp_path / "g.zip", {**gestures(), "loose.npz": extra})
    with pytest.raises(UserError, match=r"1 of 21 .*loose\.npz"):
        read_source(tmp_path / "g.zip", jobs=1)


def test_digits_with_a_hundred_taxels_are_st_mnists(tmp_path):
    """Whatever is missing of them: ten classes and two seconds, as ever."""
    some = {name: c for name, c in good_members(2).items() if "/3/" in name or "/7/" in name}
    archive(tmp_path / "st.zip", some)
    read = read_source(tmp_path / "st.zip", jobs=1)
    assert read.sensor == Sensor()
    assert read.labels.tolist() == [3, 3, 7, 7]


@example(["²", "2", "٣"])
@given(st.lists(st.text(max_size=8)))
def test_names_have_one_order(names):
    assert sorted(sorted(names, key=class_order, reverse=True), key=class_order) == sorted(
        names, key=class_order
    )
    assert sorted(["b10", "b9", "a", "10", "9"], key=class_order) == ["9", "10", "a", "b9", "b10"]


def test_the_cache_keeps_the_sensor(tmp_path):
    archive(tmp_path / "g.zip", gestures(seed=5))
    first = load_recordings(str(tmp_path / "g.zip"), jobs=1)
    again = load_recordings(str(tmp_path / "g.zip"), jobs=1)
    assert again.sensor == first.sensor
    assert_same(again, first)
    wider = load_recordings(str(tmp_path / "g.zip"), jobs=1, reading=Reading(20))
    assert wider.sensor.rows == 20


# --- data sets of networks ------------------------------------------------------------------------


def settings_for(path, architecture="16x12-4c3s2-5o", **more):
    values = {"data": {"source": str(path)}, "cnn": {"architecture": architecture}, **more}
    return Settings().with_values(values, "test")


def test_a_data_set_of_another_sensor(tmp_path):
    archive(tmp_path / "g.zip", gestures(per_class=10))
    dataset = Dataset.of(settings_for(tmp_path / "g.zip"))
    assert dataset.inputs.shape == (50, 16, 12, 1)
    assert len(dataset.split.test) == 10


def test_an_architecture_for_another_sensor(tmp_path):
    archive(tmp_path / "g.zip", gestures(per_class=10))
    settings = settings_for(tmp_path / "g.zip", "10x10-6c4-10o")
    with pytest.raises(UserError, match=r"'cnn\.architecture' .* 16x12-6c4-5o.* 10x10-6c4-10o"):
        require_recordings_fit(recordings_of(settings), settings)


def test_a_class_with_one_recording(tmp_path):
    members = gestures(per_class=10)
    lone = {name: c for name, c in members.items() if "wave" not in name or name == "wave/0.npz"}
    archive(tmp_path / "g.zip", lone)
    with pytest.raises(UserError, match=r"g\.zip: .*'wave'"):
        Dataset.of(settings_for(tmp_path / "g.zip"))


def test_one_class(tmp_path):
    archive(tmp_path / "g.zip", gestures(per_class=10, names=("wave",)))
    with pytest.raises(UserError, match=r"g\.zip: .*one class"):
        Dataset.of(settings_for(tmp_path / "g.zip"))


# --- the simulated skin ---------------------------------------------------------------------------


def test_a_simulated_skin_of_another_size():
    small, large = (
        load_recordings(samples_per_digit=2, jobs=1, reading=Reading(rows, columns))
        for rows, columns in ((10, 10), (16, 14))
    )
    assert (large.sensor.rows, large.sensor.columns) == (16, 14)
    assert len(large.taxels) == 16 * 14
    assert "16x14 taxels" in large.source.name
    assert large.source.sha256 != small.source.sha256
    assert large.events.taxel.max() < 16 * 14
    # A digit covers as much of the larger skin, in both directions.
    for skin, size in ((small, 10), (large, 14)):
        images = aggregate(skin) > 0
        high, wide = (np.ptp(np.nonzero(images.any(axis=(0, axis)))[0]) for axis in (2, 1))
        assert high >= 0.7 * size
        assert wide >= 0.6 * size


def test_simulated_recordings_of_another_size_travel(tmp_path):
    path = tmp_path / "skin.zip"
    assert call("data", "simulate", "--out", path, "--samples-per-digit", 2, "--rows", 12,
                "--columns", 15, "--jobs", 1) == 0  # fmt: skip
    read = read_source(path, jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (12, 15)
    assert read.source.simulated
    made = load_recordings(samples_per_digit=2, jobs=1, reading=Reading(12, 15))
    assert_same(read, made, source=False)


def test_import_says_what_it_found(tmp_path, capsys):
    archive(tmp_path / "g.zip", gestures())
    assert call("data", "import", tmp_path / "g.zip", "--jobs", 1) == 0
    said = capsys.readouterr().out
    facts = ("20 recordings", "16 rows x 12 columns", "5 classes", "1.1 to 1.2 s", " seconds")
    assert missing(said, "circle 4, line 2 4, line 10 4", *facts) == []
    assert call("data", "stats", "--data", tmp_path / "g.zip", "--json") == 0
    assert '"zig-zag"' in capsys.readouterr().out
    assert call("data", "stats", "--data", tmp_path / "g.zip", "--against-paper") == 2
    assert "--against-paper" in capsys.readouterr().err
    for what in ("recording", "events", "layout", "sheet"):
        out = tmp_path / f"{what}.png"
        assert call("data", "plot", what, "--data", tmp_path / "g.zip", "--out", out,
                    "--sample", "wave/0") == 0  # fmt: skip
        assert out.stat().st_size > 1000


def test_the_remedy_that_is_said_is_there(tmp_path, capsys):
    """``data`` has no settings: rows and columns are options of its verbs."""
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(39)) for name in "ab" for i in (0, 1)}
    archive(tmp_path / "s.zip", members)
    here = ("--data", tmp_path / "s.zip")
    verbs = [("import", tmp_path / "s.zip"), ("stats", *here)]
    verbs += [("plot", "layout", *here, "--out", tmp_path / "layout.png")]
    for verb in verbs:
        assert call("data", *verb) == 2
        assert missing(capsys.readouterr().err, "--rows", "--columns", "'stmnist data'") == []
        assert call("data", *verb, "--rows", 3, "--columns", 13) == 0
    assert call("data", "import", tmp_path / "s.zip", "--columns", 13) == 0
    assert missing(capsys.readouterr().out, "3 rows", "13 columns") == []


def test_inspect_an_event_file(tmp_path, capsys):
    path = tmp_path / "wave.npz"
    path.write_bytes(npz(**GOOD))
    assert call("data", "inspect", path) == 0
    facts = ("2 events", "1 ON", "1 OFF", "3 rows", "2 columns", "0.1000 s", "0.2000 s", " seconds")
    assert missing(capsys.readouterr().out, *facts) == []
