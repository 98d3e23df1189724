"""DVS Gesture as published (long files with files of labels) and as Tonic keeps it; N-MNIST."""

import io
import struct

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.data.archive import export_zip, read_source
from pipeline.data.sensors import Reading
from tests.command import call
from tests.pipeline.handmade import archive, npz

MAPPING = b"action, label\nhand_clapping,1\narm_roll,8\n"
HEAD = "class,startTime_usec,endTime_usec\n"


def aedat3(x, y, t, p) -> bytes:
    """AEDAT 3.1 with one packet of events of pixels; times in microseconds."""
    n = len(x)
    packet = struct.pack("<HHIIIIII", 1, 0, 8, 4, 0, n, n, n)
    words = np.stack([x << 17 | y << 2 | p << 1 | 1, t], 1).astype("<u4")
    return b"#!AER-DAT3.1\r\n#!END-HEADER\r\n" + packet + words.tobytes()


def person(number):
    """A person's recording of 100 s: an event every 10 ms, whose x is the second, modulo 128."""
    t = np.arange(0, 100_000_000, 10_000)
    seconds = t // 1_000_000
    return aedat3(seconds % 128, np.full(len(t), number), t, seconds % 2)


def gestures(root="DvsGesture/"):
    """Two people, each of whom claps twice and rolls the arms twice."""
    rows = ["1,2000000,5000000", "8,5000000,9500000", "1,70000000,71000000", "8,80000000,81000000"]
    members = {f"{root}gesture_mapping.csv": MAPPING, f"{root}trials_to_train.txt": b"user01_led"}
    for number in (1, 2):
        members[f"{root}user0{number}_led.aedat"] = person(number)
        members[f"{root}user0{number}_led_labels.csv"] = (HEAD + "\n".join(rows) + "\n").encode()
    return members


@pytest.mark.parametrize("root", ["", "DvsGesture/"])
def test_long_recordings_are_cut_by_their_labels(tmp_path, root):
    archive(tmp_path / "dvs.zip", gestures(root))
    read = read_source(tmp_path / "dvs.zip", jobs=1)
    assert read.sensor.classes == ("arm_roll", "hand_clapping")
    assert read.labels.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert read.writers.tolist() == [1, 1, 2, 2, 1, 1, 2, 2]
    assert np.diff(read.offsets).tolist() == [450, 100, 450, 100, 300, 100, 300, 100]
    first = read[4]  # from second 2 to before second 5
    assert (first.time_ns[0], first.time_ns[-1]) == (0, 2_990_000_000)
    assert sorted(set(read.taxels.column[first.taxel])) == [2, 3, 4]
    assert set(read.taxels.row[first.taxel]) == {1}
    assert read.sensor.duration_s == 4.5
    assert len(set(read.ids)) == 8
    assert read.ids[4].startswith("hand_clapping/user01_led")


def test_a_part_keeps_the_time_before_its_first_event(tmp_path):
    """Touches of 0.3 s, a second after the start of their label."""
    members, rows = gestures(), ["1,2000000,4000000", "8,6000000,8000000"]
    touch = np.arange(0, 300_000, 10_000)
    t = np.concatenate([touch + start for start in (3_000_000, 7_000_000)])
    for number in (1, 2):
        members[f"DvsGesture/user0{number}_led.aedat"] = aedat3(t % 7, t % 5, t, t % 2)
        labels = (HEAD + "\n".join(rows) + "\n").encode()
        members[f"DvsGesture/user0{number}_led_labels.csv"] = labels
    archive(tmp_path / "dvs.zip", members)
    read = read_source(tmp_path / "dvs.zip", jobs=1)
    assert {read[index].time_ns[0] for index in range(4)} == {1_000_000_000}


def test_without_names_classes_are_numbers(tmp_path):
    members = gestures()
    del members["DvsGesture/gesture_mapping.csv"]
    archive(tmp_path / "dvs.zip", members)
    assert read_source(tmp_path / "dvs.zip", jobs=1).sensor.classes == ("1", "8")


