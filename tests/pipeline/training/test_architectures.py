"""Networks unlike the paper's all the way: NengoDL, conversion, targets, training."""

import nengo
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deploy.check.bundle import CheckSet, write_bundle
from deploy.network.provenance import read_classes
from deploy.network.spec import NetworkSpec
from deploy.preflight.plan import make_plan
from deploy.targets.registry import run_target
from models.architecture import NotationError, parse_architecture
from models.cnn import set_weights
from pipeline.kinds.image.spec import make_image_spec, make_network_spec
from pipeline.recordings.dataset import make_inputs_for
from pipeline.results.other_recordings import find_trained_on
from pipeline.results.report.figures import animation
from pipeline.settings import Settings
from pipeline.sources import load_dataset
from pipeline.training import nengodl
from pipeline.training.images.epochs import TrainingSamples
from pipeline.training.images.networks import TrainedRates, build_rate_network
from pipeline.training.images.train import train_cnn, train_rate_network
from pipeline.training.nengodl import nengo_dl
from tests.untraced import untraced

# To merge operations of ten networks takes longer than to run them.
noop_planner = nengo_dl.graph_optimizer.noop_planner

ARCHITECTURES = [
    "10x10-4c3s2p-2a-12-10o",
    "10x10-3a-6c3p-10o",
    "10x10-5c4p-3a-6c2p-10o",
    "10x10-16-8-10o",
    "10x10-4c3s3-10o",
]


def settings_of(architecture, recipe="paper", **presentation):
    changes = {
        "data": {"source": "elsewhere"},  # whose sensor may have any size
        "cnn": {"architecture": architecture},
        "snn": {"recipe": recipe, "max_rates": [200.0]},
        "presentation": presentation,
    }
    return Settings().with_values(changes, "test")


@st.composite
def notations(draw):
    """What may be an architecture, but small, and most with a convolution: of what a network may be
    they have the most kinds."""
    tokens = [f"{draw(st.integers(3, 8))}x{draw(st.integers(3, 8))}"]
    for _ in range(draw(st.sampled_from([0, 1, 1, 2, 2, 3]))):
        size = f"{draw(st.integers(1, 5))}c{draw(st.integers(1, 4))}"
        stride, padding = draw(st.sampled_from(["", "s2", "s3"])), draw(st.sampled_from(["", "p"]))
        tokens.append(draw(st.sampled_from([size + stride + padding] * 4 + ["2a", "3a"])))
    tokens += [str(draw(st.integers(2, 12))) for _ in range(draw(st.integers(0, 2)))]
    return "-".join([*tokens, f"{draw(st.integers(2, 6))}o"])


def has_neurons(notation):
    try:
        return bool(parse_architecture(notation).spiking)
    except NotationError:  # the image is too small for it
        return False


def random_weights(architecture, seed=1):
    """With which activations are about 0 to 1 and every layer counts."""
    rng = np.random.default_rng(seed)
    weights = {}
    for name, shape in parse_architecture(architecture).weight_shapes.items():
        fan_in = np.prod(shape[:-1])
        scale = 1.8 / np.sqrt(fan_in) if name.endswith("kernel") else 0.05
        weights[name] = (scale * rng.normal(size=shape)).astype(np.float32)
    return weights


def images(n=4, size=(10, 10, 1)):
    rng = np.random.default_rng(0)
    shape = (n, *size)
    return (rng.uniform(size=shape) * (rng.uniform(size=shape) < 0.5)).astype(np.float32)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_the_network_in_nengodl_is_the_keras_one(architecture):
    chosen, weights = settings_of(architecture), random_weights(architecture)
    trained = TrainedRates(chosen, weights).compute_logits(images())
    with untraced():
        ours = nengodl.run_rates(chosen, weights, images(), batch=4)
    assert trained.std() > 0.1
    np.testing.assert_allclose(ours, trained, atol=5e-4)


# An architecture, and a seed of its weights.
ANY = st.tuples(notations().filter(has_neurons), st.integers(0, 2**16))


