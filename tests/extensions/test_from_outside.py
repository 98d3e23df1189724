"""What another package can add: a format, a target, a kind, an operation and a chip.

`tests/extensions/test_plugins.py` has such a package, which the command line finds by itself.
"""

import json
import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from deploy.check.run import open_check, run_check, run_streams
from deploy.conformance.networks import make_image_network
from deploy.errors import UserError
from deploy.loading import WrongValue
from deploy.network.chip import LOIHI
from deploy.network.layer import LayerRecord
from deploy.network.ops import DEPLOYED_OPERATIONS, DeployedOperation
from deploy.network.output import TargetOutput
from deploy.preflight.plan import make_plan
from deploy.targets.options import Options, option
from deploy.targets.registry import TARGETS, Target, register_target, run_target, select_options
from models import ops
from models.chain import Link, NeuronDecays
from models.rounding import choose_integers, simulate_spikes
from pipeline import workflow
from pipeline.kinds import registry
from pipeline.kinds.architectures import make_untrained_network
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.steps import Step
from pipeline.recordings import formats
from pipeline.recordings.conformance import assert_format_conforms
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.formats.recording import BadRecording, make_recording
from pipeline.settings import INPUTS, Settings
from tests.deploy.networks import bundle_at


def delete_at_the_end(monkeypatch, registry, name):
    """Delete at the end of a test what the test enters under this name."""
    monkeypatch.setitem(registry, name, None)
    del registry[name]


def read_toy(content, name):
    """Read events as a list of [x, y, t in seconds, p] in JSON."""
    try:
        x, y, t, p = zip(*json.loads(content), strict=True)
    except (ValueError, TypeError) as error:
        raise BadRecording("is not a list of events") from error
    return make_recording({"x": x, "y": y, "t_s": t, "p": p})


def test_a_format(tmp_path, monkeypatch):
    delete_at_the_end(monkeypatch, formats.READERS, ".toy")
    formats.register_format(".toy", read_toy)
    with pytest.raises(ValueError, match=r"\.toy"):
        formats.register_format(".toy", read_toy)
    events = {"x": [0, 2], "y": [0, 1], "t": [0.1, 0.2], "p": [1, -1]}
    content = json.dumps([[0, 0, 0.1, 1], [2, 1, 0.2, 0]]).encode()
    assert_format_conforms(".toy", content, events, tmp_path / "conformance")
    for label in ("a", "b"):
        for number in range(4):
            path = tmp_path / "own" / label / f"{number}.toy"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    recordings = read_source(tmp_path / "own", jobs=1)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (2, 3)
    assert len(recordings) == 8
    assert recordings[0].polarity.tolist() == [1, -1]


@dataclass(frozen=True)
class FirstOptions(Options):
    label: int = option(0, "The class that is always predicted.", 0, 9)


def run_first_class(spec, streams, seed, options):
    """Predict one class, the first by default, without a network."""
    for samples in streams:
        readout = np.zeros((len(samples), spec.presentation.steps, spec.layers[-1].size))
        readout[:, :, options.label] = 1
        yield TargetOutput(readout)


def test_a_target(tmp_path, monkeypatch):
    target = Target("first", run_first_class, "Always the first class", options=FirstOptions)
    delete_at_the_end(monkeypatch, TARGETS, "first")
    register_target(target)
    bundle = bundle_at(tmp_path / "bundle")
    result = run_check(bundle, "first", tmp_path / "first.json")
    assert {sample["prediction"] for sample in result["samples"]} == {0}
    options = select_options("first", label=2)
    result = run_check(bundle, "first", tmp_path / "second.json", options=options)
    assert {sample["prediction"] for sample in result["samples"]} == {2}
    assert result["options"] == {"label": 2}
    out = tmp_path / "third.json"
    with open_check(bundle, "first", out, options=FirstOptions()) as opened:
        next(iter(run_streams(opened.make_job(opened.remaining_streams))))
    result = run_check(bundle, "first", out, options=options)  # continues no check of other options
    assert {sample["prediction"] for sample in result["samples"]} == {2}
    with pytest.raises(UserError, match="--label is for --target first"):
        select_options("fast", label=2)
    with pytest.raises(ValueError, match="first and twin: both have --label"):
        register_target(replace(target, name="twin"))
    assert "twin" not in TARGETS


