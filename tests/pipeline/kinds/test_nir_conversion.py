"""A NIR graph becomes a run's network: integers on every target, round trip, ladder, bad input."""

import contextlib
import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from deploy.conformance.networks import make_image_network
from deploy.errors import UserError
from deploy.files import read_json
from deploy.network.nir import make_nir_graph, write_nir
from deploy.network.presentation import Presentation
from deploy.network.stimulus import EventFrames, ImageSpikes
from deploy.preflight.plan import make_plan
from deploy.targets.registry import run_target
from models.nir.chain import from_nir
from models.nir.graph import read_nir
from models.nir.simulator import simulate
from models.rounding import choose_integers, round_to_integers, simulate_spikes
from pipeline.kinds.nir.conversion import list_synapse_notes, make_nir_spec
from pipeline.kinds.nir.importing import Stepping, make_nir_settings, require_graph_fits
from pipeline.kinds.nir.simulation import make_graph_inputs
from pipeline.settings import Settings, read_settings
from pipeline.storage.run_folder import RunFolder
from tests.command import call as stmnist
from tests.command import missing
from tests.deploy.networks import draw_checks
from tests.models.nir_graphs import affine, conv, cuba_lif, lif, network_of, spikes
from tests.own_sensor import write_folder

nir = pytest.importorskip("nir")

FRESH = Presentation(steps=60, gap=0, readout_start=0, stream_length=1)
STEPPED = Stepping(0.001, "euler")


def events_network(rng, *end):
    """Averaging, a convolution with current-based neurons, and a dense layer."""
    return network_of(
        (2, 8, 8),
        ("AvgPool2d", {"kernel_size": 2, "stride": 2, "padding": 0}),
        conv(rng, 4, 2, 3, bias=0.1),
        cuba_lif(0.004, 0.01, 12.0),
        ("Flatten", {"start_dim": 0}),
        affine(rng, 6, 16),
        lif(0.02, 8.0, v_leak=-0.1),
        affine(rng, 3, 6, bias=0.2),
        *end,
    )


def frames_of(rng, n, steps=60, shape=(8, 8, 2)):
    """Frames of events, silent in the last steps, in which spikes still travel."""
    frames = spikes(rng, n, steps, shape, 0.15).astype(np.uint8)
    frames[:, -8:] = 0
    return frames


@pytest.mark.parametrize(
    "end", [[], [lif(0.03, 6.0)], [("LI", {"tau": 0.02, "r": 2, "v_leak": 0})]]
)
def test_fast_is_the_emulator_and_the_network_fits(end):
    rng = np.random.default_rng(2)
    network = events_network(rng, *end)
    frames = frames_of(rng, 4)
    spec = make_nir_spec(network, STEPPED, EventFrames(0.001, 0), FRESH, frames)
    found = run_target(spec, frames, "fast")
    emulated = run_target(spec, frames[:2], "emulator")
    np.testing.assert_array_equal(emulated.spike_hashes, found.spike_hashes[:2])
    for name in spec.spiking_layers:
        assert found.spikes[name].sum() > 5, name
    assert make_plan(spec).problems == []


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("target", ["emulator", "fast", "nengo"])
def test_spikes_are_the_chosen_integers_one_by_one(padded, target):
    """Without biases the chip's spikes are those of the integers, a step later for each layer."""
    rng = np.random.default_rng(4)
    first = conv(rng, 5, 2, 3)
    if padded:  # a padding that Nengo does not know; the sixth row is outside of the pairs
        pairs = ("SumPool2d", {"kernel_size": 2, "stride": 2, "padding": 0})
        between = conv(rng, 3, 5, 3, padding=2, stride=2)
        first, size = conv(rng, 5, 2, 4, padding=1), 3 * 2 * 2
        middle = [lif(0.01, 10.0), pairs, between, lif(0.01, 10.0)]
    else:
        size, middle = 80, [lif(0.01, 10.0)]
    network = network_of(
        (2, 6, 6),
        first,
        *middle,
        ("Flatten", {}),
        affine(rng, 7, size),
        cuba_lif(0.005, 0.02, 30.0),
        affine(rng, 3, 7),
    )
    frames = frames_of(rng, 3, shape=(6, 6, 2))
    spec = make_nir_spec(network, STEPPED, EventFrames(0.001, 0), FRESH, frames)
    if padded:
        assert [layer.operation.padding for layer in spec.layers[:2]] == ["1", "2"]
    found = run_target(spec, frames, target)
    signal = calibration = frames.reshape(3, 60, -1).astype(float)
    for delay, layer in enumerate(from_nir(network, 0.001, "euler", (6, 6, 2))[:-1], 2):
        integers = choose_integers(layer, calibration)
        signal, calibration = (
            simulate_spikes(layer, signal, integers),
            simulate_spikes(layer, calibration),
        )
        late = signal[:, : 60 - delay + 1].sum((1, 2))
        if target == "nengo":  # in real numbers
            np.testing.assert_allclose(found.spikes[layer.name], late, rtol=0.1, atol=3)
        else:
            np.testing.assert_array_equal(found.spikes[layer.name], late)
        assert late.min() > 0


