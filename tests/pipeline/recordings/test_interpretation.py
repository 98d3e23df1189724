"""The sensor of recordings: rows, columns, classes, and the unit of time."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from deploy.errors import UserError
from deploy.terminal import WARNING
from pipeline.recordings.files.messages import describe_reading
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.images import make_tactile_images
from pipeline.recordings.interpretation.options import ReadingOptions
from pipeline.recordings.interpretation.strays import find_strays
from pipeline.recordings.recordings import describe_recordings
from pipeline.recordings.sensor import Sensor, make_class_sort_key
from pipeline.settings import Image
from pipeline.sources import SimulatedSource, load_recordings
from tests.command import missing
from tests.own_sensor import CLASSES, COLUMNS, ROWS, gestures
from tests.pipeline.handmade import archive, mat5, npz


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


def refused(tmp_path, members, reading=None) -> list:
    """The lines of the error that reading an archive ends with."""
    archive(tmp_path / "own.zip", members)
    with pytest.raises(UserError) as caught:
        read_source(tmp_path / "own.zip", jobs=1, reading=reading or ReadingOptions())
    return list(getattr(caught.value, "lines", [str(caught.value)]))


def array_of(n_taxels, n=6):
    """A ``spiketrain`` of another array: taxels 0, 1, ..., an event each, 10 ms apart."""
    array = np.zeros((n_taxels + 1, n))
    array[np.arange(n) % n_taxels, np.arange(n)] = np.where(np.arange(n) % 2, -1, 1)
    array[-1] = 0.25 + 0.01 * np.arange(n)
    return array


@pytest.mark.parametrize(("scale", "kind", "unit"), [
    (1, None, "seconds"), (1e3, np.int64, "milliseconds"), (1e3, None, "milliseconds"),
    (1e6, np.int64, "microseconds"), (1e6, float, "microseconds"), (1e9, np.int64, "nanoseconds"),
])  # fmt: skip
def test_the_unit_of_time_is_recognised_and_said(tmp_path, scale, kind, unit):
    archive(tmp_path / "own.zip", own(scale=scale, kind=kind))
    read = read_source(tmp_path / "own.zip", jobs=1)
    expected = np.concatenate([t for (_, _, t, _), _ in gestures(4)])
    np.testing.assert_allclose(read.events.time_ns * 1e-9, expected, atol=6e-4)
    text = describe_recordings(read)
    facts = ("16 recordings", f"{ROWS} rows", f"{COLUMNS} columns", "4 classes", f" {unit}")
    assert missing(text, *facts) == []


def test_equal_durations_are_said_once(tmp_path):
    archive(tmp_path / "own.zip", own())
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert " 1 s," not in describe_recordings(read)
    time_ns = read.events.time_ns.copy()
    time_ns[read.offsets[1:] - 1] = time_ns[read.offsets[:-1]] + 10**9
    same = replace(read, events=replace(read.events, time_ns=time_ns))
    assert ", 1 s," in describe_recordings(same)


def test_the_unit_of_the_training_is_kept_where_it_fits(tmp_path):
    """Nothing can last ten minutes; how short a gesture may be, nobody knows."""
    for scale, unit in ((1e5, "us"), (1e3, "us"), (1e9, "ns")):
        archive(tmp_path / "own.zip", own(scale=scale))
        read = read_source(tmp_path / "own.zip", jobs=1, reading=ReadingOptions(usual_unit="us"))
        assert read.source.time_unit == unit


def test_the_unit_that_is_given_counts(tmp_path):
    archive(tmp_path / "own.zip", own(scale=1e6))
    read = read_source(tmp_path / "own.zip", jobs=1, reading=ReadingOptions(time_unit="ns"))
    assert read.events.time_ns.max() < 2_100_000
    with pytest.raises(UserError, match=r"16 of 16 .*milliseconds.*time"):
        read_source(tmp_path / "own.zip", jobs=1, reading=ReadingOptions(time_unit="ms"))


def test_a_clock_that_runs_since_1970(tmp_path):
    """A camera's clock: recordings begin with their first event."""
    archive(tmp_path / "own.zip", own(t=lambda t: t + 1_700_000_000_000_000))
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert (read.events.time_ns[read.offsets[:-1]] == 0).all()
    assert read.sensor.duration_s < 2


def test_mixed_units(tmp_path):
    members = own()
    name = min(members)
    x, y, t, p = gestures(1)[0][0]
    (line,) = refused(tmp_path, {**members, name: npz(x=x, y=y, t=t, p=p)})
    assert missing(line, "1 of 16 ", name, "time") == []


