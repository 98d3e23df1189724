"""The order of the classes in ``classes.txt``."""

from pathlib import PurePosixPath

import numpy as np
import pytest

from pipeline.recordings.files.reading import read_source
from pipeline.recordings.interpretation.class_order import order_classes
from tests.pipeline.handmade import npz
from tests.pipeline.recordings.sources import put

NAMES = {"tap", "swipe right", "swipe left"}
BY_NAME = ("swipe left", "swipe right", "tap")


def test_the_file_gives_the_order():
    content = b"\xef\xbb\xbftap\r\nswipe right\r\n\r\ncircle\r\nswipe left"
    assert order_classes(NAMES, content) == (("tap", "swipe right", "swipe left"), "")


def test_without_a_file_the_order_is_natural():
    assert order_classes({"10", "9", "a"}, None) == (("9", "10", "a"), "")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"tap\nswipe left", "swipe right"),
        (b"tap\nswipe left\nswipe right\ntap", "twice"),
        (b"0 tap\n1 swipe left\n2 swipe right", "swipe left"),
        (b"\xff\xfe\x00", "swipe left"),
    ],
)
def test_another_file_is_not_used_and_the_reason_is_said(content, reason):
    classes, remark = order_classes(NAMES, content)
    assert classes == BY_NAME
    assert reason in remark


def test_digits_are_their_own_labels():
    classes, remark = order_classes({"0", "1", "2"}, b"2\n1\n0")
    assert classes == ("0", "1", "2")
    assert "digits" in remark


def recording(seed):
    """A touch on a sensor in one row, as the content of a file."""
    t = np.sort(np.random.default_rng(seed).uniform(0, 0.5, 7))
    return npz(x=np.arange(7), y=np.zeros(7, int), t=t, p=np.ones(7, int))


@pytest.mark.parametrize("suffix", ["", ".zip"])
@pytest.mark.parametrize("parts", [[""], ["train/", "test/"]])
def test_a_source_has_the_labels_of_its_file(tmp_path, suffix, parts):
    names = [f"{part}{label}/{n}.npz" for part in parts for label in "ab" for n in range(3)]
    contents = {f"mine/{name}": recording(seed) for seed, name in enumerate(names)}
    contents["mine/Classes.txt"] = b"b\na\n"
    contents["mine/a/classes.txt"] = b"not in the folder of the classes"
    read = read_source(put(tmp_path / f"own{suffix}", contents), jobs=1)
    assert read.sensor.classes == ("b", "a")
    assert [read.sensor.classes[label] for label in read.labels] == [
        PurePosixPath(name).parent.name for name in read.ids
    ]