def test_biases_of_a_filtered_readout_fade_in():
    """Without spikes the score is the mean of the graph's output over the steps."""
    network = network_of(
        (2, 2, 2),
        ("Flatten", {}),
        ("Affine", {"weight": np.eye(3, 8), "bias": np.zeros(3)}),
        lif(0.01, 12.0),
        ("Affine", {"weight": np.eye(3), "bias": np.array([1.0, -2.0, 0.5])}),
        ("LI", {"tau": 0.02, "r": 2.0, "v_leak": np.array([0.0, 0.3, 0.1])}),
        ("Affine", {"weight": np.array([[1.0, 2, 0], [0, 1, 0], [0, 0, 1]]), "bias": np.ones(3)}),
    )
    frames = np.zeros((1, 60, 2, 2, 2), np.uint8)
    spec = make_nir_spec(network, STEPPED, EventFrames(0.001, 0), FRESH, frames)
    graph = simulate(network, np.zeros((1, 60, 2, 2, 2)), 0.001, "euler").outputs
    np.testing.assert_allclose(run_target(spec, frames, "fast").scores, graph.mean(1), atol=1e-9)


def test_an_image_is_held():
    """Without rounding of rates: a pixel of 1 spikes every other step with twice the weight."""
    network = network_of((1, 2, 2), ("Flatten", {}), ("Linear", {"weight": np.eye(4)}),
                         lif(0.01, 3.0), ("Linear", {"weight": np.eye(4)}))  # fmt: skip
    images = np.array([1.0, 0.5, 0.1, 0.0]).reshape(1, 2, 2, 1)
    shown = Presentation(steps=400, gap=0, readout_start=0, stream_length=1)
    spec = make_nir_spec(network, STEPPED, ImageSpikes(), shown, images)
    found = run_target(spec, images, "fast").scores[0]
    # a held input of 3 v passes 1 after log(1 - 1 / 3 v) / log(0.9) steps: 4, 11, never
    np.testing.assert_allclose(found[:2], [1 / 4, 1 / 11], rtol=0.35)
    assert found[2] == found[3] == 0


def test_an_exported_network_on_events_has_the_same_weights_again():
    """NIR has no integers: threshold and weights are rounded once more."""
    rng = np.random.default_rng(2)
    frames = frames_of(rng, 3)
    spec = make_nir_spec(events_network(rng), STEPPED, EventFrames(0.02, 0), FRESH, frames)
    graph = read_nir(make_nir_graph(spec))
    assert graph.convention.step_s == 0.001
    for link, layer in zip(from_nir(graph, 0.001, "exact", (8, 8, 2)), spec.layers, strict=True):
        weights = layer.weights if layer.kind == "conv" else layer.weights.T
        if layer.neurons is None:
            np.testing.assert_allclose(link.kernel, weights)
            continue
        whole = np.rint(127 * weights / np.abs(weights).max())
        assert np.abs(round_to_integers(link).kernel - whole).max() <= 1


def test_the_export_of_a_bundle_on_images_is_imported(tmp_path):
    """Its input is the image, as that of any graph with one channel."""
    spec = make_image_network()
    write_nir(tmp_path / "n.nir", spec)
    changes = make_nir_settings(tmp_path / "n.nir")
    assert changes["input"]["kind"] == "image"
    images = draw_checks(spec, 6).inputs
    network = read_nir(tmp_path / "n.nir")
    stepping = Stepping.from_settings(Settings().with_values(changes), network)
    again = make_nir_spec(network, stepping, spec.stimulus, spec.presentation, images)
    one, other = (run_target(s, images, "fast").scores for s in (spec, again))
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.9


