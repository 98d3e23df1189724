import os
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from deploy import limits
from deploy.errors import UserError
from deploy.files import (
    lock_file,
    read_arrays,
    read_json,
    remove_leftovers,
    replacing,
    write_arrays,
    write_json,
)
from tests.command import environment


def test_round_trips(tmp_path):
    value = {"name": "é", "numbers": [1, 2.5, None], "nested": {"a": True}}
    write_json(tmp_path / "new" / "a.json", value)
    assert read_json(tmp_path / "new" / "a.json", "") == value
    arrays = {"x": np.arange(6.0).reshape(2, 3), "names": np.array(["a", "bc"]), "n": np.int64(3)}
    write_arrays(tmp_path / "a.npz", **arrays)
    read = read_arrays(tmp_path / "a.npz", "")
    assert sorted(read) == sorted(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def test_the_same_arrays_make_the_same_bytes(tmp_path):
    x, y = np.arange(5), np.ones(3)
    write_arrays(tmp_path / "a.npz", x=x, y=y)
    write_arrays(tmp_path / "b.npz", y=y, x=x)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        assert {member.date_time for member in file.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def write_half_and_raise(file, error):
    file.write("half of")
    raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interruption_leaves_what_was_there(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with pytest.raises(error), replacing(path, "w") as file:
        write_half_and_raise(file, error)
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/a\.json: "):
        write_json(tmp_path / "file" / "a.json", {})


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"a": 1', b"[1, 2]", b"3", b"\xff\xfe", b"[" * 100_000]
)
def test_a_broken_json_file_is_one_error_with_the_remedy(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(UserError, match=r"a\.json: .*; do this"):
        read_json(tmp_path / "a.json", "do this")
    with pytest.raises(UserError, match=r"b\.json: .*No such file.*; do this"):
        read_json(tmp_path / "b.json", "do this")


def test_every_flipped_byte_of_an_npz_is_one_error_or_harmless(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, x=np.arange(50.0))
    content = path.read_bytes()
    refused = 0
    for position in range(len(content)):
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read_arrays(path, "do this")
        except UserError as error:
            assert str(error).endswith("; do this")  # noqa: PT017
            refused += 1
    assert refused > len(content) / 2


def test_nothing_pickled_is_read(tmp_path):
    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "trapped"),))

    np.savez(tmp_path / "a.npz", x=np.array([Trap()], dtype=object))
    with pytest.raises(UserError, match=r"a\.npz"):
        read_arrays(tmp_path / "a.npz", "")
    assert not (tmp_path / "trapped").exists()


def test_leftovers_of_killed_processes_are_removed(tmp_path):
    """A process that is killed while it writes leaves its temporary file and folder."""
    (tmp_path / "cnn").mkdir()
    code = (
        "import os, signal, sys, tempfile\n"
        "from deploy.files import TEMPORARY, replacing\n"
        "tempfile.mkdtemp(TEMPORARY, '.bundle.', sys.argv[1])\n"
        "with replacing(sys.argv[1] + '/cnn/weights.npz') as file:\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=environment())
    assert killed.returncode == -9
    assert len(list(tmp_path.rglob(".*.tmp"))) == 2
    (tmp_path / ".lock").touch()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == [".lock", "cnn"]


def test_a_lock_has_one_owner(tmp_path):
    with lock_file(tmp_path / ".lock", "taken", "mend") as file:
        file.write(b"kept")
        with (
            pytest.raises(UserError, match="taken"),
            lock_file(tmp_path / ".lock", "taken", "mend"),
        ):
            pass
    with lock_file(tmp_path / ".lock", "taken", "mend"):
        assert (tmp_path / ".lock").read_bytes() == b"kept"


@pytest.mark.parametrize("size", [limits.ARRAY_BYTES + 1, 2**40])
def test_an_npz_that_declares_too_much_is_not_read(tmp_path, size):
    """The archive's directory declares the size; the few bytes of the array do not have it."""
    write_arrays(tmp_path / "a.npz", compress=False, x=np.arange(3))
    content = (tmp_path / "a.npz").read_bytes()
    actual = struct.pack("<II", *[zipfile.ZipFile(tmp_path / "a.npz").infolist()[0].file_size] * 2)
    at = content.rindex(actual)
    declared = struct.pack("<II", *[min(size, 2**32 - 2)] * 2)
    (tmp_path / "a.npz").write_bytes(content[:at] + declared + content[at + 8 :])
    with pytest.raises(UserError, match=r"more than .* MB; the remedy"):
        read_arrays(tmp_path / "a.npz", "the remedy")
