"""Our reader of MATLAB 5 files against SciPy's, and what SciPy's does not survive."""

import io
import struct
import zlib

import numpy as np
import pytest
import scipy.io

from pipeline.data import mat5
from pipeline.data.matfile import BadRecording, read_lookup_table, read_recording
from tests.pipeline import handmade

HEADER = b"MATLAB 5.0 MAT-file, by hand".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)


def saved(compressed=False, **variables):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, do_compression=compressed)
    return buffer.getvalue()


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def variable(values=b"", rows=1, columns=1, kind=9, name=b"spiketrain", of_class=6):
    inner = element(6, struct.pack("<II", of_class, 0))
    inner += element(5, struct.pack("<ii", rows, columns)) + element(1, name)
    return element(14, inner + element(kind, values))


def packed(content, claim=None):
    data = zlib.compress(content)
    return struct.pack("<II", 15, len(data) if claim is None else claim) + data


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
@pytest.mark.parametrize("shape", [(3, 4), (1, 1), (0, 5), (2, 3, 2)])
def test_it_reads_what_scipy_reads(shape, dtype, compressed):
    array = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    content = saved(compressed, first=np.eye(3), spiketrain=array)
    expected = scipy.io.loadmat(io.BytesIO(content))["spiketrain"]
    found = mat5.read(content, ("spiketrain", "writer"))
    assert list(found) == ["spiketrain"]
    np.testing.assert_array_equal(found["spiketrain"], expected)
    assert found["spiketrain"].dtype == expected.dtype


def test_the_other_order_of_bytes():
    """A big-endian file: the words of a tag are turned, and so are size and type of a small one."""
    inner = struct.pack(">IIII", 6, 8, 6, 0) + struct.pack(">IIii", 5, 8, 1, 2)
    inner += struct.pack(">HH4s", 1, 1, b"x") + struct.pack(">IIdd", 9, 16, 1, 2)
    header = b"MATLAB 5.0 MAT-file, by hand".ljust(124) + struct.pack(">HH", 0x0100, 0x4D49)
    content = header + struct.pack(">II", 14, len(inner)) + inner
    assert scipy.io.loadmat(io.BytesIO(content))["x"].tolist() == [[1.0, 2.0]]
    assert mat5.read(content)["x"].tolist() == [[1.0, 2.0]]


def test_other_kinds_of_variables_are_passed_over_or_none():
    content = saved(
        text="abc", long="x" * 201, lines=np.array(["ab", "cd"]), other="ü",
        cell=np.array([1, "x"], dtype=object), struct={"a": 1.0},
        sparse=scipy.sparse.eye(3).tocsc(), complex=np.array([1j]), number=5.0,
    )  # fmt: skip
    assert {name: array.tolist() for name, array in mat5.read(content).items()} == {
        "number": [[5.0]]
    }
    names = ("long", "lines", "other", "struct", "complex")
    assert mat5.read(content, (*names, "text")) == {**dict.fromkeys(names), "text": "abc"}


@pytest.mark.parametrize("kind", [*range(20), 100, 2**16, 2**31])
def test_any_type_of_the_values_is_read_or_refused(kind):
    """SciPy's reader ends the process on 0, 8, 10, 11, 14, 15 and 19."""
    content = HEADER + variable(struct.pack("<d", 1.0), kind=kind)
    if kind == 9:
        assert mat5.read(content)["spiketrain"].tolist() == [[1.0]]
    else:
        with pytest.raises(BadRecording):  # eight bytes are more than one of 1 to 13, or no event
            read_recording(content)


@pytest.mark.parametrize("place", range(128, 240, 4))
def test_any_word_may_be_wrong(place):
    good = saved(spiketrain=handmade.spiketrain(1))
    refused = 0
    for value in (0, 1, 8, 14, 15, 19, 2**16, 2**31 - 1, 2**32 - 1):
        content = bytearray(good)
        content[place : place + 4] = struct.pack("<I", value)
        try:
            read_recording(bytes(content))
        except BadRecording:
            refused += 1
    assert refused >= 5 or place in (148, 188, 192, 196)  # nzmax; padding of the name


@pytest.mark.parametrize("claim", [0, 1, 7, 2**32 - 1])
def test_a_compressed_variable_that_is_cut_short(claim):
    good = variable(struct.pack("<d", 1.0))
    assert mat5.read(HEADER + packed(good))["spiketrain"].tolist() == [[1.0]]
    with pytest.raises(BadRecording):
        read_recording(HEADER + packed(good, claim))


@pytest.mark.parametrize("inside", [b"", b"\0" * 7, b"\0" * 8, variable()[:-1], variable() + b"x"])
def test_a_compressed_variable_that_is_none(inside):
    with pytest.raises(BadRecording):
        read_recording(HEADER + packed(inside))


def test_a_checksum_that_is_wrong():
    content = bytearray(HEADER + packed(variable(struct.pack("<d", 1.0))))
    content[-1] ^= 1
    with pytest.raises(BadRecording):
        read_recording(bytes(content))


def test_a_bomb_is_not_unpacked(monkeypatch):
    """Its dimensions say how large it is; no more than the head is unpacked to see that."""
    columns = 10**6
    head = variable(b"", 101, columns)[8:-8] + struct.pack("<II", 9, 101 * columns * 8)
    whole = struct.pack("<II", 14, len(head) + 101 * columns * 8) + head
    packer = zlib.compressobj()
    data = packer.compress(whole)
    data += b"".join(packer.compress(bytes(1 << 20)) for _ in range(20)) + packer.flush()
    monkeypatch.setattr(mat5, "_unpacked", None)
    with pytest.raises(BadRecording, match=r"101 x 1000000 .*'spiketrain'"):
        read_recording(HEADER + struct.pack("<II", 15, len(data)) + data)


def test_a_bomb_that_nobody_asked_for_is_passed_over(monkeypatch):
    content = HEADER + packed(variable(bytes(8 * 10**6), 1, 10**6, name=b"other"))
    monkeypatch.setattr(mat5, "_unpacked", None)
    with pytest.raises(BadRecording, match="'spiketrain'"):
        read_recording(content)


def test_of_a_lookup_table_s_file_only_the_table_is_unpacked(monkeypatch):
    table = saved(unit="mm", LUT=np.stack(np.divmod(np.arange(9), 3), 1) + 1.0)[128:]
    content = HEADER + packed(variable(bytes(8 * 10**6), 10**3, 10**3, name=b"other")) + table
    monkeypatch.setattr(mat5, "_unpacked", None)
    assert read_lookup_table(content).column.tolist() == [0, 1, 2] * 3


def test_dimensions_whose_product_overflows():
    inner = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<4i", *[2**16] * 4))
    content = HEADER + element(14, inner + element(1, b"spiketrain") + element(9, b""))
    with pytest.raises(BadRecording):
        read_recording(content)


def test_more_variables_than_anyone_has():
    content = HEADER + variable(bytes(8), name=b"x") * 1001
    with pytest.raises(BadRecording):
        read_recording(content)
    assert mat5.LARGEST > 101 * 200_000 * 8
