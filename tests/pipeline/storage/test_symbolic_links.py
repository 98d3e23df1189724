"""Nothing is written through a symbolic link: SECURITY.md's promise, for every file of a run."""

import os
import shutil

import pytest

from deploy.files import replacing
from tests.deploy.checks import partial

CONTENT = b"somebody else's\n"


@pytest.fixture
def elsewhere(tmp_path):
    """A file outside the run, which nothing may change."""
    path = tmp_path / "elsewhere" / "precious"
    path.parent.mkdir()
    path.write_bytes(CONTENT)
    yield path
    assert path.read_bytes() == CONTENT
    assert [each.name for each in path.parent.iterdir()] == ["precious"]


def test_a_lock_that_is_a_link(run, elsewhere, refused):
    (run / ".lock").unlink(missing_ok=True)
    os.symlink(elsewhere, run / ".lock")
    assert str(run / ".lock") in refused("ladder", run)


def test_the_streams_of_a_check_are_not_saved_through_a_link(run, elsewhere, refused):
    saved = partial(run / "checks" / "fast.json")
    os.symlink(elsewhere, saved)
    line = refused("check", "run", run / "bundle", "--target", "fast")
    assert saved.name in line
    assert not (run / "checks" / "fast.json").exists()


def test_a_folder_of_a_run_that_is_a_link(run, elsewhere, refused):
    shutil.rmtree(run / "checks")
    (run / "checks").symlink_to(elsewhere.parent)
    for arguments in (["ladder", run], ["check", "run", run / "bundle", "--target", "fast"]):
        assert str(run / "checks") in refused(*arguments)


def test_a_file_is_replaced_and_not_written_through(tmp_path, elsewhere):
    (tmp_path / "a.json").symlink_to(elsewhere)
    with replacing(tmp_path / "a.json") as file:
        file.write(b"new")
    assert (tmp_path / "a.json").read_bytes() == b"new"
    assert not (tmp_path / "a.json").is_symlink()
