import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from deploy.check.bundle import write_bundle
from deploy.check.run import run_check
from deploy.errors import UserError
from deploy.files import (
    locked,
    locked_folder,
    read_arrays,
    read_json,
    remove_abandoned,
    replacing,
    temporary_file,
    temporary_folder,
    write_arrays,
    write_json,
)
from tests.deploy.networks import random_checks, small_spec


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


def test_what_is_no_json_leaves_what_was_there(tmp_path):
    write_json(tmp_path / "a.json", {"a": 1})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert read_json(tmp_path / "a.json", "") == {"a": 1}
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/a\.json: "):
        write_json(tmp_path / "file" / "a.json", {})


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")  # as /dev/null is none either
    for name in ("pipe", "."):
        with pytest.raises(UserError, match=f"^{tmp_path / name}: "):
            write_json(tmp_path / name, {})
    assert os.listdir(tmp_path) == ["pipe"]


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


def test_an_npy_file_in_place_of_an_npz(tmp_path):
    with open(tmp_path / "a.npz", "wb") as file:
        np.save(file, np.arange(3))
    with pytest.raises(UserError, match=r"a\.npz"):
        read_arrays(tmp_path / "a.npz", "")


def test_a_zip_of_something_else(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("readme.txt", "hello")
    with pytest.raises(UserError, match=r"a\.npz"):
        read_arrays(tmp_path / "a.npz", "")


def test_what_a_killed_process_left_goes_with_the_next_writing(tmp_path):
    """Also if the process was killed a moment ago."""
    abandoned = [tmp_path / ".a.json.abcd_123", tmp_path / ".bundle.abcdefgh"]
    abandoned[0].write_text("half")
    abandoned[1].mkdir()
    (abandoned[1] / "weights.npz").write_text("half")
    others = [tmp_path / name for name in (".b.json.abcdefgh", ".a.json.partial", ".a.json.new")]
    for other in others:
        other.write_text("mine")
    write_json(tmp_path / "a.json", {})
    assert not abandoned[0].exists()
    assert all(other.exists() for other in others)
    spec = small_spec()
    write_bundle(tmp_path / "bundle", spec, random_checks(spec, 3))
    assert not abandoned[1].exists()


@pytest.mark.parametrize("make", [temporary_file, temporary_folder])
@pytest.mark.parametrize("removed", [True, False])
def test_what_another_process_takes_before_it_is_locked_is_made_again(
    make, removed, tmp_path, monkeypatch
):
    """The other process has removed it, or has locked it and is about to remove it."""
    flock, taken, locks = fcntl.flock, [], contextlib.ExitStack()

    def raced(handle, how):
        monkeypatch.setattr(fcntl, "flock", flock)
        taken.extend(tmp_path.iterdir())
        if removed:
            remove_abandoned(tmp_path, ".a.")
        else:
            other = os.open(taken[0], os.O_RDONLY)
            locks.callback(os.close, other)
            flock(other, how)
        flock(handle, how)

    monkeypatch.setattr(fcntl, "flock", raced)
    with locks:
        handle, path = make(tmp_path, ".a.")
    assert Path(path) not in taken
    assert os.path.samestat(os.fstat(handle), os.stat(path))
    remove_abandoned(tmp_path, ".a.")
    assert os.path.exists(path)
    os.close(handle)
    remove_abandoned(tmp_path, ".a.")
    assert not os.path.exists(path)


def test_a_folder_that_another_process_removes_before_it_is_opened_is_made_again(
    tmp_path, monkeypatch
):
    mkdtemp, made = tempfile.mkdtemp, []

    def raced(**where):
        made.append(mkdtemp(**where))
        if len(made) == 1:
            remove_abandoned(tmp_path, ".a.")
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", raced)
    handle, path = temporary_folder(tmp_path, ".a.")
    assert made[1:] == [path]
    os.close(handle)


@pytest.mark.parametrize("make", [temporary_file, temporary_folder])
def test_a_folder_where_nothing_can_be_created(make):
    """Linux says of it that there is no such file."""
    with pytest.raises(FileNotFoundError):
        make("/proc", ".a.")


@pytest.fixture
def no_locks(monkeypatch):
    def refused(handle, how):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refused)


@pytest.mark.parametrize("make", [temporary_file, temporary_folder])
def test_temporary_files_where_there_are_no_locks(make, tmp_path, no_locks):
    handles, paths = zip(*[make(tmp_path, ".a.") for _ in range(2)], strict=True)
    assert all(map(os.path.exists, paths))
    for handle in handles:
        os.close(handle)


def test_files_and_folders_are_used_without_a_lock_where_there_are_none(tmp_path, no_locks):
    with locked(tmp_path / "a.partial", "taken") as file:
        file.write(b"1")
    assert (tmp_path / "a.partial").read_bytes() == b"1"
    with locked_folder(tmp_path / "run", "taken"):
        write_json(tmp_path / "run" / "a.json", {})
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["a.json"]


def test_what_is_being_written_is_nobody_elses(tmp_path):
    with replacing(tmp_path / "a.json") as file:
        write_json(tmp_path / "a.json", {"written": "meanwhile"})
        file.write(b'{"written": "last"}')
    assert read_json(tmp_path / "a.json", "") == {"written": "last"}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_locked_folder_that_was_deleted_is_not_made_again_by_what_is_written(tmp_path):
    """What is written then would be half of what was there, and the lock is no lock any more."""
    run = tmp_path / "run"
    spec = small_spec()
    bundle = write_bundle(tmp_path / "bundle", spec, random_checks(spec, 3))
    with locked_folder(run, "taken"):
        write_json(run / "cnn" / "a.json", {})
        shutil.rmtree(run)
        for write in (
            lambda: write_json(run / "cnn" / "a.json", {}),
            lambda: write_bundle(run / "bundle", spec, bundle.checks),
            lambda: run_check(bundle, "fast", run / "checks" / "fast.json"),
        ):
            with pytest.raises(UserError, match=f"^{run}: "):
                write()
            assert not run.exists()
        run.mkdir()
        (run / ".lock").touch()  # another one's
        with pytest.raises(UserError, match=f"^{run}: "):
            write_json(run / "cnn" / "a.json", {})
    write_json(run / "cnn" / "a.json", {})
