"""Recordings in a folder: kept whole, and counted."""

import errno
import os
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.live.keeping import Keeper
from pipeline.recordings.events import Events
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats.mat import MatRecording, read_recording
from pipeline.recordings.sensor import Sensor


def recording(writer=1, taxel=5):
    events = Events([160_000_000, 170_000_000], [taxel, taxel], [1, -1], [4, 2])
    return MatRecording(events, True, writer, True)


@pytest.fixture
def keeper(tmp_path):
    keeper = Keeper(tmp_path / "kept")
    yield keeper
    keeper.close()


def test_a_recording_is_read_back_with_all_that_is_known_of_it(keeper):
    kept = keeper.save(7, recording())
    read = read_recording((keeper.folder / kept.name).read_bytes())
    assert kept.name == "7/w001-0001.mat"
    assert (read.writer, read.simulated, read.written) == (1, True, True)
    np.testing.assert_array_equal(read.events.time_ns, recording().events.time_ns)


def test_the_folder_is_a_source_of_recordings_with_writers(keeper):
    for writer, digit in ((1, 0), (1, 9), (4, 9)):
        keeper.save(digit, recording(writer))
    read = read_source(keeper.folder, jobs=1)
    assert read.labels.tolist() == [0, 9, 9]
    assert read.writers.tolist() == [1, 1, 4]
    assert read.source.simulated
    assert read.source.written
    assert keeper.writers == {1: 2, 4: 1}


def test_another_keeper_goes_on_where_one_was_killed(keeper):
    keeper.save(3, recording())
    for name in (".w001-0044.mat.abcd1234.tmp", ".LUT.mat.x.tmp"):
        half = keeper.folder / "3" / name
        half.write_bytes(b"half a file")
    keeper.close()
    later = Keeper(keeper.folder)
    assert [path.name for path in (keeper.folder / "3").iterdir()] == ["w001-0001.mat"]
    assert len(later) == 1
    assert later.save(3, recording()).name == "3/w001-0002.mat"
    assert len(read_source(keeper.folder, jobs=1)) == 2
    later.close()


def test_two_at_a_time_are_refused(keeper):
    with pytest.raises(UserError, match="'stmnist live'"):
        Keeper(keeper.folder)


def test_a_full_disk_leaves_nothing_half(keeper, monkeypatch):
    keeper.save(1, recording())

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(UserError, match="No space left"):
            keeper.save(2, recording())
    assert len(keeper) == 1
    assert sorted(p.name for p in (keeper.folder / "2").iterdir()) == []
    assert keeper.save(2, recording()).number == 2


def test_a_file_that_was_put_there_is_not_replaced(keeper, monkeypatch):
    """Even one that comes in the last moment; pressing the class again saves the recording."""
    keeper.save(1, recording())
    look = Keeper.read_folder
    taken = keeper.folder / "1" / "w001-0002.mat"

    def too_early(keeper):
        look(keeper)
        taken.write_text("mine")

    with monkeypatch.context() as patched:
        patched.setattr(Keeper, "read_folder", too_early)
        with pytest.raises(UserError, match="w001-0002"):
            keeper.save(1, recording())
    assert keeper.save(1, recording()).name == "1/w001-0003.mat"
    assert taken.read_text() == "mine"


# Of classes; all but the first are no names of folders.
NAMES = ("über die ganze Fläche", "a/b", "..", "x" * 300, "x" * 301, "")


def test_classes_of_any_name_have_folders_of_their_own(tmp_path):
    sensor = Sensor(9, 12, classes=NAMES)
    with closing(Keeper(tmp_path / "kept", sensor)) as keeper:
        for label in range(len(NAMES)):
            kept = keeper.save(label, replace(recording(taxel=107), n_taxels=108))
            assert (keeper.folder / kept.name).parent.parent == keeper.folder
            content = (keeper.folder / kept.name).read_bytes()
            assert read_recording(content, 108).events.taxel.tolist() == [107, 107]
        assert len(list(keeper.folder.rglob("w*.mat"))) == len(keeper) == len(NAMES)
    plain = Sensor(9, 12, classes=NAMES[:1])
    with closing(Keeper(tmp_path / "plain", plain)) as keeper:
        assert keeper.save(0, replace(recording(), n_taxels=108)).class_folder == NAMES[0]


def test_recordings_of_another_sensor_are_not_mixed_with_these(keeper):
    keeper.save(3, recording())
    keeper.close()
    with pytest.raises(UserError, match="--record"):
        Keeper(keeper.folder, Sensor(9, 12))
    with closing(Keeper(keeper.folder)) as again:  # nothing holds the folder
        assert len(again) == 1
    (keeper.folder / "3" / "own.npz").touch()  # which no command reads together with .mat
    (keeper.folder / ".lock").unlink()
    with pytest.raises(UserError, match=r"own.npz.*--record"):
        Keeper(keeper.folder)
    assert not (keeper.folder / ".lock").exists()
