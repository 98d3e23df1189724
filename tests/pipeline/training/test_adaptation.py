"""Responses of a network to recordings of a person."""

import numpy as np

from deploy.check.bundle import read_bundle
from pipeline.live.network import SHIPPED
from pipeline.simulation.simulate import simulate_recordings
from pipeline.training.adaptation import responder as responder_module


def test_inputs_are_made_for_some_recordings_at_a_time(monkeypatch):
    recordings = simulate_recordings(seed=0, samples_per_digit=[1] * 10, jobs=1)
    responder = responder_module.Responder(read_bundle(SHIPPED).spec)
    at_once = responder.compute_responses(responder.make_inputs(recordings))
    copies = responder.respond_to_copies(recordings.subset([0]), 1)
    batch_sizes = []
    make_inputs_for = responder_module.make_inputs_for

    def count_recordings(spec, batch, image):
        batch_sizes.append(len(batch))
        return make_inputs_for(spec, batch, image)

    monkeypatch.setattr(responder_module, "SAMPLES_AT_ONCE", 4)
    monkeypatch.setattr(responder_module, "make_inputs_for", count_recordings)
    np.testing.assert_array_equal(responder.respond_to(recordings), at_once)
    np.testing.assert_array_equal(responder.respond_to_copies(recordings.subset([0]), 1), copies)
    assert batch_sizes == [4, 4, 2, 4, 4, 2]
