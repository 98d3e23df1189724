"""The network in NengoDL and in Nengo against the rate-based network that was trained."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from deploy.network.responses import join_responses
from deploy.targets.registry import run_target
from models.architecture import parse_architecture
from models.cnn import find_gain
from models.keras.keras2 import tf
from models.ops.base import Operation
from models.ops.conv import Convolution
from models.ops.dense import Dense
from pipeline.kinds.image.spec import make_image_spec
from pipeline.settings import Settings
from pipeline.training import nengodl
from pipeline.training.images.networks import TrainedRates
from tests.untraced import untraced

N = 6


def settings_of(recipe, **presentation):
    changes = {"snn": {"recipe": recipe, "max_rates": [200.0]}, "presentation": presentation}
    return Settings().with_values(changes, "test")


@pytest.fixture(scope="module")
def images():
    rng = np.random.default_rng(0)
    shape = (N, 10, 10, 1)
    return (rng.uniform(size=shape) * (rng.uniform(size=shape) < 0.4)).astype(np.float32)


@pytest.fixture(scope="module")
def weights():
    """Random weights with which the activations are about 0 to 1 and every layer counts."""
    rng = np.random.default_rng(1)
    shapes = {
        "conv1.kernel": (4, 4, 1, 6),
        "conv1.bias": (6,),
        "conv2.kernel": (3, 3, 6, 24),
        "conv2.bias": (24,),
        "output.kernel": (600, 10),
        "output.bias": (10,),
    }
    scales = [0.35, 0.05, 0.25, 0.05, 0.2, 0.3]
    return {
        name: (scale * rng.normal(size=shape)).astype(np.float32)
        for (name, shape), scale in zip(shapes.items(), scales, strict=True)
    }


def test_the_rate_network_in_nengodl_is_the_trained_one(images, weights):
    settings = settings_of("paper")
    trained = TrainedRates(settings, weights).compute_logits(images)
    ours = nengodl.run_rates(settings, weights, images, batch=4)
    assert ours.shape == (N, 10)
    assert trained.std() > 0.3
    np.testing.assert_allclose(ours, trained, atol=2e-4)


def test_an_operation_without_a_layer_of_its_own_is_converted_alike(images, weights, monkeypatch):
    settings = settings_of("paper")
    rates = nengodl.run_rates(settings, weights, images)
    monkeypatch.setattr(Convolution, "make_keras_layer", Operation.make_keras_layer)
    monkeypatch.setattr(Dense, "make_keras_layer", Operation.make_keras_layer)
    np.testing.assert_allclose(nengodl.run_rates(settings, weights, images), rates, atol=1e-4)
    spiking = nengodl.run_network(settings, weights, images, 600)[:, 100:].mean(1)
    assert np.abs(spiking - rates).mean() < 0.12 * rates.std()


def test_what_ran_before_in_the_process_makes_no_difference(images, weights):
    settings = settings_of("paper")
    outputs = []
    with untraced():
        for before in (1, 2):
            np.random.seed(before)  # noqa: NPY002 - the global state is what is tested
            tf.random.set_seed(before)
            outputs.append(nengodl.run_network(settings, weights, images, 6, batch=N))
        other = nengodl.run_network(replace(settings, seed=1), weights, images, 6, batch=N)
    np.testing.assert_array_equal(*outputs)
    assert np.any(other != outputs[0])  # the neurons' first voltages are the seed's


def test_the_spiking_network_in_nengodl_is_near_its_rate_version(images, weights):
    settings = settings_of("paper")
    rates = TrainedRates(settings, weights).compute_logits(images)
    spiking = nengodl.run_network(settings, weights, images, 600, batch=N)[:, 100:].mean(1)
    assert np.abs(spiking - rates).mean() < 0.12 * rates.std()
    assert np.corrcoef(spiking.ravel(), rates.ravel())[0, 1] > 0.98


@pytest.mark.parametrize("recipe", ["loihi", "paper"])
def test_shown_long_the_deployed_network_answers_as_the_rate_network(images, weights, recipe):
    settings = settings_of(recipe, steps=900, gap=0, readout_start=100, stream_length=1)
    images = images[:4]
    rates = TrainedRates(settings, weights).compute_logits(images)
    responses = run_target(make_image_spec(settings, weights, {}), images, "nengo")
    tolerance = 0.15 if recipe == "loihi" else 0.35  # the paper's rates know no whole steps
    assert np.abs(responses.scores - rates).mean() < tolerance * rates.std()
    assert np.corrcoef(responses.scores.ravel(), rates.ravel())[0, 1] > 0.97


def test_on_the_emulator_it_is_near_too(images, weights):
    settings = settings_of("loihi", steps=300, readout_start=50, stream_length=1)
    rates = TrainedRates(settings, weights).compute_logits(images)
    parts = [
        run_target(make_image_spec(settings, weights, {}), images[i : i + 2], "emulator")
        for i in (0, 2)
    ]
    scores = join_responses(parts).scores
    assert np.corrcoef(scores.ravel(), rates[:4].ravel())[0, 1] > 0.95


def test_the_range_of_output_neurons_is_set_by_right_and_wrong_logits():
    """Two classes; the label's logit is 4 (and once 0, a wrong answer), the other's 1, 2, 3."""
    settings = Settings().with_values(
        {"deployment": {"readout": "chip"}, "snn": {"recipe": "paper"}}, "test"
    )
    weights = {
        name: np.zeros(shape, np.float32)
        for name, shape in parse_architecture(settings.cnn.architecture).weight_shapes.items()
    }
    weights["output.kernel"][0, 0] = 1
    logits = np.full((3, 10), -9.0)
    logits[0, [3, 5]], logits[1, [3, 5]], logits[2, [3, 5]] = (4, 1), (4, 2), (0, 3)
    output = make_image_spec(settings, weights, {}, (logits, np.array([3, 3, 3]))).layers[-1]
    full = np.percentile([4, 4, 0], 99)
    threshold = 1.4  # a fifth of the way from the first to the last of the best wrong ones, 1, 2, 3
    gain = find_gain(500.0, 0.02, 0.001) / (full - threshold)
    assert output.weights[0, 0] == pytest.approx(gain)
    assert output.bias[0] == pytest.approx(1 - gain * threshold)


def test_a_missing_gpu_is_not_warned_of(images, weights):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nengodl.run_rates(settings_of("paper"), weights, images[:1])
    assert not any("GPU" in str(warning.message) for warning in caught)
