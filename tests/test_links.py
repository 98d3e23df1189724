"""Nothing is written through a symbolic link: SECURITY.md's promise, for every file of a run."""

import os
import shutil

import pytest

from deploy.errors import UserError
from deploy.files import replacing
from pipeline.live.keeping import Keeper

from .command import call
from .conftest import TINY
from .deploy.checks import partial

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


def test_a_lock_that_is_a_link_to_nothing(run, elsewhere, refused):
    (run / ".lock").unlink(missing_ok=True)
    (run / ".lock").symlink_to(elsewhere.parent / "new")
    assert str(run / ".lock") in refused("ladder", run)


def test_a_lock_of_recordings_that_is_a_link(tmp_path, elsewhere):
    (tmp_path / "written").mkdir()
    (tmp_path / "written" / ".lock").symlink_to(elsewhere)
    with pytest.raises(UserError, match=r"written.*link"):
        Keeper(tmp_path / "written")


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


def test_every_file_of_a_run_is_written_in_the_place_of_a_link(tiny_run, run, elsewhere):
    """Each file of a finished run is a link; a run with other settings writes all of them anew."""
    made = [path for path in run.rglob("[!.]*") if path.is_file()]
    assert len(made) > 10
    for path in made:
        path.unlink()
        path.symlink_to(elsewhere)
    (run / "experiment.toml").unlink()  # is read first, and makes the folder a run's
    shutil.copy(tiny_run / "experiment.toml", run)
    shutil.rmtree(run / "bundle")
    for name in ("counts", "cnn", "snn"):
        for path in (run / name).iterdir():  # so are metrics, and refused as damaged
            path.unlink()
            path.symlink_to(elsewhere.parent / "nothing there")
    for path in [*run.glob("*.json"), *(run / "checks").iterdir()]:
        path.unlink()
        path.symlink_to(elsewhere.parent / "nothing there")
    assert call("ladder", run, *TINY) == 0
    written = {path.relative_to(run) for path in run.rglob("*") if path.is_file()}
    assert written >= {path.relative_to(run) for path in made}
    assert not any(path.is_symlink() for path in run.rglob("*"))


def test_a_file_is_replaced_and_not_written_through(tmp_path, elsewhere):
    (tmp_path / "a.json").symlink_to(elsewhere)
    with replacing(tmp_path / "a.json") as file:
        file.write(b"new")
    assert (tmp_path / "a.json").read_bytes() == b"new"
    assert not (tmp_path / "a.json").is_symlink()
