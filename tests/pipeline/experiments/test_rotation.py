"""Networks for people to whom nothing was fitted, in rotation."""

import json

import numpy as np
import pytest

from deploy.errors import UserError
from models.architecture import parse
from models.spiking import SpikingNetwork
from pipeline.experiments import rotation
from pipeline.experiments.rotation import fold_of
from pipeline.roads.event_conversion import deployed_on_events
from pipeline.settings import Settings
from pipeline.skin import parameters, shape_fit, unipen
from pipeline.training import adaptation
from pipeline.training.adaptation import Responder
from pipeline.training.events import EventRecipe, _neuron
from tests.command import call
from tests.pipeline.skin.test_shapes import people


def write_unipen(path, traces):
    """Write traces as a UNIPEN file, 1,000 units high."""
    lines, at = [], 0
    for trace in traces:
        last = at + len(trace.strokes) - 1
        lines.append(f'.SEGMENT DIGIT {at}-{last} ? "{trace.digit}"')
        lines.append(f".COMMENT {trace.digit} {trace.writer + 1} 0")
        for stroke in trace.strokes:
            points = [f"{1000 * right:.0f} {-1000 * down:.0f}" for down, right in stroke]
            lines += [".PEN_DOWN", *points, ".PEN_UP"]
        at = last + 1
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def pen(tmp_path_factory):
    """Six writers, six of each digit."""
    return write_unipen(tmp_path_factory.mktemp("pen") / "six.unipen", people(each=6))


def test_the_model_is_of_the_others(pen):
    traces = unipen.read(pen)
    fold = fold_of(pen, 1, 2)
    mine = {trace.writer for trace in fold.traces}
    assert mine == {1, 3, 5}
    assert len(fold.traces) == 180
    others = shape_fit.estimate([trace for trace in traces if trace.writer not in mine])
    assert fold.parameters.shapes.fingerprint() == others.fingerprint()
    assert fold.fitted == 3
    built_in = parameters.load()
    assert fold.parameters.shapes.fingerprint() != built_in.shapes.fingerprint()
    assert fold.parameters.forms == built_in.forms


def test_fewer_people_to_fit(pen):
    fold = fold_of(pen, 0, 6, 4)
    assert fold.fitted == 4
    three = shape_fit.estimate([t for t in unipen.read(pen) if t.writer in (1, 2, 3, 4)])
    assert fold.parameters.shapes.fingerprint() == three.fingerprint()
    with pytest.raises(UserError, match=r"\b1 writer"):
        fold_of(pen, 0, 6, 1)


def test_each_trajectory_is_pressed_once(pen):
    fold = fold_of(pen, 0, 6)
    recordings = fold.people(Settings())
    assert recordings.source.sha256 == fold.people_source(Settings()).sha256
    assert recordings.source.simulated
    np.testing.assert_array_equal(np.bincount(recordings.labels), [6] * 10)
    assert set(recordings.writers) == {0}


@pytest.mark.slow
def test_the_command(pen, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(adaptation, "COPIES", 1)
    settings = (
        *("--set", "data.samples_per_digit=20", "--set", "events.epochs=1"),
        *("--set", "events.architecture=10x10x2-4c4s3-10o"),
        *("--set", "input.step=500"),  # two steps of a recording to train, not a hundred
    )
    arguments = ("--handwriting", pen, "--folds", 2, "--each", "1,2", "--draws", 1, "--jobs", 1)
    methods = ("--methods", "readout,wrong-labels,pes", "--input", "events", "--json")
    out = tmp_path / "out"
    assert call("benchmark", "adapt", *arguments, *methods, *settings, "--out", out) == 0
    measured = json.loads(capsys.readouterr().out)
    assert measured == json.loads((out / "adapt.json").read_text())
    assert [network["fold"] for network in measured["networks"]] == [0, 1]
    found = measured["methods"]
    assert {name: entry["people"] for name, entry in found.items()} == {
        "readout": 6, "wrong-labels": 6, "pes": 3,
    }  # fmt: skip
    assert {name: set(entry["each"]) for name, entry in found.items()} == {
        "readout": {"1", "2"}, "wrong-labels": {"2"}, "pes": {"2"},
    }  # fmt: skip
    # What is there is not measured again.
    (out / "networks").rename(out / "kept")
    assert call("benchmark", "adapt", *arguments, *methods, *settings, "--out", out) == 0
    assert json.loads(capsys.readouterr().out) == measured
    assert not (out / "networks").exists()


def test_all_layers_are_trained_further(pen, monkeypatch):
    """No epoch gives the network itself, and one epoch another network."""
    monkeypatch.setattr(rotation, "HALF", 32)
    values = {"input": {"kind": "events"}, "data": {"samples_per_digit": 6}}
    settings = Settings().with_values(values)
    fold = rotation.fold_of(pen, 0, 6)
    dataset, folks = fold.training(settings), fold.people(settings)
    recipe = EventRecipe.of(settings)
    weights = SpikingNetwork(parse(recipe.architecture), _neuron(recipe), 0).get_weights()
    spec = deployed_on_events(settings, weights, 1.0, {})
    tune = rotation._tuning(settings, dataset, folks, weights, 1.0)
    tuned = tune(0, np.arange(20), np.arange(20))
    monkeypatch.setattr(rotation, "TUNING_EPOCHS", 0)
    rest, others, readout = tuned(folks.labels[:20], 0)
    responder = Responder(spec)
    np.testing.assert_array_equal(
        rest, responder.responses(responder.inputs(folks.part(range(20))))
    )
    np.testing.assert_array_equal(readout, spec.layers[-1].weights)
    assert len(others) == len(dataset.split.test)
    monkeypatch.setattr(rotation, "TUNING_EPOCHS", 1)
    assert np.abs(tuned(folks.labels[:20], 0)[2] - readout).max() > 0


def test_all_layers_need_events(pen, tmp_path, capsys):
    arguments = ("--handwriting", pen, "--methods", "all-layers", "--out", tmp_path / "out")
    assert call("benchmark", "adapt", *arguments) == 2
    assert "--input events" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ("--handwriting", "none.unipen"),
        ("--handwriting", "none.unipen", "--data", "none.zip"),
        ("--methods", "magic", "--handwriting", "none.unipen"),
        (),
    ],
)
def test_bad_arguments(arguments, tmp_path, capsys):
    assert call("benchmark", "adapt", *arguments, "--out", tmp_path / "out") == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
