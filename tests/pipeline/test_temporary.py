"""Temporary files of a process and of those that were killed."""

import fcntl
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from pipeline.temporary import PREFIX, own_folder
from tests.command import environment


def test_everything_in_it_goes(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with own_folder():
        with tempfile.NamedTemporaryFile(delete=False) as file:
            pass
        assert Path(file.name).parent.parent == tmp_path
        assert os.environ["TMPDIR"] == str(Path(file.name).parent)
        inner = subprocess.run(
            [sys.executable, "-c", "import tempfile; print(tempfile.mkstemp()[1])"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert Path(inner.stdout.strip()).parent == Path(file.name).parent
    assert not list(tmp_path.iterdir())
    assert os.environ["TMPDIR"] == str(tmp_path)


def test_what_a_killed_process_left_goes_with_the_next_start(tmp_path, monkeypatch):
    code = (
        "import os, signal, tempfile; from pipeline.temporary import own_folder\n"
        "with own_folder():\n"
        "    tempfile.mkstemp(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], env=environment(TMPDIR=str(tmp_path)), check=False)
    (left,) = tmp_path.iterdir()
    assert len(list(left.iterdir())) == 1
    empty = tmp_path / f"{PREFIX}abcd_123"  # of one that was killed before it wrote anything
    empty.mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with own_folder():
        (mine,) = tmp_path.iterdir()
        assert mine not in (left, empty)
        tempfile.tempdir = str(tmp_path)
        with own_folder():
            assert mine.exists()  # whose owner lives stays


def test_a_users_own_folder_is_not_abandoned(tmp_path, monkeypatch):
    (own := tmp_path / "stmnist-datasets").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with own_folder():
        pass
    assert list(tmp_path.iterdir()) == [own]


def test_another_process_that_starts_in_the_same_moment_leaves_it(tmp_path, monkeypatch):
    """The folder is there and not locked yet when the other one tidies up."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    flock, others = fcntl.flock, []

    def interrupted(handle, how):
        if not others:
            others.append(own_folder())
            with others[0]:
                pass
        flock(handle, how)

    monkeypatch.setattr(fcntl, "flock", interrupted)
    with own_folder():
        assert len(others) == 1
        assert Path(tempfile.mkdtemp()).parent.parent == tmp_path


def test_no_place_for_it_is_no_reason_to_stop(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    with own_folder():
        assert tempfile.tempdir == str(tmp_path / "nowhere")
