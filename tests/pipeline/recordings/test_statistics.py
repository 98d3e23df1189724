"""The paper's Table 1."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.io import loadmat

from pipeline.recordings import statistics
from pipeline.recordings.events import Events
from pipeline.recordings.formats.mat import read_recording
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor, TaxelMap
from tests.command import missing

SOURCE = Source("by hand", "", False)


def by_hand():
    # Digit 4: taxel 0 is (X 1, Y 1), taxel 12 is (X 3, Y 2), taxel 99 is (X 10, Y 10).
    one = Events([100, 5000], [0, 12], [1, -1], [4, 2])
    other = Events([100], [99], [1], [5])
    empty = Events([], [], [], [])
    return join_recordings([one, other, empty], [4, 4, 7], ["a", "b", "c"], [0, 0, 0], SOURCE)


def test_by_hand():
    row = statistics.measure_classes(by_hand())[4]
    assert row["samples"] == 2
    assert row["on"] == pytest.approx((4.5, np.sqrt(0.5)))
    assert row["off"] == pytest.approx((1.0, np.sqrt(2)))
    assert row["on_physical"] == pytest.approx((1.0, 0.0))
    assert row["off_physical"] == pytest.approx((0.5, np.sqrt(0.5)))
    # Weighted with columns: (4 x 1 + 2 x 3) / 6 and 10.
    assert row["x_mean"] == pytest.approx(((10 / 6 + 10) / 2, (10 - 10 / 6) / np.sqrt(2)))
    assert row["y_mean"] == pytest.approx(((8 / 6 + 10) / 2, (10 - 8 / 6) / np.sqrt(2)))
    assert row["x_range"] == pytest.approx((1.0, np.sqrt(2)))
    assert row["y_range"] == pytest.approx((0.5, np.sqrt(0.5)))


def test_places_of_own_recordings_count_from_0_as_their_x_and_y():
    source = replace(SOURCE, time_unit="ms")
    own = replace(by_hand(), source=source, sensor=Sensor(12, 10, classes=tuple("0123456789")))
    values = statistics.make_statistics_json(own)
    mean = (10 / 6 + 10) / 2 - 1
    assert values["classes"]["4"]["row_mean"][0] == pytest.approx(mean)
    assert (values["sensor"]["rows"], values["time_unit"]) == (12, "ms")
    text = statistics.format_statistics(own)
    facts = ("12 rows x 10 columns", "milliseconds", "columns from 0", f"{mean:.2f}")
    assert missing(text, *facts) == []


def test_another_lookup_table():
    turned = TaxelMap(row=TaxelMap().column, column=TaxelMap().row)
    straight = statistics.measure_classes(by_hand())[4]
    row = statistics.measure_classes(replace(by_hand(), taxels=turned))[4]
    assert row["x_mean"] == straight["y_mean"]
    assert row["y_range"] == straight["x_range"]


def test_the_one_real_recording(real_recording):
    recording = read_recording(real_recording.read_bytes())
    recordings = join_recordings([recording.events], [0], ["real"], [-1], SOURCE)
    measures = {
        name: values[0] for name, values in statistics.measure_recordings(recordings).items()
    }
    assert (measures["on"], measures["off"]) == (745, 1601)
    assert (measures["on_physical"], measures["off_physical"]) == (306, 359)
    # From the array itself, without merging bursts.
    rows, _ = np.nonzero(loadmat(real_recording)["spiketrain"][:100])
    assert measures["x_mean"] == pytest.approx((rows % 10 + 1).mean())
    assert measures["y_mean"] == pytest.approx((rows // 10 + 1).mean())
    assert measures["x_range"] == np.ptp(rows % 10)
    assert measures["y_range"] == np.ptp(rows // 10)
