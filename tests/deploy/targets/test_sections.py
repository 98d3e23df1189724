"""A readout with weights for sections of the presentation, on every target and beyond."""

from dataclasses import replace

import numpy as np
import pytest

from deploy.conformance.networks import make_image_network
from deploy.errors import UserError
from deploy.network.nir import make_nir_graph
from deploy.network.spec import NetworkSpec
from deploy.targets.registry import run_target
from pipeline.training.adaptation.responder import Responder

IMAGES = np.random.default_rng(1).random((4, 6, 6, 1))


@pytest.fixture(scope="module")
def spec():
    plain = make_image_network(steps=40, readout_start=5)
    readout = plain.layers[-1]
    factors = np.random.default_rng(0).normal(size=(3, *readout.weights.shape))
    weights = (factors * readout.weights).reshape(-1, readout.weights.shape[1])
    readout = replace(readout, weights=weights, section_starts=(0, 12, 30))
    made = replace(plain, layers=(*plain.layers[:-1], readout))
    return NetworkSpec.from_json(made.to_json(), made.to_arrays())


def test_all_targets_read_the_same(spec):
    images = IMAGES
    expected = run_target(spec, images, "emulator")
    fast = run_target(spec, images, "fast")
    np.testing.assert_allclose(fast.scores, expected.scores)
    np.testing.assert_array_equal(fast.decisions, expected.decisions)
    assert list(fast.spike_hashes) == list(expected.spike_hashes)
    for target in ("nengo", "simreal"):
        result = run_target(spec, images, target)
        assert result.scores.shape == expected.scores.shape
    # A spike is read once, with the weights of its step's part.
    last, before = spec.layers[-1], spec.layers[-2].name
    assert (fast.operations["output"] == fast.spikes[before] * last.size).all()


def test_the_readout_of_responses_gives_the_scores(spec):
    spec = spec.with_presentation(stream_length=1)
    images, readout = IMAGES, spec.layers[-1]
    responses = Responder(spec).compute_responses(images)
    scores = responses @ readout.weights_by_class.T + readout.bias
    np.testing.assert_allclose(scores, run_target(spec, images, "fast").scores, atol=1e-6)


def test_nir_has_no_parts(spec):
    pytest.importorskip("nir")
    with pytest.raises(UserError, match="parts"):
        make_nir_graph(spec)


@pytest.mark.parametrize("starts", [(), (1,), (0, 0), (0, 5, 3), (0, 10**9)])
def test_parts_begin_one_after_the_other(spec, starts):
    with pytest.raises(UserError, match="starts"):
        replace(spec.layers[-1], section_starts=starts)
