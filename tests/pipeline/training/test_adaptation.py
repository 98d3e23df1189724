"""Responses of a network to recordings of a person."""

import numpy as np

from deploy.check.bundle import read_bundle
from pipeline.live.network import SHIPPED
from pipeline.simulation.simulate import simulate
from pipeline.training import adaptation


def test_inputs_are_made_for_some_recordings_at_a_time(monkeypatch):
    recordings = simulate(seed=0, samples_per_digit=[1] * 10, jobs=1)
    responder = adaptation.Responder(read_bundle(SHIPPED).spec)
    at_once = responder.compute_responses(responder.make_inputs(recordings))
    copies, made = responder.respond_to_copies(recordings.subset([0]), 1), []
    monkeypatch.setattr(adaptation, "SAMPLES_AT_ONCE", 4)
    original = adaptation.make_inputs_for
    monkeypatch.setattr(
        adaptation,
        "make_inputs_for",
        lambda spec, some, image: made.append(len(some)) or original(spec, some, image),
    )
    np.testing.assert_array_equal(responder.respond_to(recordings), at_once)
    np.testing.assert_array_equal(responder.respond_to_copies(recordings.subset([0]), 1), copies)
    assert made == [4, 4, 2, 4, 4, 2]
