"""Recordings in the published representation."""

import zipfile

import numpy as np
import pytest

from deploy.errors import UserError
from experiments.fidelity import (
    chunk_recordings,
    classify,
    compare_summaries,
    summarise_recordings,
    tell_apart,
)
from pipeline.recordings.chunks import CHUNK_NS
from pipeline.recordings.events import Events
from pipeline.recordings.formats.mat import read_recording
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor, TaxelMap
from pipeline.simulation import parameters
from pipeline.simulation.simulate import SimulationSetup, simulate_recordings
from pipeline.sources import load_recordings


def recordings_of(events, **how):
    return join_recordings([events], [0], ["0/0"], [-1], Source("by hand", "", True), **how)


def test_chunks_by_hand():
    # 250 columns: the first fifty chunks have three of them, the others two.
    columns = np.array([150, 100])
    bits = chunk_recordings(recordings_of(Events([0, 16 * 200], [3, 40], [1, -1], columns)))
    assert bits.shape == (1, 100, 2, 100)
    np.testing.assert_array_equal(bits[0, 3, 0], np.arange(100) < 50)
    np.testing.assert_array_equal(bits[0, 40, 1], np.arange(100) >= 50)
    assert bits.sum() == 100


def test_recordings_that_are_chunks_stay_what_they_are():
    events = Events([0, 20_000_000, 1_980_000_000], [3, 3, 99], [1, -1, 1], [1, 1, 1])
    bits = chunk_recordings(recordings_of(events))
    assert bits.sum() == 3
    assert bits[0, 3, 0, 0]
    assert bits[0, 3, 1, 1]
    assert bits[0, 99, 0, 99]


def test_summaries_by_hand():
    bits = np.zeros((1, 100, 2, 100), bool)
    bits[0, 23, 0, [4, 5, 9]] = True  # row 3, column 2
    bits[0, 33, 1, 7] = True  # row 3, column 3
    result = {name: value[0] for name, value in summarise_recordings(bits).items()}
    assert result["bits"] == 4
    assert result["active"] == 2
    assert result["neighbours"] == 1
    assert result["runs"] == pytest.approx(3 / 2)
    assert result["run length"] == pytest.approx(4 / 3)
    assert result["one bit"] == 0.5
    assert result["rise over fall"] == 3
    assert (result["row"], result["column"]) == (4, 3.5)
    assert (result["height"], result["width"]) == (1, 1)


def test_another_sensor_is_refused():
    events = Events([0], [3], [1], [1])
    other = {"sensor": Sensor(8, 8), "taxels": TaxelMap.grid(8, 8)}
    with pytest.raises(UserError, match="10x10"):
        chunk_recordings(recordings_of(events, **other))


def test_the_published_arrays_are_chunks_of_the_files(shared_data, tmp_path):
    """One published recording is also known as it was recorded: not one bit differs."""
    with (
        zipfile.ZipFile(shared_data / "stmnist-train.zip") as published,
        zipfile.ZipFile(tmp_path / "one-of-each.zip", "w") as some,
    ):
        first = {name.split("/")[1]: name for name in published.namelist()}
        for name in ({**first, "0": "train/0/5153.npz"}).values():
            some.writestr(name, published.read(name))
    published = load_recordings(str(tmp_path / "one-of-each.zip"), jobs=1)
    index = published.ids.index("0/5153")
    raw = read_recording((shared_data / "sample_stmnist.mat").read_bytes()).events
    bits = chunk_recordings(published.subset([index]))
    np.testing.assert_array_equal(chunk_recordings(recordings_of(raw)), bits)


def test_the_share_of_simulated_recordings_in_chunks():
    whole = simulate_recordings(0, [4] * 10, 1)
    chunked = parameters.read_parameters(parameters.Population(chunked_share=0.5))
    half = simulate_recordings(0, [4] * 10, 1, setup=SimulationSetup(chunked))
    is_chunked = [not (half[index].time_ns % CHUNK_NS).any() for index in range(len(half))]
    assert sum(is_chunked) == 20
    np.testing.assert_array_equal(
        chunk_recordings(half.subset(np.flatnonzero(is_chunked))),
        chunk_recordings(whole.subset(np.flatnonzero(is_chunked))),
    )


def test_the_same_recordings_cannot_be_told_apart_and_classes_can():
    recordings = simulate_recordings(0, [30] * 10, 1)
    bits, labels = chunk_recordings(recordings), recordings.labels
    assert 0.3 < tell_apart(bits[::2], bits[1::2]) < 0.7
    assert np.mean(classify(bits[::2], labels[::2], bits[1::2]) == labels[1::2]) > 0.5
    rows = compare_summaries(bits, labels, bits, labels)
    assert all(row["within"] == 10 for row in rows)
