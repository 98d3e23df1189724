"""Recordings from arrays: written as a zip that is read as any other."""

import numpy as np
import pytest

from deploy.errors import SeveralErrors, UserError
from pipeline.data.images import aggregate
from pipeline.data.library import load_recordings
from pipeline.data.own import write_recordings
from tests.own_sensor import CLASSES, gestures


class LikeTonic:
    """A data set as Tonic has them: structured events in microseconds, and a number."""

    classes = CLASSES

    def __init__(self, per_class):
        self.items = gestures(per_class)

    def __len__(self):
        return len(self.items)

    def __getitem__(self, index):
        (x, y, t, p), label = self.items[index]
        events = np.empty(len(x), [("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
        events["x"], events["y"], events["t"], events["p"] = x, y, np.rint(t * 1e6), p > 0
        return events, label


def test_arrays_and_a_data_set_of_tonic_s_come_back(tmp_path):
    tonic = write_recordings(tmp_path / "tonic.zip", LikeTonic(3))
    plain = write_recordings(tmp_path / "plain.zip", gestures(3), CLASSES, "s", simulated=True)
    tonic, plain = (load_recordings(str(path), jobs=1) for path in (tonic, plain))
    assert tonic.sensor.classes == plain.sensor.classes == CLASSES
    assert (tonic.source.simulated, plain.source.simulated) == (False, True)
    np.testing.assert_array_equal(tonic.labels, [label for _, label in gestures(3)])
    np.testing.assert_array_equal(aggregate(tonic), aggregate(plain))
    expected = np.concatenate([t for (_, _, t, _), _ in gestures(3)])
    np.testing.assert_allclose(tonic.events.time_ns * 1e-9, expected, atol=1e-6)
    np.testing.assert_allclose(plain.events.time_ns * 1e-9, expected, atol=1e-9)


def test_names_writers_and_the_unit(tmp_path):
    named = [((x, y, 1000 * t, p), CLASSES[label]) for (x, y, t, p), label in gestures(2)]
    path = write_recordings(tmp_path / "a.zip", named, time_unit="ms", writers=range(8))
    read = load_recordings(str(path), jobs=1)
    assert read.sensor.classes == CLASSES
    assert sorted(read.writers.tolist()) == list(range(8))
    assert read.source.time_unit == "ms"


@pytest.mark.parametrize(("items", "fact"), [
    ([((0, 1), 0)] * 2, "2 of 2: recording 0"),
    ([(events, 9) for events, _ in gestures(1)], "label 9"),
    ([(events, "../up") for events, _ in gestures(1)], r"'\.\./up'"),
    ([(events, "unknown") for events, _ in gestures(1)], "'unknown'"),
    ([(label, events) for events, label in gestures(1)], "tuple"),
    ([], r"a\.zip"),
])  # fmt: skip
def test_what_cannot_be_written(tmp_path, items, fact):
    with pytest.raises(SeveralErrors, match=fact):
        write_recordings(tmp_path / "a.zip", items, CLASSES)
    assert list(tmp_path.iterdir()) == []


def test_one_recording_of_each_class_is_enough_to_adapt_to(tmp_path):
    path = write_recordings(tmp_path / "a.zip", gestures(1), CLASSES)
    assert len(load_recordings(str(path), jobs=1)) == len(CLASSES)


def test_the_name_and_the_unit(tmp_path):
    with pytest.raises(UserError, match=r"\.zip"):
        write_recordings(tmp_path / "a", gestures(2), CLASSES)
    with pytest.raises(UserError, match=r"time_unit 'minutes'.* s, ms, us, ns"):
        write_recordings(tmp_path / "a.zip", gestures(2), CLASSES, "minutes")
