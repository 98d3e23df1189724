"""``convert --nir --retrain``: a graph is what a training on events begins with."""

import json
from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import UserError
from deploy.files import read_json
from models.integers import THRESHOLD_UNIT
from models.nir_layers import layers_of, rounded
from pipeline.roads import nir_training
from pipeline.roads.nir_settings import settings_of_nir
from pipeline.roads.nir_training import architecture_of, settings_of_retrained, trainable
from pipeline.settings import Settings
from pipeline.training.events import EventRecipe, network_of
from tests.command import call as stmnist
from tests.command import missing
from tests.models.nir_graphs import affine, conv, cuba_lif, lif
from tests.models.nir_graphs import network_of as graph_of

nir = pytest.importorskip("nir")

STEP = 0.02


def graph_of_events(*end):
    rng = np.random.default_rng(3)
    return graph_of(
        (2, 10, 10),
        conv(rng, 6, 2, 3),
        cuba_lif(0.05, 0.1, 8.0),
        ("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}),
        conv(rng, 8, 6, 3),
        lif(0.1, 9.0),
        ("Flatten", {"start_dim": 0}),
        affine(rng, 10, 32),
        *end,
    )


@pytest.mark.parametrize(
    ("end", "architecture"),
    [
        ([], "10x10x2-6c3-8c6s2-10o"),
        ([("LI", {"tau": 0.1, "r": 1.0, "v_leak": 0.0})], "10x10x2-6c3-8c6s2-10o"),
        ([lif(0.1, 6.0)], "10x10x2-6c3-8c6s2-10-10o"),
    ],
)
def test_it_begins_with_the_integers_of_the_graph(end, architecture):
    network, shape = graph_of_events(*end), (10, 10, 2)
    assert architecture_of(network, shape) == architecture
    layers = trainable(network, STEP, "euler", shape)
    weights = nir_training.weights_of(layers)
    recipe = EventRecipe(architecture=architecture, step_ms=1000 * STEP)
    integers = network_of(recipe, weights).integers()
    for layer in layers[:-1]:
        wanted, found = rounded(layer), integers[layer.name]
        assert np.abs(found.weights - wanted.weights).max() <= 1  # scales differ by rounding
        assert abs(found.threshold - wanted.threshold) <= THRESHOLD_UNIT
        assert (found.keep_u, found.keep_v) == (max(wanted.keep_u, 2), wanted.keep_v)
    graphs = layers_of(network, STEP, "euler", shape)
    if not graphs[-1].spiking:
        np.testing.assert_array_equal(layers[-1].weights, graphs[-1].weights)
    else:
        np.testing.assert_array_equal(layers[-1].weights, np.eye(10))


@pytest.mark.parametrize(
    ("node", "message"),
    [
        (("IF", {"r": 1.0, "v_threshold": 1.0}), "'n1' (IF)"),
        (("Threshold", {"threshold": 1.0}), "'n1' (Threshold)"),
    ],
)
def test_other_neurons_are_refused_by_name(node, message):
    rng = np.random.default_rng(0)
    network = graph_of((2, 10, 10), conv(rng, 3, 2, 4), node, ("Flatten", {}), affine(rng, 10, 147))
    with pytest.raises(UserError) as caught:
        trainable(network, STEP, "exact", (10, 10, 2))
    assert message in str(caught.value)
    with pytest.raises(UserError) as caught:  # there are no time constants
        architecture_of(network, (10, 10, 2))
    assert message in str(caught.value)


def test_the_size_of_outputs_follows_the_cross_entropy():
    labels = np.arange(10).repeat(5)
    scores = 400.0 * np.eye(10)[labels]
    scores[::10] = np.roll(scores[::10], 1, 1)  # a tenth is wrong, so that more is not better
    scale = nir_training.best_scale(scores, labels)
    assert 1 / 400 < scale < 20 / 400


def small_graph(path, channels=2):
    rng = np.random.default_rng(1)
    nir.write(
        path,
        nir.NIRGraph.from_list(
            nir.Input({"input": np.array([channels, 10, 10])}),
            nir.Conv2d((10, 10), rng.normal(0, 1, (4, channels, 4, 4)), 3, 0, 1, 1, np.ones(4)),
            nir.LIF(*(np.full((4, 3, 3), x) for x in (0.1, 8.0, 0.0, 1.0))),
            nir.Flatten({"input": np.array([4, 3, 3])}, 0),
            nir.Affine(rng.normal(0, 1, (10, 36)), np.zeros(10)),
            nir.Output({"output": np.array([10])}),
        ),
    )


@pytest.mark.slow
def test_a_run_trains_a_graph_further(tmp_path, capsys):
    file, run = tmp_path / "some.nir", tmp_path / "run"
    small_graph(file)
    few = ["--set", "data.samples_per_digit=8", "--set", "events.epochs=1", "--samples", "6"]
    options = ["--step", "20", "--jobs", "1", *few]
    assert stmnist("convert", run, "--nir", file, "--retrain", *options) == 0
    file.write_bytes(b"a later version")  # the run has its own copy
    capsys.readouterr()
    assert stmnist("ladder", run, "--json", "--jobs", "1") == 0
    answered = capsys.readouterr()
    (line,) = [line for line in answered.err.splitlines() if "has changed" in line]
    assert missing(line, str(file), "--nir FILE --retrain") == []
    stages = [row["stage"] for row in json.loads(answered.out)["rows"]]
    assert stages == ["nir", "trained", "nengo", "simreal", "emulator"]
    assert read_json(run / "snn" / "training.json", "")["epochs"] == 1
    assert stmnist("status", run) == 0
    told = capsys.readouterr()
    assert "outdated" not in told.out
    assert "has changed" in told.err
    file.unlink()
    assert stmnist("status", run) == 0
    assert "has changed" not in capsys.readouterr().err
    assert stmnist("report", run) == 0


def test_a_graph_that_is_given_again_keeps_the_users_values(tmp_path):
    file = tmp_path / "some.nir"
    small_graph(file)
    for take, retrain in ((settings_of_nir, False), (settings_of_retrained, True)):
        first = Settings().with_values(take(file, 20.0), "")
        assert first.nir.retrain is retrain
        changes = {"presentation": {"gap": 7, "stream_length": 9}, "nir": {"step": 15.0}}
        mine = first.with_values({**changes, "events": {"budget": 9.0}}, "")
        assert mine.with_values(take(file, before=mine), "") == mine
        with file.open("ab") as later:
            later.write(b"\0")
        again = mine.with_values(take(file, before=mine), "")
        assert again.nir.sha256 != mine.nir.sha256
        assert replace(again, nir=mine.nir) == mine
    small_graph(tmp_path / "another.nir")
    with (tmp_path / "another.nir").open("ab") as another:
        another.write(b"\0\0\0")
    other = mine.with_values(settings_of_retrained(tmp_path / "another.nir", before=mine), "")
    assert (other.nir.step, other.presentation.gap) == (0, Settings().presentation.gap)
    # The other kind of import begins with its own values.
    other = mine.with_values(settings_of_nir(file, before=mine), "")
    assert (other.presentation.gap, other.presentation.stream_length) == (0, 1)
    assert other.nir.step == 0


def test_a_graph_for_images_is_refused(tmp_path, capsys):
    small_graph(tmp_path / "image.nir", channels=1)
    arguments = ("--nir", tmp_path / "image.nir", "--retrain")
    assert stmnist("convert", tmp_path / "run", *arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert missing(line, "image.nir: ", "--retrain", "image") == []
    assert not (tmp_path / "run" / "nir").exists()
