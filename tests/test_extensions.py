"""What another package can add without a change of ours: a format, a target and a kind."""

import json
from dataclasses import replace

import numpy as np

from deploy.check.run import run_check
from deploy.network.responses import Responses
from deploy.targets.registry import TARGETS, Target
from pipeline import kinds, stages
from pipeline.kinds.architectures import make_untrained_network
from pipeline.kinds.kind import NetworkKind
from pipeline.kinds.steps import Step
from pipeline.recordings import formats
from pipeline.recordings.formats.recording import BadRecording, make_recording
from pipeline.recordings.source import read_source
from pipeline.run.settings import Settings
from tests.deploy.networks import bundle_at


def read_toy(content, name):
    """Read events as a list of [x, y, t in seconds, p] in JSON."""
    try:
        x, y, t, p = zip(*json.loads(content), strict=True)
    except ValueError as error:
        raise BadRecording("is not a list of events") from error
    return make_recording({"x": x, "y": y, "t_s": t, "p": p})


def test_a_format(tmp_path, monkeypatch):
    monkeypatch.setitem(formats.READERS, ".toy", read_toy)
    for label in ("a", "b"):
        for number in range(4):
            path = tmp_path / label / f"{number}.toy"
            path.parent.mkdir(exist_ok=True)
            path.write_text(json.dumps([[0, 0, 0.1, 1], [2, 1, 0.2, 0]]))
    recordings = read_source(tmp_path, jobs=1)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (2, 3)
    assert len(recordings) == 8
    assert recordings[0].polarity.tolist() == [1, -1]


def run_first_class(spec, streams, seed=0):
    """Predict the first class of each sample, without a network."""
    for samples in streams:
        scores = np.zeros((len(samples), spec.layers[-1].size))
        scores[:, 0] = 1
        decisions = np.zeros((len(samples), spec.presentation.steps), int)
        yield Responses(scores, decisions, {}, {})


def test_a_target(tmp_path, monkeypatch):
    target = Target("first", run_first_class, "Always the first class", floating=True)
    monkeypatch.setitem(TARGETS, "first", target)
    bundle = bundle_at(tmp_path / "bundle")
    result = run_check(bundle, "first", tmp_path / "first.json")
    assert {sample["prediction"] for sample in result["samples"]} == {0}


# What a network on images reads.
READS = ("seed", "input.kind", "image", "cnn.architecture", "deployment")


class RandomKind(NetworkKind):
    """A network on images with random weights; its step stores the seed of the split."""

    name = "random"
    deployed = "random"
    deployed_stage = "random"
    section = "cnn"
    channels = 1

    @classmethod
    def describes(cls, settings):
        return True

    @property
    def steps(self):
        return (Step("random", "random", ("metrics.json",), READS, self._make),)

    @property
    def trained(self):
        return ("random",)

    @staticmethod
    def _make(inputs, artifact):
        return {"seed": inputs.settings.seed, "accuracy": {}}

    def spec(self, inputs, provenance):
        settings = self.settings
        spec = make_untrained_network(settings.cnn.architecture, False, settings.deployment)
        return replace(spec, provenance=provenance)


def test_a_kind(tmp_path, monkeypatch):
    monkeypatch.setattr(kinds, "KINDS", [RandomKind, *kinds.KINDS])
    settings = Settings().with_values({"data": {"samples_per_digit": 10}, "check": {"samples": 0}})
    with stages.opened_run(tmp_path / "run", settings, say=lambda line: None) as opened:
        assert opened.make("random")["seed"] == 0
        assert opened.artifact("random").state().is_current
        bundle = stages.convert(opened)
    assert bundle.spec.layers[-1].size == 10