def test_a_flat_graph_is_given_again_without_its_kind(tmp_path):
    """216 inputs, of 9 x 12 taxels, are no square: the first time the kind is given."""
    graph = nir.NIRGraph.from_list(
        nir.Input({"input": np.array([216])}),
        nir.Affine(np.ones((4, 216)), np.zeros(4)),
        nir.LIF(*(np.full(4, x) for x in (0.1, 8.0, 0.0, 1.0))),
        nir.Output({"output": np.array([4])}),
    )
    nir.write(tmp_path / "flat.nir", graph)
    with pytest.raises(UserError, match="--input"):
        make_nir_settings(tmp_path / "flat.nir")
    run = Settings().with_values(make_nir_settings(tmp_path / "flat.nir", 20.0, "events"), "")
    assert make_nir_settings(tmp_path / "flat.nir", before=run)["input"] == {"kind": "events"}


def merged_graph(loop=0.0):
    """One input for both polarities of each taxel, and a recurrent layer."""
    rng = np.random.default_rng(0)
    full = {name: np.full(20, x) for name, x in (("tau_syn", 2e-4), ("tau_mem", 1e-3), ("r", 10.0),
            ("v_leak", 0.0), ("v_threshold", 1.0), ("w_in", 2.0))}  # fmt: skip
    nodes = {
        "input": nir.Input({"input": np.array([100])}),
        "fc1": nir.Affine(rng.normal(0, 1, (20, 100)), np.zeros(20)),
        "lif": nir.CubaLIF(**full),
        "w_rec": nir.Linear(rng.normal(loop, 0.3, (20, 20))),
        "fc2": nir.Affine(rng.normal(0, 1, (10, 20)), np.zeros(10)),
        "output": nir.Output({"output": np.array([10])}),
    }
    edges = [*itertools.pairwise(["input", "fc1", "lif", "fc2", "output"])]
    edges += [("lif", "w_rec"), ("w_rec", "lif")]
    return nir.NIRGraph(nodes, edges)


@pytest.mark.parametrize("synapses", [1, 2, 3, 0])
def test_a_recurrent_graph_with_one_input_for_both_polarities(synapses):
    rng, network = np.random.default_rng(1), read_nir(merged_graph())
    frames = (rng.random((3, 60, 10, 10, 2)) < 0.03).astype(np.uint8)
    frames[..., 1] &= 1 - frames[..., 0]  # never both in one step, which would count twice
    stepping = Stepping.from_settings(Settings(), network)
    assert stepping == Stepping(1e-4, "euler")
    spec = make_nir_spec(network, stepping, EventFrames(0.02, 0), FRESH, frames, synapses)
    assert make_plan(spec).problems == []
    number = synapses or 2
    assert spec.layers[0].synapses_per_weight == number
    (note,) = list_synapse_notes(spec)
    assert f"{number * (200 * 20 + 20 * 20)} in all" in note
    reference = simulate(network, make_graph_inputs(network, frames, 60), 1e-4, "euler")
    (link, _) = from_nir(network, 1e-4, "euler", (10, 10, 2))
    signal = simulate_spikes(link, frames.reshape(3, 60, -1))
    np.testing.assert_array_equal(signal, reference.spikes["lif"])
    link = replace(link, synapses_per_weight=number)
    integers = choose_integers(link, frames.reshape(3, 60, -1))
    late = simulate_spikes(link, frames.reshape(3, 60, -1), integers)[:, :59]
    for target in ("emulator", "fast"):
        found = run_target(spec, frames, target)
        np.testing.assert_array_equal(found.spikes["dense1"], late.sum((1, 2)))
    assert late.sum() > 100


@pytest.mark.slow
def test_a_loop_that_runs_away_is_refused(tmp_path, capsys):
    few = ["--set", "data.samples_per_digit=8", "--samples", "6", "--step", "20", "--jobs", "1"]
    nir.write(tmp_path / "away.nir", merged_graph(5.0))
    given = ("--nir", tmp_path / "away.nir", "--input", "events")
    assert stmnist("convert", tmp_path / "run", *given, *few) == 2
    assert missing(capsys.readouterr().err, "'lif'", "'w_rec'", "runs away") == []


