"""Large sources: their columns stay on the disk, and parts of them give what all at once gives."""

import mmap

import numpy as np
import pytest

from experiments.growth import repeat_recordings
from pipeline.kinds import counts as kinds_counts
from pipeline.recordings import cache, cached_recordings, spike_frames
from pipeline.recordings.events import EVENT_DTYPES
from pipeline.recordings.images import AlteredImages, make_tactile_images
from pipeline.recordings.spike_frames import EventTable
from pipeline.settings import Image
from tests.pipeline.handmade import recordings

MS = 1_000_000
IMAGE = Image("polarities", 2, 20.0, "sqrt-clip")


@pytest.fixture
def some():
    """Five recordings of up to nine events; the third has none."""
    rng = np.random.default_rng(0)
    samples = []
    for number in (9, 4, 0, 7, 5):
        time = np.sort(rng.integers(0, 40, number)) * MS
        taxel = rng.integers(0, 100, number)
        polarity = rng.choice([-1, 1], number)
        samples.append(np.stack([time, taxel, polarity, np.ones(number, int)], 1).tolist())
    return recordings(*samples, labels=[0, 1, 2, 0, 1])


def is_mapped(column):
    """True for an array of a file's memory."""
    while isinstance(column, np.ndarray):
        column = column.base
    return isinstance(column, mmap.mmap)


def test_stored_recordings_are_mapped_and_the_same(some, tmp_path):
    cached_recordings.store_recordings(tmp_path / "some.npz", some)
    loaded = cached_recordings.read_stored(tmp_path / "some.npz")
    for name in EVENT_DTYPES:
        assert is_mapped(getattr(loaded.events, name)), name
    assert loaded.hashes == some.hashes
    np.testing.assert_array_equal(
        make_tactile_images(loaded, IMAGE), make_tactile_images(some, IMAGE)
    )


def all_of(some):
    """What is made of the events of recordings: counts, images, altered images, lost events."""
    table = EventTable.from_recordings(some)
    altered = AlteredImages(some, IMAGE, "space", np.array([0, 3, 4]))
    return [
        table.count_in_slices(2, 20.0),
        table.count_in_slices(2, 20.0, np.array([3, 2])),
        make_tactile_images(some, IMAGE),
        altered(np.random.default_rng(0), [2, 0]),
        np.array([table.measure_loss(5.0), table.measure_loss(5.0, 2)]),
    ]


def test_parts_of_recordings_give_what_all_at_once_gives(some, monkeypatch, tmp_path):
    expected = all_of(some)
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path))
    monkeypatch.setattr(spike_frames, "RECORDINGS_AT_ONCE", 2)
    monkeypatch.setattr(cache, "MAX_BYTES_IN_MEMORY", 100)
    found = all_of(some)
    assert is_mapped(found[0])
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    assert list(tmp_path.iterdir()) == []  # nothing is left behind


def test_the_baseline_is_fitted_to_some_of_many_samples(monkeypatch):
    rng = np.random.default_rng(0)
    labels = np.arange(300) % 3
    counts = rng.poisson(1 + 4 * np.eye(3)[labels])[:, None].astype(np.float32)
    train = np.arange(200)
    whole = kinds_counts.fit_baseline(counts, labels, train, 3)
    monkeypatch.setattr(kinds_counts, "SAMPLES_AT_ONCE", 7)
    again = kinds_counts.fit_baseline(counts, labels, train, 3)
    np.testing.assert_array_equal(whole.scores, again.scores)
    monkeypatch.setattr(kinds_counts, "MAX_FITTED_SAMPLES", 60)
    few = kinds_counts.fit_baseline(counts, labels, train, 3)
    assert not np.array_equal(whole.scores, few.scores)
    assert np.mean(few.scores.argmax(1)[200:] == labels[200:]) > 0.8


def test_repeated_recordings_have_ids_of_their_own():
    some = recordings(
        *[[(0, digit, 1, 1), (MS, 99, -1, 2)] for digit in range(10)], labels=range(10)
    )
    made = repeat_recordings(some, 3)
    assert len(made) == len(set(made.ids)) == 30
    assert np.bincount(made.labels).tolist() == [3] * 10
    assert len(set(made.hashes)) == 10
