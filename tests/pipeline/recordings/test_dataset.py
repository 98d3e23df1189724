"""Recordings as networks see them: loaded, divided and made in one place."""

import numpy as np
import pytest

from deploy import limits
from deploy.check.bundle import MAX_HEADER_BYTES
from deploy.errors import UserError
from pipeline.recordings.dataset import make_dataset_origin, make_inputs
from pipeline.recordings.images import make_tactile_images
from pipeline.recordings.splits import make_split
from pipeline.settings import SIMULATED, Settings, UndeclaredSetting
from pipeline.sources import find_hash_and_split, load_dataset, load_named_recordings
from pipeline.storage.run_folder import RunFolder
from pipeline.workflow import open_run
from tests.own_sensor import write_folder
from tests.pipeline.handmade import archive, good_members

SMALL = Settings().with_values(
    {"seed": 3, "data": {"samples_per_digit": 6}, "split": {"validation_fraction": 0.25}}, "test"
)


@pytest.fixture(scope="module")
def dataset():
    return load_dataset(SMALL)


@pytest.mark.parametrize("own", [True, False])
def test_the_settings_of_an_experiment_suffice_to_read_the_recordings(tmp_path, own):
    source = str(write_folder(tmp_path / "own", per_class=5)) if own else SIMULATED
    settings = SMALL.with_values({"data": {"source": source}}, "test")
    origin = make_dataset_origin(settings, *find_hash_and_split(settings))
    seen = settings.select(origin.settings)
    assert len(load_named_recordings(seen)) == (20 if own else 60)


def test_other_simulated_people_are_other_recordings():
    more = SMALL.with_values({"data": {"writers": 5, "samples_per_digit": 5}}, "test")
    recordings = load_named_recordings(more)
    assert set(recordings.writers) == set(range(5))
    assert recordings.source.sha256 == find_hash_and_split(more)[0]
    assert recordings.source.name == "simulated, seed 0, 5 people"
    fewer = more.with_values({"data": {"writers": 3}}, "test")
    assert set(load_named_recordings(fewer).writers) == set(range(3))
    assert find_hash_and_split(fewer)[0] != find_hash_and_split(more)[0]


def test_inputs_and_labels_are_those_of_the_recordings(dataset):
    assert len(dataset) == 60
    np.testing.assert_array_equal(dataset.labels, np.repeat(np.arange(10), 6))
    np.testing.assert_array_equal(dataset.inputs, make_tactile_images(dataset.recordings))


def test_the_split_is_of_the_settings_seed_and_fractions(dataset):
    expected = make_split(dataset.recordings, 3, 0.2, 0.25)
    for name in ("train", "validation", "test"):
        inputs, labels = dataset.subset(name)
        index = getattr(expected, name)
        np.testing.assert_array_equal(inputs, dataset.inputs[index])
        np.testing.assert_array_equal(labels, dataset.labels[index])


@pytest.mark.parametrize("source", ["simulated", "imported"])
def test_recordings_are_loaded_with_the_settings_of_their_origin(source, tmp_path):
    """A worker of an experiment can read no others."""
    settings = SMALL
    if source == "imported":
        archive(tmp_path / "mine.zip", good_members(per_digit=6))
        settings = settings.with_values({"data": {"source": str(tmp_path / "mine.zip")}}, "test")
    opened = load_dataset(settings)
    in_a_worker = load_dataset(settings.select(opened.origin.settings))
    assert in_a_worker.origin == opened.origin
    np.testing.assert_array_equal(in_a_worker.labels, opened.labels)


def test_inputs_are_made_with_the_settings_of_a_view_and_no_others(dataset):
    settings = dataset.settings
    image = tuple(f"image.{name}" for name in vars(Settings().image)) + ("input.kind",)
    seen = dataset.restrict_to(settings.select(image))
    assert seen.inputs is dataset.inputs
    signed = settings.with_values({"image": {"aggregation": "signed"}})
    assert not np.array_equal(dataset.restrict_to(signed.select(image)).inputs, dataset.inputs)
    with pytest.raises(UndeclaredSetting):
        _ = dataset.restrict_to(settings.select(["input.kind"])).inputs


def test_too_few_samples_are_one_line_with_the_source(tmp_path):
    path = tmp_path / "st.zip"
    archive(path, good_members())
    values = {"data": {"source": str(path)}, "split": {"test_fraction": 0.01}}
    settings = Settings().with_values(values, "test")
    with pytest.raises(UserError, match=r"st\.zip: 10 .* 0.01 .*split\.test_fraction"):
        load_dataset(settings)


@pytest.mark.parametrize(("kind", "one"), [("image", 100 * 4), ("events", 50 * 200)])
def test_a_check_that_is_too_large_for_a_bundle_is_refused_before_the_training(
    tmp_path, monkeypatch, kind, one
):
    settings = SMALL.with_values(
        {"input": {"kind": kind}, "presentation": {"steps": 50}, "check": {"samples": 5}}
    )
    run = RunFolder(tmp_path)
    monkeypatch.setattr(limits, "ARRAY_BYTES", MAX_HEADER_BYTES + 5 * one - 1)
    with pytest.raises(UserError, match=r"5 samples .* check\.samples"):
        open_run(run, settings)
    assert not run.experiment.exists()
    monkeypatch.setattr(limits, "ARRAY_BYTES", MAX_HEADER_BYTES + 5 * one)
    open_run(run, settings)


def test_more_frames_than_fit_into_memory_are_made_when_they_are_taken(monkeypatch):
    settings = Settings().with_values(
        {"data": {"samples_per_digit": 3}, "input": {"kind": "events"}}
    )
    recordings = load_named_recordings(settings)
    at_once = make_inputs(recordings, settings)
    monkeypatch.setattr("pipeline.recordings.dataset.MAX_FRAME_BYTES", 0)
    on_demand = make_inputs(recordings, settings)
    assert not isinstance(on_demand, np.ndarray)
    assert (len(on_demand), on_demand.shape) == (len(at_once), at_once.shape)
    for index in (4, slice(3, 9), np.array([7, 2, 2]), np.arange(len(at_once)) % 3 == 0):
        np.testing.assert_array_equal(on_demand[index], at_once[index])