def test_a_run_of_a_graph_on_images(tmp_path, capsys):
    """Its step declares the settings of the input's spikes, which the simulation reads.

    What the reset that sinabs does not write would change is measured.
    """
    rng = np.random.default_rng(0)
    graph = nir.NIRGraph.from_list(
        nir.Input({"input": np.array([100])}),
        nir.Affine(rng.normal(0, 1, (6, 100)), np.zeros(6)),
        nir.IF(np.ones(6), np.ones(6)),
        nir.Affine(rng.normal(0, 1, (10, 6)), np.zeros(10)),
        nir.Output({"output": np.array([10])}),
    )
    nir.write(tmp_path / "some.nir", graph)
    few = ["--set", "data.samples_per_digit=8", "--samples", "6", "--jobs", "1"]
    given = ["--nir", tmp_path / "some.nir", "--input", "image", *few]
    assert stmnist("convert", tmp_path / "run", *given) == 0
    assert (tmp_path / "run" / "bundle" / "network.json").exists()
    assert missing(capsys.readouterr().err, "nir.reset=subtract-all)", "are the same") == []


@pytest.mark.slow
def test_a_run_of_a_graph(tmp_path, capsys):
    """Convert, ladder, plan; then again, nothing is done anew."""
    rng = np.random.default_rng(0)
    graph = nir.NIRGraph.from_list(
        nir.Input({"input": np.array([2, 10, 10])}),
        nir.Conv2d((10, 10), rng.normal(0, 1, (4, 2, 4, 4)), 3, 0, 1, 1, np.zeros(4)),
        nir.LIF(*(np.full((4, 3, 3), x) for x in (0.1, 8.0, 0.0, 1.0))),
        nir.Flatten({"input": np.array([4, 3, 3])}, 0),
        nir.Affine(rng.normal(0, 1, (10, 36)), np.zeros(10)),
        nir.Output({"output": np.array([10])}),
    )
    file, run = tmp_path / "some.nir", tmp_path / "run"
    nir.write(file, graph)
    few = ["--set", "data.samples_per_digit=8", "--samples", "6", "--step", "20", "--jobs", "1"]
    subtract = ["--set", "nir.reset=subtract"]
    assert stmnist("convert", run, "--nir", file, *few, *subtract, "--strict") == 2
    assert "--strict" in capsys.readouterr().err
    assert stmnist("convert", run, "--nir", file, *few, *subtract) == 0
    assert missing(capsys.readouterr().err, "nir: ", "by subtraction", "same") == []
    cost = read_json(run / "snn" / "metrics.json", "")["reset"]
    assert cost["samples"] == 64
    assert 0 <= cost["agreement"] <= 1
    nir.write(file, graph_of_ones())  # a later version; the run has its own copy
    changed = ["--set", "nir.method=euler"]  # for which the graph is read again
    assert stmnist("ladder", run, "--json", "--jobs", "1", *changed) == 0
    answered = capsys.readouterr()
    assert "has changed" in answered.err
    rows = json.loads(answered.out)["rows"]
    assert [row["stage"] for row in rows] == ["counts", "nir", "nengo", "simreal", "emulator"]
    assert "nir: " in answered.err
    assert stmnist("deploy", "plan", run / "bundle") == 0
    assert stmnist("train", run) == 2
    assert stmnist("status", run) == 0
    assert "outdated" not in capsys.readouterr().out
    assert stmnist("report", run) == 0
    assert stmnist("deploy", "energy", run / "bundle") == 0
    assert "Emulated Loihi" in (run / "report.html").read_text()
    # How a graph's samples are presented is chosen for it, and does not outlive it.
    shown, own = read_settings(run / "experiment.toml"), RunFolder(run).resolve_settings(None, {})
    assert (shown.presentation.gap, shown.presentation.stream_length) == (0, 1)
    assert own.presentation == Settings().presentation
    assert (shown.input.refractory, own.input.refractory) == (0, Settings().input.refractory)
    saved = (run / "experiment.toml").read_bytes()
    other = write_folder(tmp_path / "own", per_class=5)  # of another sensor
    assert stmnist("ladder", run, "--data", other, "--jobs", "1") == 2
    assert (run / "experiment.toml").read_bytes() == saved
    nir.write(run / "snn" / "network.nir", graph_of_ones())
    assert stmnist("convert", run, "--set", "presentation.gap=3", "--jobs", "1") == 2
    assert missing(capsys.readouterr().err, "network.nir: ") == []