@pytest.fixture
def small_test_set(tmp_path):
    """Recordings whose test set has no events at the edge, and one polarity."""
    train = {f"train/{name}": content for name, content in own().items()}
    inner = own(p=np.ones_like, x=lambda x: np.minimum(x, 8), y=lambda y: np.minimum(y, 6))
    test = {f"test/{name}": content for name, content in inner.items()}
    archive(tmp_path / "own.zip", {**train, **test})
    return tmp_path / "own.zip"


def test_the_sensor_is_that_of_all_recordings_together(small_test_set):
    read = read_source(small_test_set, jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (ROWS, COLUMNS)
    assert read.sensor.polarities == 2
    assert missing(read.source.remarks[0], "test in 7 x 9", f"{ROWS} x {COLUMNS} taxels") == []


def test_the_sensor_is_the_one_that_the_user_states(small_test_set):
    stated = ReadingOptions(rows=16, columns=16)
    read = read_source(small_test_set, jobs=1, reading=stated)
    assert (read.sensor.rows, read.sensor.columns) == (16, 16)


def test_subsets_of_quite_different_extents_are_one_sensor_if_it_is_stated(tmp_path):
    train = {f"train/{name}": content for name, content in own().items()}
    wide = own(x=lambda x: 4 * x, y=lambda y: 4 * y)
    members = {**train, **{f"test/{name}": content for name, content in wide.items()}}
    (line,) = refused(tmp_path, members)
    assert missing(line, "different sensors", "9 x 12", "skin.rows") == []
    read = read_source(tmp_path / "own.zip", jobs=1, reading=ReadingOptions(48, 48))
    assert (read.sensor.rows, read.sensor.columns) == (48, 48)


def test_a_sensor_with_too_many_pixels_is_downsampled(tmp_path):
    members = own(x=lambda x: 100 * x, y=lambda y: 40 * y)
    (line,) = refused(tmp_path, members)
    assert "data.downsample=5" in line
    read = read_source(tmp_path / "own.zip", jobs=1, reading=ReadingOptions(downsample=40))
    assert (read.sensor.rows, read.sensor.columns) == (ROWS, 28)


@pytest.mark.parametrize(("axis", "place", "rows", "columns"), [
    ("x", 200, ROWS, 201), ("y", 60, 61, COLUMNS), ("x", COLUMNS + 1, ROWS, COLUMNS + 2),
])  # fmt: skip
def test_one_event_that_enlarges_the_sensor_is_said_with_its_file(
    tmp_path, axis, place, rows, columns
):
    members = own()
    name = min(members)
    arrays = dict(zip("xytp", gestures(1)[0][0], strict=True))
    arrays["t"] = np.rint(arrays["t"] * 1e6).astype(np.int64)
    arrays[axis] = np.append(arrays[axis][:-1], place)
    archive(tmp_path / "own.zip", {**members, name: npz(**arrays)})
    read = read_source(tmp_path / "own.zip", jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (rows, columns)
    (line,) = read.source.warnings
    setting = {"x": f"skin.columns={COLUMNS}", "y": f"skin.rows={ROWS}"}[axis]
    facts = (name, "1 event", f"{axis} = {place}", f"{rows} rows x {columns} columns", setting)
    assert missing(line, *facts) == []
    assert f"{WARNING}own.zip: {line}" in describe_reading("own.zip", read)
    stated = read_source(tmp_path / "own.zip", jobs=1, reading=ReadingOptions(rows, columns))
    assert stated.source.warnings == ()


def test_a_place_that_no_sensor_has_is_the_fault_of_its_file(tmp_path):
    members = own()
    name = min(members)
    content = npz(x=[1, 5000], y=[1, 1], t=[0, 400_000], p=[1, 0])
    (line,) = refused(tmp_path, {**members, name: content})
    assert missing(line, "1 of 16", name, "x = 5000") == []


@given(st.lists(st.integers(1, 9), min_size=3, max_size=30))
def test_recordings_that_reach_similarly_far_have_no_strays(reach):
    everywhere = np.repeat(np.arange(9), 5)
    assert find_strays([np.arange(n) for n in reach] + [everywhere] * 4) is None


def test_coordinates_come_out_where_they_went_in(tmp_path):
    content = npz(x=[1, 4, 1], y=[3, 0, 3], t=[0.5, 0.1, 0.2], p=[1, -1, 1])
    archive(tmp_path / "g.zip", {"a/0.npz": content, "b/0.npz": content})
    read = read_source(tmp_path / "g.zip", jobs=1)
    np.testing.assert_array_equal(read[0].time_ns, [100_000_000, 200_000_000, 500_000_000])
    np.testing.assert_array_equal(read[0].polarity, [-1, 1, 1])
    image = make_tactile_images(read, Image(normalisation="none"))[0, ..., 0]
    assert image.shape == (4, 5)
    expected = np.zeros((4, 5))
    expected[3, 1], expected[0, 4] = 2, 1
    np.testing.assert_array_equal(image, expected)


def test_the_published_layout_with_another_number_of_taxels(tmp_path):
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(36, 5 + i))
               for name in ("soft", "hard") for i in range(3)}  # fmt: skip
    archive(tmp_path / "s.zip", members)
    read = read_source(tmp_path / "s.zip", jobs=1)
    assert read.sensor == Sensor(6, 6, 2, pytest.approx(0.4), ("hard", "soft"))
    assert (read.taxels.row[7], read.taxels.column[7]) == (1, 1)
    given = read_source(tmp_path / "s.zip", jobs=1, reading=ReadingOptions(4, 9))
    assert (given.sensor.rows, given.sensor.columns) == (4, 9)
    assert (given.taxels.row[7], given.taxels.column[7]) == (3, 1)
    assert (
        read_source(tmp_path / "s.zip", jobs=1, reading=ReadingOptions(columns=9)).sensor.rows == 4
    )


