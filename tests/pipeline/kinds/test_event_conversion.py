"""The network that is deployed answers as the one that was trained, spike for spike."""

import numpy as np
import pytest

from deploy.network.decision import Estimator, decide
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.preflight.plan import make_plan
from deploy.targets.registry import run_target
from models.architecture import parse_architecture
from models.spiking.network import Neuron, SpikingNetwork
from pipeline.kinds.events.kind import make_event_spec
from pipeline.settings import Settings
from pipeline.training.events import EventDesign, build_network, run_on_frames
from tests.pipeline.handmade import event_table

STEPS, GAP = 40, 60


def trained_like(architecture, seed=0, section_starts=(0,)):
    """Random weights with which all layers spike."""
    neuron = Neuron((1.5, 3.0), (3.0, 5.0))
    network = SpikingNetwork(parse_architecture(architecture), neuron, seed, section_starts)
    weights = network.get_weights()
    for name in network.names:
        weights[f"{name}.kernel"] *= 2.5
    kernel = weights["output.kernel"]
    factors = np.repeat(1 + np.arange(len(section_starts)), len(kernel) // len(section_starts))
    weights["output.kernel"] = kernel * factors[:, None]
    return weights


def table_of(samples=6, events=150, seed=0):
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0, 20 * (STEPS - 10), (samples, events)), 1)
    time -= time[:, :1]
    place = (rng.integers(0, n, samples * events).astype(np.uint8) for n in (10, 10, 2))
    offsets = np.arange(samples + 1) * events
    return event_table((time.ravel().astype(np.float32), *place), offsets)


@pytest.mark.parametrize("target", ["fast", "emulator"])
@pytest.mark.parametrize(
    ("architecture", "section_starts"),
    [
        ("10x10x2-12c4s2-32-10o", (0,)),
        ("10x10x2-4c3s2p-8c2-16-10o", (0, 5, 21)),
        (Settings().events.architecture, (0,)),
    ],
)
def test_every_spike_is_that_of_the_trained_network(architecture, section_starts, target):
    design, weights, table = (
        EventDesign(architecture=architecture, section_starts=section_starts),
        trained_like(architecture, section_starts=section_starts),
        table_of(),
    )
    # Each sample of a stream ends in silence long enough that nothing is left of it.
    presentation = Presentation(steps=STEPS + GAP, gap=GAP, readout_start=0, stream_length=3)
    spec = make_event_spec(design, weights, presentation, {})
    spec = NetworkSpec.from_json(spec.to_json(), spec.to_arrays())
    assert make_plan(spec).problems == []
    indices = np.arange(len(table))
    frames = np.moveaxis(
        table.make_frames(indices, design.step_ms, STEPS + GAP, design.limits), 0, 1
    )
    expected = run_on_frames(design, weights, frames)
    found = run_target(spec, frames, target)
    for name, spikes in expected.spikes.items():
        assert spikes.sum() > 100
        np.testing.assert_array_equal(found.spikes[name], spikes.sum(1))
    np.testing.assert_allclose(
        found.scores * (STEPS + GAP), expected.outputs[:, -1], rtol=1e-4, atol=1e-4
    )
    # A spike travels a step from layer to layer and to the host.
    late = len(expected.spikes) + 1
    first = expected.outputs.any(2).argmax(1)
    mine = expected.outputs.argmax(2)
    for sample in range(len(table)):
        begun = first[sample]
        np.testing.assert_array_equal(
            found.decisions[sample, begun + late :], mine[sample, begun : STEPS + GAP - late]
        )
    counted = spec.count_synaptic_operations(
        {"input": frames.sum(1).reshape(len(table), -1), **expected.spikes}
    )
    np.testing.assert_allclose(np.stack(list(counted.values()), 1), expected.operations)


def test_the_lower_voltage_bound_that_was_trained_is_deployed():
    architecture = "10x10x2-4c4s3-8-10o"
    presentation = Presentation(steps=STEPS, gap=0, readout_start=0, stream_length=1)
    for floor in (-1.0, -2.0):
        design = EventDesign(architecture=architecture, floor=floor)
        weights = trained_like(architecture)
        spec = make_event_spec(design, weights, presentation, {})
        integers = build_network(design, weights).compute_integers()
        for layer in spec.layers[:-1]:
            trained = integers[layer.name]
            expected = trained.floor / trained.threshold
            assert layer.neurons.min_voltage == pytest.approx(expected, rel=1e-3)
            assert floor - 0.5 < expected < floor / 2


def test_the_estimator_decides_on_the_chip_as_in_training():
    design = EventDesign(architecture="10x10x2-12c4s2-32-10o")
    rng, weights, table = np.random.default_rng(0), trained_like(design.architecture), table_of()
    weights |= {
        name: rng.normal(0, 0.3, shape) for name, shape in Estimator.list_shapes(10).items()
    }
    indices, steps = np.arange(len(table)), STEPS + GAP
    frames = np.moveaxis(table.make_frames(indices, design.step_ms, steps, design.limits), 0, 1)
    shown = run_on_frames(design, weights, frames)
    late = len(shown.spikes) + 1
    # What arrives is what was said `late` steps before.
    arrived = np.pad(shown.outputs, ((0, 0), (late, 0), (0, 0)))[:, :steps]
    estimator = Estimator.from_arrays(weights, 10)
    limit = float(np.quantile(estimator(arrived), 0.9))
    expected, _ = decide(arrived, limit, estimator)
    assert set(expected) - {0, steps - 1}
    assert (expected != decide(arrived, limit)[0]).any()
    presentation = Presentation(
        steps=steps, gap=GAP, readout_start=0, stream_length=3, threshold=limit
    )
    spec = make_event_spec(design, weights, presentation, {})
    spec = NetworkSpec.from_json(spec.to_json(), spec.to_arrays())
    np.testing.assert_array_equal(run_target(spec, frames, "fast").stopped_at, expected + 1)


def test_a_long_silence_is_silent():
    design = EventDesign(architecture="10x10x2-12c4s2-32-10o")
    weights = trained_like(design.architecture)
    for name in ("conv1.bias", "dense1.bias"):
        weights[name] = np.full_like(weights[name], 5.0)
    presentation = Presentation(steps=1000, gap=0, readout_start=0, stream_length=1)
    spec = make_event_spec(design, weights, presentation, {})
    found = run_target(spec, np.zeros((1, 1000, 10, 10, 2), np.uint8), "emulator")
    assert {name: int(n.sum()) for name, n in found.spikes.items()} == {
        "input": 0, "conv1": 0, "dense1": 0,
    }  # fmt: skip