@pytest.mark.parametrize(("labels", "fact"), [
    (b"\xff", "UTF-8"),
    (HEAD.encode(), HEAD.strip().replace(",", ", ")),
    (HEAD.encode() + b"1,5,x", "labels.csv"),
    (HEAD.encode() + b"1,5,5", "labels.csv"),
    (HEAD.encode() + b"1,2,3,4", "labels.csv"),
    (HEAD.encode() + b"1,200000000,300000000", "200000000.* 300000000"),
])  # fmt: skip
def test_damaged_labels_are_refused_with_their_file(tmp_path, labels, fact):
    archive(tmp_path / "dvs.zip", gestures() | {"DvsGesture/user02_led_labels.csv": labels})
    with pytest.raises(UserError, match=rf"user02_led.*{fact}"):
        read_source(tmp_path / "dvs.zip", jobs=1)
    assert len(read_source(tmp_path / "dvs.zip", jobs=1, skip_bad=True)) == 4


def test_labels_of_a_file_without_a_unit_need_it_from_the_user(tmp_path):
    t = np.arange(0, 10_000_000, 10_000)
    labels = "".join(f"{1 + i % 2},{i}000000,{i + 1}000000\n" for i in range(4))
    members = {"a.npz": npz(x=t // 10**6, y=t % 3, t=t, p=t % 2), "a_labels.csv": HEAD + labels}
    archive(tmp_path / "own.zip", members)
    with pytest.raises(UserError, match=r"4 of 4 .*--time-unit"):
        read_source(tmp_path / "own.zip", jobs=1)
    read = read_source(tmp_path / "own.zip", jobs=1, reading=Reading(time_unit="us"))
    assert np.diff(read.offsets).tolist() == [100] * 4
    assert read.sensor.duration_s == 1.0


def test_a_damaged_long_file_is_refused_and_import_works(tmp_path, capsys):
    archive(tmp_path / "dvs.zip", gestures() | {"DvsGesture/user02_led.aedat": b"x"})
    with pytest.raises(UserError, match=r"4 of 8 .*AEDAT"):
        read_source(tmp_path / "dvs.zip", jobs=1)
    archive(tmp_path / "dvs.zip", gestures())
    assert call("data", "import", tmp_path / "dvs.zip") == 0
    assert "8 recordings" in capsys.readouterr().out
    with pytest.raises(UserError, match=r"dvs\.zip"):
        export_zip(tmp_path / "out.zip", tmp_path / "dvs.zip")


def test_tonic_s_layout_of_dvs_gesture(tmp_path):
    """A file is a gesture: its name the class, its folder the person; columns x, y, p, t in ms."""
    members = {}
    for user in (1, 2):
        for label in range(3):
            t = np.arange(0, 3000 + 100 * label, 10)
            rows = np.stack([t % 50, t % 40, t // 10 % 2, t], 1).astype(float)
            buffer = io.BytesIO()
            np.save(buffer, rows)
            members[f"ibmGestureTrain/user0{user}_fluorescent/{label}.npy"] = buffer.getvalue()
    archive(tmp_path / "tonic.zip", members)
    read = read_source(tmp_path / "tonic.zip", jobs=1)
    assert read.sensor.classes == ("0", "1", "2")
    assert read.writers.tolist() == [1, 2, 1, 2, 1, 2]
    assert read.source.time_unit == "ms"
    assert read.sensor.duration_s == pytest.approx(3.2)


def test_n_mnist_s_layout(tmp_path):
    """Train/<digit>/00001.bin: x, y, and 1 bit of polarity before 23 bits of microseconds."""
    members = {}
    for part in ("Train", "Test"):
        for digit in (0, 3):
            for number in range(2):
                t = np.arange(0, 300_000, 1000)
                rows = np.stack(
                    [
                        t // 1000 % 34,
                        t // 1000 * 7 % 34,
                        (t % 2 << 7) | t >> 16,
                        t >> 8 & 255,
                        t & 255,
                    ]
                ).T
                content = rows.astype(np.uint8).tobytes()
                members[f"{part}/{digit}/{number:05d}.bin"] = content
    archive(tmp_path / "nmnist.zip", members)
    read = read_source(tmp_path / "nmnist.zip", jobs=1)
    assert read.sensor.classes == ("0", "3")
    assert (read.sensor.rows, read.sensor.columns) == (34, 34)
    assert len(read) == 8
    assert read[0].time_ns[-1] == 299_000_000


def test_n_caltech_s_overflows_of_the_clock():
    from pipeline.data.eventfile import read_events

    content = np.array([[1, 2, 128, 0, 9], [0, 240, 0, 0, 0], [3, 4, 0, 0, 5]], np.uint8).tobytes()
    read = read_events(content, "a.bin")
    assert read.time.tolist() == [9, 8192 + 5]
    assert read.x.tolist() == [1, 3]
