"""The network's answers while writing are those of its check."""

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.targets.registry import answer as answers_of
from pipeline.inputs.images import tactile_images
from pipeline.live.deciding import decider_of
from pipeline.recordings.events import Events
from pipeline.settings import Image
from pipeline.skin.simulate import simulate


@pytest.fixture(scope="module")
def bundle(tiny_run):
    return read_bundle(tiny_run / "bundle")


@pytest.fixture(scope="module")
def decider(bundle):
    return decider_of(bundle, Image())


@pytest.fixture(scope="module")
def recordings():
    return simulate(3, [2] * 10, jobs=1)


def test_a_whole_recordings_answer_is_that_of_the_target_fast(bundle, decider, recordings):
    spec = bundle.spec.with_presentation(stream_length=1)
    images = tactile_images(recordings)
    expected = answers_of(spec, images, "fast")
    for index in range(len(recordings)):
        said = decider.begin().answer(recordings[index], 2.0)
        np.testing.assert_array_equal(said.scores, expected.scores[index])
        assert said.decision == expected.predictions[index]
        counts = {name: int(np.unpackbits(rows).sum()) for name, rows in said.spikes.items()}
        assert counts == {name: n[index] for name, n in expected.spikes.items()}


def test_it_decides_on_part_of_a_recording_and_not_on_nothing(decider, recordings):
    events = recordings[0]
    part = Events(*(getattr(events, n)[:40] for n in ("time_ns", "taxel", "polarity", "columns")))
    said = decider.begin().answer(part, 0.5)
    assert said.confidence.sum() == pytest.approx(1)
    assert 0 <= said.decision <= 9
    assert decider.begin().answer(Events(*(np.empty(0),) * 4), 0.2) is None


def test_layers_are_as_many_bytes_as_the_page_reads(bundle, decider, recordings):
    said = decider.begin().answer(recordings[0], 2.0)
    assert [layer.name for layer in decider.layers] == list(bundle.spec.spiking_layers)
    assert decider.steps + decider.first_step == bundle.spec.presentation.steps
    for layer in decider.layers:
        assert said.spikes[layer.name].shape == (decider.steps, -(-layer.neurons // 8))