class RandomKind(NetworkKind):
    """A network on images with random weights; its step stores the seed of the split."""

    name = "random"
    input_kinds = ("random",)
    deployed_step = "random"
    deployed_stage = "random"
    settings_group = "cnn"
    channels = 1

    @property
    def steps(self):
        reads = ("seed", "input.kind", "image", "cnn.architecture", "deployment")
        return (Step("random", "random", ("metrics.json",), reads, self._make),)

    @property
    def trained_steps(self):
        return ("random",)

    @staticmethod
    def _make(inputs, artifact):
        return {"seed": inputs.settings.seed, "accuracy": {}}

    def make_spec(self, inputs, provenance):
        settings = self.settings
        spec = make_untrained_network(settings.cnn.architecture, False, settings.deployment)
        return replace(spec, provenance=provenance)


@pytest.fixture
def random_kind(monkeypatch):
    """Register the kind for one test only."""
    monkeypatch.setattr(registry, "KINDS", list(registry.KINDS))
    delete_at_the_end(monkeypatch, INPUTS, "random")
    registry.register_kind(RandomKind)


def test_a_kind(tmp_path, random_kind):
    with pytest.raises(ValueError, match="random"):
        registry.register_kind(RandomKind)
    settings = Settings().with_values(
        {
            "input": {"kind": "random"},
            "data": {"samples_per_digit": 10},
            "check": {"samples": 0},
        }
    )
    with workflow.open_locked_run(tmp_path / "run", settings, say=lambda line: None) as opened:
        assert opened.make("random")["seed"] == 0
        assert opened.find_artifact("random").find_state().is_current
        bundle = workflow.convert(opened)
    assert bundle.spec.layers[-1].size == 10


class DeployedOneToOne(DeployedOperation):
    """A weight for each value."""

    kind = "own"

    def compute_shape(self, pooled_shape):
        return (math.prod(pooled_shape),)

    def compute_weight_shape(self, pooled_shape):
        return self.compute_shape(pooled_shape)

    def compute_sums(self, weights, values):
        return weights * values.reshape(len(values), -1)


class OneToOne(ops.Operation, DeployedOneToOne):
    """The same, in the notation ``own``."""

    token = re.compile("own")
    noun = "a layer of one weight for each value"
    examples = ("own",)

    def __str__(self):
        return "own"


def test_an_operation(monkeypatch):
    """Each bright pixel has a neuron, and all of them have the same spikes."""
    for table in (ops.OPERATIONS, DEPLOYED_OPERATIONS):
        delete_at_the_end(monkeypatch, table, "own")
    ops.register_operation(OneToOne, DeployedOneToOne)
    with pytest.raises(ValueError, match="own"):
        ops.register_operation(OneToOne, DeployedOneToOne)
    spec = make_untrained_network("5x5-own-3o", False, Settings().deployment)
    assert spec.architecture == "5x5-own-3o"
    assert spec.multiply_accumulates == {"own1": 25, "output": 75}
    assert make_plan(spec).problems == []
    own, output = spec.layers
    with pytest.raises(WrongValue, match=f"one of {', '.join(DEPLOYED_OPERATIONS)}, not 'other'"):
        LayerRecord.read({**own.to_json(), "kind": "other"}, "layers[0]")
    spec = replace(spec, layers=(replace(own, weights=np.full(25, 3.0)), output))
    images = np.ones((2, 5, 5, 1))
    images[0, 0] = 0  # 20 bright pixels of 25
    result = {target: run_target(spec, images, target) for target in ("fast", "emulator")}
    np.testing.assert_array_equal(*(one.spike_hashes for one in result.values()))
    spikes = result["fast"].spikes["own1"]
    assert spikes[0] > 0
    assert spikes[0] / 20 == spikes[1] / 25


def test_a_chip():
    """Half the compartments take twice the cores, and six bits of weight make smaller integers."""
    small = replace(LOIHI, name="small", weight_bits=6, limits={**LOIHI.limits, "compartments": 32})
    spec = make_image_network()  # layers of 64 and 72 neurons
    assert len(make_plan(spec).cores) == 2
    plan = make_plan(spec, chip=small)
    assert plan.problems == []
    assert max(core.used["compartments"] for core in plan.cores) <= 32
    assert plan.to_json()["limits"]["compartments"] == 32
    rng = np.random.default_rng(0)
    weights = rng.normal(0, 0.3, (20, 5))
    link = Link("dense1", ops.Dense(5), (20,), weights, np.zeros(5), NeuronDecays(0.8, 0.9))
    spikes = (rng.random((4, 50, 20)) < 0.2).astype(float)
    integers = choose_integers(link, spikes, small)
    assert np.abs(integers.kernel).max() == small.weight_levels == 31
    counts = (simulate_spikes(link, spikes, *more).sum() for more in ((), (integers, small)))
    assert np.ptp(list(counts)) < 0.1 * spikes.sum()