@pytest.mark.slow
@settings(max_examples=1, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(networks=st.lists(ANY, min_size=8, max_size=8))
def test_any_network_in_nengodl_is_the_keras_one(networks):
    """Eight in one simulator, which takes longer to build than to run."""
    expected, shown, outputs = [], {}, []
    with untraced(), nengo.Network(seed=0) as side_by_side:
        nengo_dl.configure_settings(inference_only=True, planner=noop_planner)
        for architecture, seed in networks:
            given_settings, weights = settings_of(architecture), random_weights(architecture, seed)
            inputs = images(2, parse_architecture(architecture).input_shape)
            model = build_rate_network(given_settings)
            set_weights(model, weights)
            expected.append(model(inputs).numpy())  # called: predict() takes a tenth of a second
            _, source, output = nengodl._convert(  # a part of the network around it
                given_settings, weights, nengo.LIFRate, synapse=None
            )
            shown[source] = inputs.reshape(2, 1, -1)
            outputs.append(output)
        with nengo_dl.Simulator(side_by_side, minibatch_size=2, progress_bar=False) as simulator:
            answers = simulator.predict_on_batch(shown)
    # Near its threshold a neuron's rate rises so steeply that the rounding of a current shows.
    for output, logits in zip(outputs, expected, strict=True):
        np.testing.assert_allclose(answers[output][:, 0], logits, atol=5e-4)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_shown_long_the_deployed_network_answers_as_the_rate_network(architecture):
    shown = dict(steps=700, gap=0, readout_start=150, stream_length=1)
    chosen = settings_of(architecture, "loihi", **shown)
    weights = random_weights(architecture)
    rates = TrainedRates(chosen, weights).compute_logits(images())
    spec = make_image_spec(chosen, weights, {})
    assert NetworkSpec.from_json(spec.to_json(), spec.to_arrays()) == spec
    scores = run_target(spec, images(), "fast").scores
    assert np.corrcoef(scores.ravel(), rates.ravel())[0, 1] > 0.97
    assert make_plan(spec).problems == []


def test_what_is_folded_counts_as_the_architecture_does():
    architecture = "10x10-3a-6c3p-10o"
    spec = make_image_spec(settings_of(architecture), random_weights(architecture), {})
    assert [layer.name for layer in spec.layers] == ["conv1", "output"]
    assert spec.layers[0].pool == 3
    ours, whole = spec.multiply_accumulates, parse_architecture(architecture).multiply_accumulates
    assert sum(ours.values()) == sum(whole.values())
    assert ours["conv1"] == whole["pool1"] + whole["conv1"]


def test_training_with_strides_pooling_and_dense_layers():
    changes = {
        "cnn": {"architecture": "10x10-4c3s2p-2a-12-10o", "epochs": 2},
        "snn": {"epochs": 2, "spike_penalty": 0.1},
    }
    settings = Settings().with_values(changes, "test")
    labels = np.arange(80) % 10
    samples = TrainingSamples(images(80), labels)
    with untraced():
        cnn = train_cnn(settings, samples, 0)
        single = train_rate_network(settings, samples, 0, cnn.weights)
    shapes = parse_architecture(settings.cnn.architecture).weight_shapes
    assert {name: array.shape for name, array in single.weights.items()} == shapes
    assert np.isfinite(single.compute_logits(images())).all()
    assert set(single.compute_activations(images())) == {"conv1", "dense1"}


def test_other_recordings_are_seen_as_those_of_the_training(tmp_path, monkeypatch):
    """A network that was made without a run has what a run's has to read other recordings."""
    monkeypatch.setattr(animation, "FRAMES", 4)
    image = {"aggregation": "on", "normalisation": "sqrt-max", "duration": 500.0}
    chosen = settings_of("10x10-4c3s3-10o", steps=20, readout_start=4).with_values(
        {"data": {"source": "simulated", "samples_per_digit": 4}, "image": image}
    )
    dataset, weights = load_dataset(chosen), random_weights("10x10-4c3s3-10o")
    for provenance in ({}, dataset.provenance):
        spec = make_network_spec(chosen, weights, provenance, dataset.subset("train"))
        np.testing.assert_array_equal(make_inputs_for(spec, dataset.recordings), dataset.inputs)
        checks = CheckSet(dataset.inputs[:2], dataset.labels[:2], ("a", "b"), 0)
        bundle = write_bundle(tmp_path / f"b{len(provenance)}", spec, checks)
        animation.animate(tmp_path / "a.gif", bundle, 0)
    assert read_classes(spec) == tuple("0123456789")
    assert find_trained_on(bundle, dataset.recordings).sum() == len(dataset.split.train)