def test_another_number_of_taxels_than_the_others(tmp_path):
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(16)) for name in "ab" for i in range(3)}
    archive(tmp_path / "s.zip", {**members, "a/odd.mat": mat5(spiketrain=array_of(25))})
    with pytest.raises(UserError, match=r"1 of 7 .*a/odd\.mat.* has 25 taxels, not 16 "):
        read_source(tmp_path / "s.zip", jobs=1)
    read = read_source(tmp_path / "s.zip", jobs=1, skip_bad=True)
    assert (len(read), len(read.source.left_out)) == (6, 1)


@example(["²", "2", "٣"])
@given(st.lists(st.text(max_size=8)))
def test_names_have_one_order(names):
    from_behind = sorted(names, key=make_class_sort_key, reverse=True)
    assert sorted(from_behind, key=make_class_sort_key) == sorted(names, key=make_class_sort_key)


def test_numbers_in_names_are_in_their_order():
    names = ["b10", "b9", "a", "10", "9"]
    assert sorted(names, key=make_class_sort_key) == ["9", "10", "a", "b9", "b10"]


def test_a_simulated_skin_of_another_size():
    small, large = (
        load_recordings(
            jobs=1,
            reading=ReadingOptions(rows, columns),
            simulated=SimulatedSource(samples_per_digit=2),
        )
        for rows, columns in ((10, 10), (16, 14))
    )
    assert (large.sensor.rows, large.sensor.columns) == (16, 14)
    assert len(large.taxels) == 16 * 14
    assert "16x14 taxels" in large.source.name
    assert large.source.sha256 != small.source.sha256
    assert large.events.taxel.max() < 16 * 14
    # A digit covers as much of the larger skin, in both directions.
    for skin, size in ((small, 10), (large, 14)):
        images = make_tactile_images(skin)[..., 0] > 0
        high, wide = (np.ptp(np.nonzero(images.any(axis=(0, axis)))[0]) for axis in (2, 1))
        assert high >= 0.7 * size
        assert wide >= 0.6 * size


def test_taxels_in_no_square_are_a_strip(tmp_path):
    members = {f"{name}/{i}.mat": mat5(spiketrain=array_of(39)) for name in "ab" for i in (0, 1)}
    archive(tmp_path / "s.zip", members)
    read = read_source(tmp_path / "s.zip", jobs=1)
    assert (read.sensor.rows, read.sensor.columns) == (1, 39)
    with pytest.raises(UserError, match=r"39 taxels, not 9 rows of 12.*LUT\.mat"):
        read_source(tmp_path / "s.zip", jobs=1, reading=ReadingOptions(9, 12))


def test_recordings_of_a_larger_sensor_are_one_line_about_the_sensor(tmp_path):
    (line,) = refused(tmp_path, own(), ReadingOptions(4, 5))
    assert "of 9 rows x 12 columns, larger than the required size" in line
    assert "skin.rows=4 and skin.columns=5" in line
    one = {f"{CLASSES[0]}/far.npz": npz(x=[30, 1], y=[1, 1], t=[0, 900_000], p=[0, 1])}
    (line,) = refused(tmp_path, {**own(), **one}, ReadingOptions(ROWS, COLUMNS))
    assert missing(line, "1 of 17 ", "far.npz", "x = 30") == []


def test_no_unit_fits(tmp_path):
    (line,) = refused(tmp_path, own(scale=1e12))
    assert "data.time_unit" in line
