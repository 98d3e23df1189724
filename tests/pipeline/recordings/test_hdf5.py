"""HDF5 files with a table of events or a group of columns; STEMNIST's layout as described."""

import io

import h5py
import numpy as np
import pytest

from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats import read_file
from pipeline.recordings.formats.recording import BadRecording

TIMES, COLUMNS = np.array([0.1, 0.2, 0.4]), {"x": [3, 4, 5], "y": [1, 1, 2], "p": [1, -1, 1]}
SPIKES = np.dtype([("timestamp", "f8"), ("polarity", "i1"), ("taxel_id", "u2")])


def contents(fill) -> bytes:
    """An HDF5 file that a function fills."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        fill(file)
    return buffer.getvalue()


def spikes(taxels=(1, 17, 256)):
    return np.array(list(zip(TIMES, (1, -1, 1), taxels, strict=False)), SPIKES)


def fill_columns(file):
    for name, values in COLUMNS.items():
        file[f"events/{name}"] = np.array(values)
    file["events/t"] = TIMES
    file["events/t_offset"] = 5


def fill_records(file):
    dtype = [("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")]
    file["CD/events"] = np.array(list(zip(TIMES, *COLUMNS.values(), strict=True)), dtype)
    file["CD/indexes"] = np.arange(4)


def fill_columns_beside_rows(file):
    fill_columns(file)
    file["frames"] = np.zeros((7, 4))


def fill_rows(file):
    file["all"] = np.stack([TIMES, *COLUMNS.values()], axis=1)


@pytest.mark.parametrize("fill", [fill_columns, fill_records, fill_rows, fill_columns_beside_rows])
def test_one_table_or_group(fill):
    recording = read_file(contents(fill), "a/1.h5")
    assert recording.x.tolist() == COLUMNS["x"]
    assert recording.y.tolist() == COLUMNS["y"]
    assert recording.time.tolist() == TIMES.tolist()
    assert recording.polarity.tolist() == COLUMNS["p"]


def test_stemnist(tmp_path):
    """Taxel 17 is the first of the second row; the person in the name is the writer."""
    recording = read_file(
        contents(lambda file: file.create_dataset("spikes", data=spikes())),
        "ProcessedSpikes/A/P07_A_3_spikes.h5",
    )
    assert list(zip(recording.y, recording.x, strict=True)) == [(0, 0), (1, 0), (15, 15)]
    assert (recording.size, recording.writer) == ((16, 16), 7)
    for of_class in ("A", "B"):
        folder = tmp_path / "ProcessedSpikes" / of_class
        folder.mkdir(parents=True)
        for person in ("P01", "P02", "P11"):
            with h5py.File(folder / f"{person}_{of_class}_1_spikes.h5", "w") as file:
                file["spikes"] = spikes()
    recordings = read_source(tmp_path, jobs=1)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (16, 16)
    assert recordings.writers.tolist() == [1, 2, 11] * 2


def test_stemnist_as_a_group_of_columns():
    def fill(file):
        for name in SPIKES.names:
            file[f"spikes/{name}"] = spikes()[name]

    recording = read_file(contents(fill), "A/P07_A_3_spikes.h5")
    assert list(zip(recording.y, recording.x, strict=True)) == [(0, 0), (1, 0), (15, 15)]
    assert (recording.size, recording.writer) == ((16, 16), 7)


def link_outside(file):
    fill_columns(file)
    file["more"] = h5py.ExternalLink("/etc/passwd", "/")


def store_outside(file):
    for name, values in COLUMNS.items():
        file[f"events/{name}"] = np.array(values)
    file.create_dataset("events/t", (3,), "f8", external=[("/etc/passwd", 0, 24)])


def declare_much(file):
    for name in ("x", "y", "t", "p"):
        file.create_dataset(f"events/{name}", (1 << 40,), "u1", chunks=(1 << 10,))


def store_text(file):
    fill_columns(file)
    del file["events/p"]
    file["events/p"] = ["on", "off", "on"]


@pytest.mark.parametrize(
    ("fill", "fact"),
    [
        (link_outside, "link"),
        (store_outside, "another file"),
        (declare_much, "more than"),
        (store_text, "numbers"),
        (lambda file: file.create_dataset("spikes", data=spikes((0, 1, 2))), "taxel_id has 0"),
        (lambda file: file.create_dataset("image", data=np.zeros((3, 3))), "0 tables"),
        (lambda file: [fill_columns(file), fill_records(file)], "2 tables"),
    ],
)
def test_what_is_no_recording(fill, fact):
    with pytest.raises(BadRecording, match=fact):
        read_file(contents(fill), "a/1.h5")


def test_damaged_files():
    whole = contents(fill_columns)
    for content in (whole[: len(whole) // 2], b"\x89HDF\r\n\x1a\n", b"no HDF5"):
        with pytest.raises(BadRecording):
            read_file(content, "a/1.hdf5")
