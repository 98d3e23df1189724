import io

import numpy as np
import pytest
import scipy.io

from pipeline.recordings.events import Events, expand_bursts
from pipeline.recordings.formats.mat import (
    HEADER,
    MatRecording,
    encode_lookup_table,
    encode_recording,
    make_spiketrain,
    read_lookup_table,
    read_recording,
    read_spiketrain,
)
from pipeline.recordings.formats.recording import BadRecording
from pipeline.recordings.sensor import TaxelMap
from tests.pipeline.handmade import events, mat5, spiketrain


def changed(row, column, value):
    array = spiketrain()
    array[row, column] = value
    return array


def times(*values):
    array = spiketrain(len(values))
    array[100] = values
    return array


BAD = {
    "not 101 rows": (spiketrain()[:-1], "'spiketrain'.* 100 .* 101"),
    "transposed": (spiketrain().T, "'spiketrain'.* 6 .* 101"),
    "a vector in three dimensions": (np.zeros((101, 2, 2)), "'spiketrain'"),
    "text": (np.array(["a", "b"]), "'spiketrain'"),
    "complex": (spiketrain() + 0j, "'spiketrain'"),
    "empty": (np.zeros((101, 0)), "empty"),
    "value 2": (changed(0, 0, 2), "-1, 0 and 1"),
    "value one half": (changed(0, 0, 0.5), "-1, 0 and 1"),
    "value NaN": (changed(0, 0, np.nan), "-1, 0 and 1"),
    "two events": (changed(50, 2, 1), "column 3 has 2 "),
    "no event": (changed(3, 3, 0), "column 4 has 0 "),
    "time NaN": (changed(100, 1, np.nan), "NaN"),
    "time infinite": (changed(100, 5, np.inf), "infinite"),
    "time negative": (times(-0.1, 0.2), "negative"),
    "times equal": (times(0.1, 0.2, 0.2), "column 3"),
    "times fall": (times(0.1, 0.3, 0.2), "column 3"),
    "milliseconds": (times(196.6, 500.0, 895.7), "milliseconds"),
}


def test_a_good_file():
    recording = read_recording(mat5(spiketrain=spiketrain(4)))
    assert recording.events.taxel.tolist() == [0, 1, 2, 3]
    assert recording.events.polarity.tolist() == [1, -1, 1, -1]
    assert recording.events.time_ns.tolist() == [100_000_000 + i * 1_000_000 for i in range(4)]
    assert not recording.simulated
    assert recording.writer == -1


@pytest.mark.parametrize(("array", "fact"), BAD.values(), ids=BAD)
def test_a_bad_spiketrain_is_refused_with_its_reason(array, fact):
    with pytest.raises(BadRecording, match=fact):
        read_recording(mat5(spiketrain=array))


@pytest.mark.parametrize(
    ("content", "fact"),
    [
        (b"", "empty"),
        (b"hello", "MATLAB 4"),
        (b"\x89PNG" * 300, "MAT"),
        (mat5(other=spiketrain()), "'spiketrain'.* .npz with arrays x, y, t and p"),
        (mat5(spiketrain=spiketrain())[:300], "MAT"),
        (mat5(spiketrain=spiketrain())[:128], "'spiketrain'|MAT"),
        (mat5(spiketrain={"a": 1.0}), "'spiketrain'"),
    ],
)
def test_a_file_that_is_no_recording(content, fact):
    with pytest.raises(BadRecording, match=fact):
        read_recording(content)


def test_flipped_bytes_give_a_reason_or_a_recording():
    content = encode_recording(MatRecording(events(), True, 3))
    refused = 0
    for position in range(0, len(content), 3):
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        try:
            read_recording(bytes(damaged))
        except BadRecording:
            refused += 1
    assert refused > len(content) / 3 / 2  # most of the file is compressed and has a checksum


def test_a_matlab_73_file_is_refused_with_the_remedy():
    content = HEADER.ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(100)
    with pytest.raises(BadRecording, match="-v7"):
        read_recording(content)


def test_an_event_in_more_columns_than_are_counted():
    n = 65_536
    array = np.zeros((101, n), np.float32)
    array[3] = 1
    with pytest.raises(BadRecording, match="65,535 "):
        read_spiketrain(np.vstack([array[:-1], np.arange(n)[None] * 16e-9]))


def test_round_trip_of_a_recording():
    written = MatRecording(events(), simulated=True, writer=22)
    content = encode_recording(written)
    read = read_recording(content)
    for name in ("time_ns", "taxel", "polarity", "columns"):
        np.testing.assert_array_equal(getattr(read.events, name), getattr(written.events, name))
    assert (read.simulated, read.writer) == (True, 22)
    assert encode_recording(read) == content


def test_the_real_recording_comes_back_column_by_column(real_recording):
    recording = read_recording(real_recording.read_bytes())
    assert not recording.simulated
    read = recording.events
    assert (read.time_ns % 16 == 0).all()
    again = read_spiketrain(make_spiketrain(read))
    for found, expected in zip(expand_bursts(again), expand_bursts(read), strict=True):
        np.testing.assert_array_equal(found, expected)


ADDRESS = np.arange(1, 101.0)
X, Y = (ADDRESS - 1) // 10 + 1, (ADDRESS - 1) % 10 + 1


def test_lookup_tables():
    two = read_lookup_table(mat5(LUT=np.stack([X, Y], 1)))
    assert (two.row[17], two.column[17]) == (1, 7)
    shuffled = np.random.default_rng(0).permutation(100)
    three = read_lookup_table(mat5(any_name=np.stack([ADDRESS, X, Y], 1)[shuffled]))
    np.testing.assert_array_equal(three.row, two.row)
    np.testing.assert_array_equal(three.column, two.column)


def test_the_transposed_table_gives_the_transposed_positions():
    table = read_lookup_table(mat5(LUT=np.stack([Y, X], 1)))
    assert (table.row[17], table.column[17]) == (7, 1)


@pytest.mark.parametrize(
    ("table", "fact"),
    [
        (np.ones((100, 2)), "X and Y .* 100 "),
        (np.stack([X, Y], 1) - 1, "X and Y .* 1 to 256"),
        (np.stack([X + 0.5, Y], 1), "X and Y .* 100 "),
        (np.stack([ADDRESS - 1, X, Y], 1), "address.* 1 to 100"),
        (np.stack([np.ones(100), X, Y], 1), "address.* 1 to 100"),
        (np.ones((50, 4)), "X and Y"),
    ],
)
def test_a_bad_lookup_table(table, fact):
    with pytest.raises(BadRecording, match=fact):
        read_lookup_table(mat5(LUT=table))


def test_round_trip_of_a_lookup_table():
    table = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    read = read_lookup_table(encode_lookup_table(table))
    np.testing.assert_array_equal(read.row, table.row)
    np.testing.assert_array_equal(read.column, table.column)


def test_round_trip_of_what_a_hand_has_written():
    few = Events([160, 3200], [3, 4], [1, -1], [4, 2])
    content = encode_recording(MatRecording(few, True, 3, True))
    read = read_recording(content)
    assert encode_recording(read) == content
    assert (read.simulated, read.writer, read.written) == (True, 3, True)
    assert scipy.io.loadmat(io.BytesIO(content))["written"].item() == 1  # others read it too
