"""Columns without names: the order is recognised by the times, the same in all files."""

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats import read_file
from pipeline.recordings.formats.recording import BadRecording

X, Y, T, P = [7, 3, 9, 3], [0, 4, 2, 1], [10, 20, 35, 80], [1, 0, 0, 1]
BY_NAME = {"x": X, "y": Y, "t": T, "p": P}


def lines(order, separator=",", **changed):
    columns = [{**BY_NAME, **changed}[name] for name in order]
    return "\n".join(separator.join(map(str, row)) for row in zip(*columns, strict=True)).encode()


@pytest.mark.parametrize("order", ["xytp", "txyp", "xypt"])
@pytest.mark.parametrize(("separator", "suffix"), [(",", "csv"), (" ", "txt")])
def test_the_column_of_times_rises(order, separator, suffix):
    recording = read_file(lines(order, separator), f"a/1.{suffix}")
    assert recording.x.tolist() == X
    assert recording.y.tolist() == Y
    assert recording.time.tolist() == T
    assert recording.polarity.tolist() == [1, -1, -1, 1]


def test_an_array_of_rows(tmp_path):
    np.save(tmp_path / "rows.npy", np.stack([T, X, Y, P], axis=1))
    recording = read_file((tmp_path / "rows.npy").read_bytes(), "a/rows.npy")
    assert recording.time.tolist() == T


@pytest.mark.parametrize("order", ["ptxy", "tpxy"])
def test_another_order_is_refused(order):
    with pytest.raises(BadRecording, match=r"no names.*t,x,y,p"):
        read_file(lines(order), "a/1.csv")


def test_times_that_do_not_rise_are_refused():
    with pytest.raises(BadRecording, match="without names"):
        read_file(lines("xytp", t=[10, 80, 35, 20]), "a/1.csv")


def write_source(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(content)
    return folder


def test_a_recording_that_fits_several_orders_follows_the_others(tmp_path):
    """A touch that moves to the right has x in order, too."""
    swipe = lines("txyp", x=[0, 1, 2, 3], y=[5, 5, 6, 6])
    files = {f"{of_class}/{n}.csv": lines("txyp") for of_class in "ab" for n in (1, 2)}
    recordings = read_source(write_source(tmp_path, {**files, "a/0.csv": swipe}), jobs=1)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (7, 10)
    assert recordings.source.remarks == ("columns without names are read as t, x, y, p",)


@pytest.mark.parametrize("order", ["txyp", "xytp"])
def test_coordinates_that_rise_in_all_recordings_are_not_times(tmp_path, order):
    """A strip has y = 0 everywhere; times in milliseconds could be coordinates."""
    strip = lines(order, x=[2, 3, 3, 4], y=[0, 0, 0, 0])
    files = {f"{of_class}/{n}.csv": strip for of_class in "ab" for n in (1, 2)}
    recordings = read_source(write_source(tmp_path, files), jobs=1)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (1, 5)
    assert read_file(strip, "a/1.csv").time.tolist() == T


@pytest.mark.parametrize("order", ["txyp", "xypt"])
def test_a_strip_whose_columns_may_be_exchanged_is_refused(tmp_path, order):
    """Two columns of 0 and 1: one is x or y, and the other one the polarity."""
    strip = lines(order, x=[0, 1, 1, 0])
    files = {f"{of_class}/{n}.csv": strip for of_class in "ab" for n in (1, 2)}
    with pytest.raises(UserError, match=r"may be .* or .*; write the names"):
        read_source(write_source(tmp_path / "all", files), jobs=1)
    files["a/3.csv"] = lines(order)  # a touch beside the edge
    assert read_source(write_source(tmp_path / "one", files), jobs=1).sensor.columns == 10


def test_a_polarity_of_zero_beside_others_of_minus_one_is_refused(tmp_path):
    files = {
        f"{of_class}/{n}.csv": lines("xytp", p=[1, -1, -1, 1]) for of_class in "ab" for n in (1, 2)
    }
    files["a/3.csv"] = lines("xytp")  # 0 and 1
    assert len(read_source(write_source(tmp_path / "told", files), jobs=1)) == 5
    files["a/4.csv"] = lines("xytp", p=[0] * 4)
    with pytest.raises(UserError, match=r"a/4\.csv has the polarity 0"):
        read_source(write_source(tmp_path / "open", files), jobs=1)


def test_coordinates_that_may_count_from_one_are_said(tmp_path):
    one = lines("xytp", x=[8, 1, 10, 4], y=[1, 5, 3, 2])
    files = {f"{of_class}/{n}.csv": one for of_class in "ab" for n in (1, 2)}
    (remark,) = read_source(write_source(tmp_path / "one", files), jobs=1).source.remarks
    assert "from 1" in remark
    files["a/3.csv"] = lines("xytp")
    assert read_source(write_source(tmp_path / "zero", files), jobs=1).source.remarks == ()


def test_recordings_with_off_events_alone_are_said(tmp_path):
    """The polarity may be in another column, or the sensor tells none."""
    files = {f"{of_class}/{n}.csv": lines("xytp", p=[0] * 4) for of_class in "ab" for n in (1, 2)}
    (warning,) = read_source(write_source(tmp_path / "off", files), jobs=1).source.warnings
    assert "OFF" in warning
    files = {**files, "a/1.csv": lines("xytp")}
    assert read_source(write_source(tmp_path / "both", files), jobs=1).source.warnings == ()


def test_files_in_two_orders_are_refused(tmp_path):
    files = {"a/1.csv": lines("txyp"), "a/2.csv": lines("xytp"), "b/1.csv": lines("txyp")}
    with pytest.raises(UserError, match="not all in one order"):
        read_source(write_source(tmp_path, files), jobs=1)


def test_text_files_are_recordings_where_nothing_else_is(tmp_path):
    """A line for each event, t x y p, as in the event camera data sets of Zurich."""
    files = {f"{of_class}/{n}.txt": lines("txyp", " ") for of_class in "ab" for n in (1, 2)}
    folder = write_source(tmp_path / "text", {**files, "README.txt": b"about"})
    assert len(read_source(folder, jobs=1)) == 4
    files = {**files, "a/1.csv": lines("txyp"), "b/1.csv": lines("txyp")}
    assert len(read_source(write_source(tmp_path / "both", files), jobs=1)) == 2