def graph_of_ones():
    return nir.NIRGraph.from_list(
        nir.Input({"input": np.array([2, 10, 10])}),
        nir.Flatten({"input": np.array([2, 10, 10])}, 0),
        nir.Affine(np.ones((10, 200)), np.zeros(10)),
        nir.Output({"output": np.array([10])}),
    )


BAD = [
    (["--nir", "missing.nir"], ["missing.nir: ", "No such file"]),
    (["--nir", "text.nir"], ["text.nir: ", "NIR"]),
    (["--nir", "small.nir", "--model", "x.keras"], ["--model", "--nir"]),
    (["--step", "20"], ["--step", "--nir"]),
    (["--strict"], ["--strict", "--nir"]),
    (["--retrain"], ["--retrain", "--model"]),
    (["--nir", "small.nir", "--retrain"], ["--retrain", "--model"]),
    (["--nir", "small.nir", "--step", "5000"], ["'input.step'"]),
    (
        ["--nir", "small.nir", "--step", "200", "--set", "nir.method=euler"],
        ["tau", " 0.1 s", " 0.2 s", "nir.step"],
    ),
    (["--nir", "small.nir", "--input", "image"], ["2 x 10 x 10"]),
    (["--nir", "small.nir", "--set", "skin.rows=12", "--set", "skin.columns=12"], ["2 x 12 x 12"]),
    (["--nir", "nine.nir"], ["nine.nir: ", " 9 values", " 10 "]),
    (["--nir", "large.nir"], ["large.nir: ", "layer output"]),
]


@pytest.mark.parametrize(("options", "facts"), BAD)
def test_mistakes_are_one_line(options, facts, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.nir").write_text("hello")
    for name, outputs, weight in (
        ("small.nir", 10, 1.0),
        ("nine.nir", 9, 1.0),
        ("large.nir", 10, 1e7),
    ):
        weights = np.full((outputs, 2, 10, 10), weight)
        nir.write(
            name,
            nir.NIRGraph.from_list(
                nir.Input({"input": np.array([2, 10, 10])}),
                nir.Conv2d((10, 10), weights, 1, 0, 1, 1, np.zeros(outputs)),
                nir.LIF(*(np.full((outputs, 1, 1), x) for x in (0.1, 8.0, 0.0, 1.0))),
                nir.Output({"output": np.array([outputs, 1, 1])}),
            ),
        )
    few = ["--set", "data.samples_per_digit=5", "--samples", "2", "--jobs", "1"]
    assert stmnist("convert", tmp_path / "run", *options, *few) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert missing(last, *facts) == []
    assert not (tmp_path / "run").exists()


def test_a_graph_for_another_sensor_leaves_nothing(tmp_path, capsys):
    """A graph with rows and columns exchanged, on a user's recordings on 9 rows of 12 taxels."""
    data = write_folder(tmp_path / "own", per_class=5)
    graph = nir.NIRGraph.from_list(
        nir.Input({"input": np.array([2, 12, 9])}),
        nir.Flatten({"input": np.array([2, 12, 9])}, 0),
        nir.Affine(np.full((4, 216), 0.1), np.zeros(4)),
        nir.LIF(*(np.full(4, x) for x in (0.1, 8.0, 0.0, 1.0))),
        nir.Output({"output": np.array([4])}),
    )
    nir.write(tmp_path / "some.nir", graph)
    given = ("--nir", tmp_path / "some.nir", "--step", 20, "--data", data, "--jobs", 1)
    assert stmnist("convert", tmp_path / "run", *given) == 2
    assert "2 x 9 x 12" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_graph_that_was_changed_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"gone\.nir: .*No such file"):
        make_nir_settings(tmp_path / "gone.nir")


@pytest.mark.parametrize(
    ("channels", "on_events", "fits"),
    [(2, True, True), (1, True, True), (2, False, True), (1, False, False), (4, False, False)],
)
def test_both_polarities_may_be_one_channel_of_events_and_not_of_images(channels, on_events, fits):
    network = SimpleNamespace(input_shape=(channels, 9, 12), outputs=4, nodes=("output",))
    with contextlib.nullcontext() if fits else pytest.raises(UserError, match="2 x 9 x 12"):
        require_graph_fits(network, (9, 12, 2), 4, "network.nir", on_events)
